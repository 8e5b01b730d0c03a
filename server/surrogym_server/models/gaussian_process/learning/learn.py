"""Learning a model from samples: targets, censoring at bounds, and the choice of feature maps by evidence."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import FeatureMap, encode, leading
from surrogym_server.environment.samples import Samples, increments, saturated
from surrogym_server.errors import InvalidInput
from surrogym_server.models.gaussian_process.feature_maps import candidates
from surrogym_server.models.gaussian_process.learning.angle_prediction import learn_drift
from surrogym_server.models.gaussian_process.learning.output_learner import OutputLearner, Thetas
from surrogym_server.models.gaussian_process.learning.region import learn_termination
from surrogym_server.models.gaussian_process.learning.reward import learn_reward
from surrogym_server.models.gaussian_process.prediction.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel

MIN_POINTS = 2


@dataclass(frozen=True)
class Learned:
    """A model, and the hyperparameters of every candidate, for the next round's warm start."""

    model: GaussianProcessModel
    thetas: dict[str, NDArray[np.float64]]


def learn(definition: EnvironmentDefinition, samples: Samples, warm: Thetas | None = None) -> Learned:
    """Fit transition and reward to samples, and where episodes end if that is not declared.

    Raises:
        InvalidInput: fewer than two samples.
        NumericalFailure: a covariance that can't be factored.
    """
    if len(samples) < MIN_POINTS:
        raise InvalidInput(f"a model needs at least {MIN_POINTS} samples, got {len(samples)}")
    learner = OutputLearner(definition, warm or {}, {})
    transitions = _transitions(learner, samples)
    paying, terminal_reward, jumps = learn_reward(learner, samples)
    ends = learn_termination(learner, samples) if definition.learns_termination else None
    model = GaussianProcessModel(
        definition, transitions, paying, terminal_reward, len(samples), samples.digest, ends, jumps
    )
    return Learned(model, learner.thetas)


def _transitions(learner: OutputLearner, samples: Samples) -> tuple[OutputModel, ...]:
    definition = learner.definition
    everything, change = torch.ones(len(samples), dtype=torch.bool), increments(definition, samples)
    if definition.moves_observation:
        (feature_map,) = candidates(definition, follows=False)
        inputs = {feature_map: encode(definition, feature_map, samples.q, samples.u)}
        return tuple(
            learner.output(name, change[:, i], inputs, everything, everything)
            for i, name in enumerate(definition.observation_names)
        )
    keep = ~saturated(definition, samples.q_next)
    keep = keep if int(keep.sum()) >= MIN_POINTS else everything
    lead, drift = leading(definition), learn_drift(definition, samples)
    outputs = []
    for column, index in enumerate(definition.moving):
        maps = candidates(definition, follows=index not in lead, drift=drift)
        inputs = {m: encode(definition, m, samples.q, samples.u, samples.q_next[:, lead]) for m in maps}
        keep_lead = ~_saturates(definition, index, samples.q_next) | ~keep.any()
        name = definition.coordinates[index].name
        outputs.append(learner.output(name, change[:, column], inputs, keep, keep_lead | keep))
    return tuple(outputs)


def usable(definition: EnvironmentDefinition, column: int, q_next: Tensor, feature_map: FeatureMap) -> Tensor:
    """Which samples that end at q_next (m, C) the transition output ``column`` learns from under a map, (m,) bool."""
    if definition.moves_observation:
        return torch.ones(len(q_next), dtype=torch.bool)
    if feature_map.lead:
        return ~_saturates(definition, definition.moving[column], q_next)
    return ~saturated(definition, q_next)


def _saturates(definition: EnvironmentDefinition, index: int, q_next: Tensor) -> Tensor:
    """Samples (n,) in which anything but the lead ended at a bound, coordinate ``index`` included."""
    others = q_next.clone()
    others[:, leading(definition)] = math.nan
    others[:, index] = q_next[:, index]
    return saturated(definition, others)
