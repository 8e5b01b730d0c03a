"""Learning a model from samples: targets, censoring at bounds, and the choice of feature maps by evidence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.errors import InvalidInput
from surrogym_server.gp import FitOptions, Fitted, fit
from surrogym_server.surrogate.definition import REWARD, EnvironmentDefinition
from surrogym_server.surrogate.features import FeatureMap, candidates, encode, leading, reward_candidates
from surrogym_server.surrogate.model import OutputModel, SurrogateModel
from surrogym_server.surrogate.samples import Samples, increments, saturated

Thetas = Mapping[str, NDArray[np.float64]]  # "output|feature map" -> hyperparameters, for warm starts
CONSTANT = 1e-9  # an output whose deviation is below this share of its own size never varied
MIN_POINTS = 2


@dataclass(frozen=True)
class Learned:
    """A model, and the hyperparameters of every candidate, for the next round's warm start."""

    model: SurrogateModel
    thetas: dict[str, NDArray[np.float64]]


def learn(definition: EnvironmentDefinition, samples: Samples, warm: Thetas | None = None) -> Learned:
    """Fit transition and reward processes to samples.

    Raises:
        InvalidInput: fewer than two samples.
        NumericalFailure: a covariance that can't be factored.
    """
    if len(samples) < MIN_POINTS:
        raise InvalidInput(f"a model needs at least {MIN_POINTS} samples, got {len(samples)}")
    learner = _Learner(definition, warm or {}, {})
    transitions = _transitions(learner, samples)
    reward, terminal_reward = _reward(learner, samples)
    model = SurrogateModel(definition, transitions, reward, terminal_reward, len(samples), samples.digest)
    return Learned(model, learner.thetas)


@dataclass
class _Learner:
    definition: EnvironmentDefinition
    warm: Thetas
    thetas: dict[str, NDArray[np.float64]]

    def output(
        self, name: str, target: Tensor, inputs: Mapping[FeatureMap, Tensor], keep: Tensor, keep_lead: Tensor
    ) -> OutputModel:
        """The best of the feature maps ``inputs`` (n, d) for one output's targets (n,).

        ``keep`` (n,) marks the samples that count. Maps that read the lead may use more, ``keep_lead``; all are
        compared on the same points.
        """
        centre, scale = float(target[keep].mean()), float(target[keep].std(correction=0))
        if scale <= CONSTANT * abs(centre):
            return OutputModel(name, next(iter(inputs)), None, centre, 1.0, int((~keep).sum()))
        y = (target - centre) / scale
        fits = {m: self._fit(f"{name}|{m}", x[keep], y[keep]) for m, x in inputs.items()}
        best = max(fits, key=lambda m: fits[m].score)
        chosen, used = fits[best], keep
        if best.lead and bool((keep_lead & ~keep).any()):
            used = keep_lead
            chosen = self._fit(f"{name}|{best}|all", inputs[best][used], y[used])
        scores = tuple((str(m), f.score) for m, f in fits.items())
        return OutputModel(name, best, chosen.posterior, centre, scale, int((~used).sum()), scores)

    def _fit(self, key: str, x: Tensor, y: Tensor) -> Fitted:
        options = self._options(key)
        fitted = fit(x, y, options, self.warm.get(key))
        self.thetas[key] = fitted.theta
        return fitted

    def _options(self, key: str) -> FitOptions:
        """Dynamics tend to be near linear, costs to be quadratic; the paper has the squared exponential alone."""
        if self.definition.design.preset == "paper":
            return FitOptions(linear=False)
        return FitOptions(quadratic=key.startswith(f"{REWARD}|"))


def _transitions(learner: _Learner, samples: Samples) -> tuple[OutputModel, ...]:
    definition = learner.definition
    everything, change = torch.ones(len(samples), dtype=torch.bool), increments(definition, samples)
    if definition.design.preset == "paper":
        (feature_map,) = candidates(definition, follows=False)
        inputs = {feature_map: encode(definition, feature_map, samples.q, samples.u)}
        return tuple(
            learner.output(name, change[:, i], inputs, everything, everything)
            for i, name in enumerate(definition.observation_names)
        )
    keep = ~saturated(definition, samples.q_next)
    keep = keep if int(keep.sum()) >= MIN_POINTS else everything
    lead = leading(definition)
    outputs = []
    for column, index in enumerate(definition.moving):
        maps = candidates(definition, follows=index not in lead)
        inputs = {m: encode(definition, m, samples.q, samples.u, samples.q_next[:, lead]) for m in maps}
        keep_lead = ~_saturates(definition, index, samples.q_next) | ~keep.any()
        name = definition.coordinates[index].name
        outputs.append(learner.output(name, change[:, column], inputs, keep, keep_lead | keep))
    return tuple(outputs)


def usable(definition: EnvironmentDefinition, column: int, q_next: Tensor, feature_map: FeatureMap) -> Tensor:
    """Which samples that end at q_next (m, C) the transition output ``column`` learns from under a map, (m,) bool."""
    if definition.design.preset == "paper":
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


def _reward(learner: _Learner, samples: Samples) -> tuple[OutputModel, float]:
    """The reward process of steps that go on, and what a step that ends the episode pays beyond it."""
    definition = learner.definition
    inputs = {
        m: encode(definition, m, samples.q_next if m.after else samples.q, samples.u)
        for m in reward_candidates(definition)
    }
    going = (
        ~samples.terminated if int((~samples.terminated).sum()) >= MIN_POINTS else torch.ones_like(samples.terminated)
    )
    output = learner.output(REWARD, samples.reward, inputs, going, going)
    ended = ~going
    if not bool(ended.any()):
        return output, 0.0
    bonus = samples.reward[ended] - output.mean(inputs[output.feature_map][ended])
    return output, float(bonus.mean())
