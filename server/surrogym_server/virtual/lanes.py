"""State of N lanes (parallel environments) as tensors. With model, settings and actions it determines the next step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

NEW, RUNNING, ENDED = 0, 1, 2  # phases of a lane: never reset; in an episode; episode ended, reset pending
EVERY = slice(None)  # selects all lanes; indexing by a slice instead of a mask copies no array
Chosen = Tensor | slice  # selection of lanes: a mask (N,), or EVERY


@dataclass(frozen=True)
class LaneState:
    """State of N lanes (parallel virtual environments). Each has P particles, and W weights of the sampled function
    that it follows.

    P is 0 except in variant probabilistic, W is 0 except in variant pathwise. If functions of the lanes have different
    numbers of weights, because they come from different models, the shorter ones are padded with zeros. A model ignores
    the padding.
    """

    seed: Tensor  # (N,) int64, seed of each lane, from which its random numbers are computed
    lane: Tensor  # (N,) int64, a number that gives lanes with the same seed different random numbers
    episode: Tensor  # (N,) int64, number of each lane's current episode: 0, 1, ...; -1 before the first reset
    elapsed: Tensor  # (N,) int64, number of steps that each lane's current episode has taken
    phase: Tensor  # (N,) int8, phase of each lane: NEW, RUNNING, or ENDED and waiting for a reset
    q: Tensor  # (N, C) coordinates of each lane's state; observation and termination are computed from them
    particles: Tensor  # (N, P, C) coordinates of each lane's P particles
    path: Tensor  # (N, W) weights of the sampled function that the lane's episode follows; drawn in its first step

    def __len__(self) -> int:
        return len(self.seed)

    def take(self, index: NDArray[Any] | Chosen) -> LaneState:
        """Return the state of only those lanes that ``index``, an index array or a mask, selects, in its order."""
        if isinstance(index, slice):
            return self
        at = torch.as_tensor(index, device=self.seed.device)
        return LaneState(*(getattr(self, f.name)[at] for f in fields(self)))

    def put(self, index: NDArray[Any] | Chosen, other: LaneState) -> LaneState:
        """Return a copy of this state in which the lanes that ``index``, an index array or a mask, selects are replaced
        by the lanes of ``other``, in order."""
        if isinstance(index, slice):
            return other
        at = torch.as_tensor(index, device=self.seed.device)
        replaced = []
        for f in fields(self):
            values = getattr(other, f.name)
            tensor = getattr(self, f.name)
            if f.name == "path":
                width = max(tensor.shape[1], values.shape[1])
                tensor, values = _widened(tensor, width), _widened(values, width)
            tensor = tensor.clone()
            tensor[at] = values
            replaced.append(tensor)
        return LaneState(*replaced)

    @property
    def nbytes(self) -> int:
        """Memory of all tensors, in bytes."""
        return sum(int(getattr(self, f.name).nbytes) for f in fields(self))

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        return {f.name: getattr(self, f.name).cpu().numpy() for f in fields(self)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> LaneState:
        return cls(*(torch.from_numpy(arrays[f.name].copy()) for f in fields(cls)))


def _widened(path: Tensor, width: int) -> Tensor:
    """Append columns of zeros to ``path`` (n, W), the weights of n sampled functions, up to ``width`` columns."""
    return path if path.shape[1] == width else pad(path, (0, width - path.shape[1]))
