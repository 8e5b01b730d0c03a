"""State of N lanes (parallel environments). With model, settings and actions it determines the next step.

Whole numbers, which say what a lane does next, are NumPy arrays: the program knows them without waiting for a device.
Coordinates and weights are tensors on the session's device.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from surrogym_server.tensors import sent

NEW, RUNNING, ENDED = 0, 1, 2  # phases of a lane: never reset; in an episode; episode ended, reset pending
EVERY = slice(None)  # selects all lanes; indexing by a slice instead of a mask copies no array
Chosen = NDArray[Any] | slice  # selection of lanes: a mask (N,) or indices, or EVERY
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class LaneState:
    """State of N lanes (parallel virtual environments). Each has P particles, and W weights of the sampled function
    that it follows.

    P is 0 except in variant probabilistic, W is 0 except in variant pathwise. If functions of the lanes have different
    numbers of weights, because they come from different models, the shorter ones are padded with zeros. A model ignores
    the padding.
    """

    seed: Ints  # (N,) seed of each lane, from which its random numbers are computed
    lane: Ints  # (N,) a number that gives lanes with the same seed different random numbers
    episode: Ints  # (N,) number of each lane's current episode: 0, 1, ...; -1 before the first reset
    elapsed: Ints  # (N,) number of steps that each lane's current episode has taken
    phase: NDArray[np.int8]  # (N,) phase of each lane: NEW, RUNNING, or ENDED and waiting for a reset
    q: Tensor  # (N, C) coordinates of each lane's state; observation and termination are computed from them
    particles: Tensor  # (N, P, C) coordinates of each lane's P particles
    path: Tensor  # (N, W) weights of the sampled function that the lane's episode follows; drawn in its first step

    def __len__(self) -> int:
        return len(self.seed)

    def take(self, index: Chosen) -> LaneState:
        """Return the state of only those lanes that ``index``, an index array or a mask, selects, in its order."""
        if isinstance(index, slice):
            return self
        at, there = self._places(index)
        ours: list[Any] = [getattr(self, f.name) for f in fields(self)]
        return LaneState(*(values[there if isinstance(values, Tensor) else at] for values in ours))

    def put(self, index: Chosen, other: LaneState) -> LaneState:
        """Return a copy of this state in which the lanes that ``index``, an index array or a mask, selects are replaced
        by the lanes of ``other``, in order. Particles and weights that ``other`` has none of stay as they are."""
        if isinstance(index, slice):
            return other
        at, there = self._places(index)
        replaced: list[Any] = []
        for f in fields(self):
            values, ours = getattr(other, f.name), getattr(self, f.name)
            if f.name in ("particles", "path") and not values.shape[1]:
                replaced.append(ours)
                continue
            if f.name == "path":
                width = max(ours.shape[1], values.shape[1])
                ours, values = _widened(ours, width), _widened(values, width)
            changed = ours.clone() if isinstance(ours, Tensor) else ours.copy()
            changed[there if isinstance(ours, Tensor) else at] = values
            replaced.append(changed)
        return LaneState(*replaced)

    @property
    def bare(self) -> LaneState:
        """The same lanes without particles and weights, which are large."""
        return replace(self, particles=self.particles[:, :0], path=self.path[:, :0])

    def _places(self, index: NDArray[Any]) -> tuple[NDArray[Any], Tensor]:
        """Return the indices of lanes as an array and on the device of the coordinates. By a mask there, the device
        would have to be asked how many lanes it selects."""
        at = index.nonzero()[0] if index.dtype == np.bool_ else index
        return at, sent(at, self.q.device)

    @property
    def nbytes(self) -> int:
        """Memory of all arrays and tensors, in bytes."""
        return sum(int(getattr(self, f.name).nbytes) for f in fields(self))

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        ours = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: v.cpu().numpy() if isinstance(v, Tensor) else v for name, v in ours.items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> LaneState:
        copies: dict[str, Any] = {f.name: arrays[f.name].copy() for f in fields(cls)}
        copies |= {n: torch.from_numpy(a) for n, a in copies.items() if a.dtype == np.float64}
        return cls(**copies)


def _widened(path: Tensor, width: int) -> Tensor:
    """Append columns of zeros to ``path`` (n, W), the weights of n sampled functions, up to ``width`` columns."""
    return path if path.shape[1] == width else pad(path, (0, width - path.shape[1]))
