"""How the paths of a plan are predicted: by the mean, along drawn functions, or with the luck that suits the plan."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from surrogym_server.models.abilities import FunctionDraws, PredictedSteps
from surrogym_server.models.draws import function_draws
from surrogym_server.models.port import DynamicsModel, Transition
from surrogym_server.sampling.acquisition import Acquisition
from surrogym_server.sampling.outlook import AfterSteps

Move = Callable[[Tensor, Tensor], Transition]  # from q (m, C) under controls (m, F + E)


@dataclass(frozen=True)
class DrawnFunctions:
    """Functions of one model's posterior, one for each of N rows."""

    draws: FunctionDraws
    paths: Tensor  # (N, W)

    @classmethod
    def of(cls, model: DynamicsModel, count: int, rng: np.random.Generator) -> DrawnFunctions:
        """Draw ``count`` functions."""
        draws = function_draws(model)
        return cls(draws, draws.draw(torch.from_numpy(rng.standard_normal((count, draws.path_size)))))

    def __len__(self) -> int:
        return len(self.paths)

    def rows(self, index: Tensor) -> DrawnFunctions:
        """The functions with the numbers ``index`` (k,), which may repeat."""
        return DrawnFunctions(self.draws, self.paths[index])

    def step(self, q: Tensor, u: Tensor) -> Transition:
        """The step from q (N, C) under u (N, F), each row along its function."""
        return self.draws.transition_along(self.paths, q, u)


@dataclass(frozen=True)
class Forecast:
    """What an acquisition wants predicted for one plan, and how. By default the mean path.

    A sequence is predicted on several lanes. With drawn functions each lane follows one of its own.
    """

    controls: int = 0  # further columns of the sequences, between -1 and 1: E
    optimism: float = 0.0  # deviations by which an output misses its mean at a control of 1
    functions: DrawnFunctions | None = None
    optimal: tuple[AfterSteps, ...] = ()  # what the model would know after each of S optimal trajectories

    @classmethod
    def of(
        cls,
        model: DynamicsModel,
        acquisition: Acquisition,
        optimal: Sequence[PredictedSteps],
        rng: np.random.Generator,
    ) -> Forecast:
        """Prepare a plan's forecast. ``optimal`` are trajectories (T, ...)."""
        return cls(
            len(model.definition.outputs) - 1 if acquisition.optimism else 0,
            acquisition.optimism,
            DrawnFunctions.of(model, acquisition.trajectories, rng) if acquisition.trajectories else None,
            tuple(AfterSteps.of(model, steps) for steps in optimal),
        )

    def lanes(self, starts: Tensor) -> Tensor:
        """States of the lanes of each sequence (k, l, C), from its equally likely starts (k, s, C): at least one lane
        for each drawn function."""
        count = starts.shape[1]
        wanted = max(count, 0 if self.functions is None else len(self.functions))
        return starts if wanted == count else starts[:, torch.arange(wanted) % count]

    def move(self, model: DynamicsModel, sequences: int, lanes: int) -> Move | None:
        """The step of all lanes, (sequences * lanes) rows; None: the mean."""
        if self.controls:
            return partial(_lucky, model, self.optimism)
        if self.functions is None:
            return None
        index = torch.arange(lanes).repeat(sequences) % len(self.functions)
        return self.functions.rows(index).step


def _lucky(model: DynamicsModel, optimism: float, q: Tensor, controls: Tensor) -> Transition:
    """The step from q (m, C) in which each transition output misses its mean by ``optimism`` deviations, times its
    control. ``controls`` (m, F + M): the action, then one number between -1 and 1 for each transition output."""
    size = model.definition.action.size
    return model.transition(q, controls[:, :size], noise=optimism * controls[:, size:])
