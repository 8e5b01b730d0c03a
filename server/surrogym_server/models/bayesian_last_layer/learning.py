"""Learning of last layers from samples: targets, samples that are left out, and the terminal reward."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples, increments, saturated
from surrogym_server.errors import InvalidInput, NumericalFailure
from surrogym_server.models.bayesian_last_layer.model import BayesianLastLayerModel
from surrogym_server.models.bayesian_last_layer.regression import Regression
from surrogym_server.models.bayesian_last_layer.training import Training, train
from surrogym_server.models.ensemble.inputs import Inputs
from surrogym_server.models.ensemble.learning import MIN_POINTS, enough, standardised
from surrogym_server.models.port import Learned, Warm

TRANSITIONS, REWARD, ENDING = "transitions", "reward", "ending"
SEEDS = {TRANSITIONS: 0, REWARD: 1, ENDING: 2}  # added to the seed, so that each has other networks


def learn(training: Training, definition: EnvironmentDefinition, samples: Samples, warm: Warm) -> Learned:
    """Learn as ``Learner.learn`` says. Raises ``InvalidInput`` for fewer than two samples, and ``NumericalFailure`` if
    a matrix has no Cholesky factor."""
    if len(samples) < MIN_POINTS:
        raise InvalidInput(f"a model needs at least {MIN_POINTS} samples, got {len(samples)}")
    try:
        return _Learning(training, definition, warm).learned(samples)
    except torch.linalg.LinAlgError as error:  # type: ignore[attr-defined]
        raise NumericalFailure(f"the last layer could not be fitted to {len(samples)} samples: {error}") from error


class _Learning:
    """One fit. ``left`` collects what it leaves for a warm start."""

    def __init__(self, training: Training, definition: EnvironmentDefinition, warm: Warm) -> None:
        self.training, self.definition, self.warm = training, definition, warm
        self.inputs = Inputs(definition)
        self.left: dict[str, NDArray[np.float64]] = {}

    def learned(self, samples: Samples) -> Learned:
        usable = enough(~saturated(self.definition, samples.q_next))
        x, change = self.inputs.of_transition(samples.q, samples.u), increments(self.definition, samples)
        transitions = self._regression(TRANSITIONS, x[usable], change[usable])
        reward, terminal_reward = self._reward(samples)
        ending = None
        if self.definition.learns_termination:
            ending = self._ending(self.inputs.of_end(samples.q_next), samples.terminated)
        model = BayesianLastLayerModel(
            self.definition, transitions, reward, ending, terminal_reward, len(samples), samples.digest
        )
        return Learned(model, self.left)

    def _reward(self, samples: Samples) -> tuple[Regression | None, float]:
        """The reward of non-terminating steps, and the mean of what terminating steps pay in addition."""
        if (known := self.definition.declared_reward) is not None:
            return None, known.terminal
        goes_on = enough(~samples.terminated)
        x = self.inputs.of_reward(samples.q, samples.u, samples.q_next)
        reward = self._regression(REWARD, x[goes_on], samples.reward[goes_on, None], quadratic=True)
        if bool(goes_on.all()):
            return reward, 0.0
        beyond = samples.reward - reward.means(x)[:, 0]
        return reward, float(beyond[~goes_on].mean())

    def _ending(self, x: Tensor, ended: Tensor) -> Regression | float:
        """Regression of the labels -1 and 1. If there is only one label, that label as 0 or 1."""
        if bool(ended.all()) or not bool(ended.any()):
            return float(ended[0])
        return self._regression(ENDING, x, 2 * ended.double()[:, None] - 1)

    def _regression(self, name: str, x: Tensor, y: Tensor, *, quadratic: bool = False) -> Regression:
        """The regression of inputs x (n, d) and targets y (n, p), in the units of the targets."""
        target, centre, scale = standardised(y)
        training = replace(self.training, seed=self.training.seed + SEEDS[name])
        fitted = train(training, x, target, quadratic=quadratic, warm=_own(self.warm, name))
        self.left |= {f"{name}.{key}": tensor.numpy() for key, tensor in fitted.warm.items()}
        return replace(fitted.regression, centre=centre, scale=scale)


def _own(warm: Warm, name: str) -> Mapping[str, Tensor]:
    """A regression's own part of a warm start."""
    own = {key.removeprefix(f"{name}."): array for key, array in warm.items() if key.startswith(f"{name}.")}
    return {key: torch.as_tensor(np.asarray(array), dtype=torch.float64) for key, array in own.items()}
