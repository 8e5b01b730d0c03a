"""LaneState: everything the next step of N lanes depends on, as tensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

NEW, RUNNING, ENDED = 0, 1, 2  # phase of a lane
EVERY = slice(None)  # replaces a mask of all lanes, so that nothing is copied
Chosen = Tensor | slice  # a mask (N,), or EVERY


@dataclass(frozen=True)
class LaneState:
    """State of N lanes. P is 0 except in variant probabilistic, W is 0 except in variant pathwise.

    Functions of models of different sizes lie side by side. Shorter rows are filled up with zeros, and a model reads as
    many of the W numbers as it has.
    """

    seed: Tensor  # (N,) int64, key of the noise
    lane: Tensor  # (N,) int64, key of the noise
    episode: Tensor  # (N,) int64, -1 before the first
    elapsed: Tensor  # (N,) int64, steps in this episode
    phase: Tensor  # (N,) int8: NEW, RUNNING, or ENDED and waiting for a reset
    q: Tensor  # (N, C) output state: what observation and termination are read from
    particles: Tensor  # (N, P, C)
    path: Tensor  # (N, W) weights of the function the episode follows; drawn in its first step

    def __len__(self) -> int:
        return len(self.seed)

    def take(self, index: NDArray[Any] | Chosen) -> LaneState:
        """Select the lanes of an index or mask, in its order."""
        if isinstance(index, slice):
            return self
        at = torch.as_tensor(index, device=self.seed.device)
        return LaneState(*(getattr(self, f.name)[at] for f in fields(self)))

    def put(self, index: NDArray[Any] | Chosen, other: LaneState) -> LaneState:
        """Replace the lanes of an index or mask by ``other``."""
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
        """Memory in bytes."""
        return sum(int(getattr(self, f.name).nbytes) for f in fields(self))

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        return {f.name: getattr(self, f.name).cpu().numpy() for f in fields(self)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> LaneState:
        return cls(*(torch.from_numpy(arrays[f.name].copy()) for f in fields(cls)))


def _widened(path: Tensor, width: int) -> Tensor:
    """Fill weights (n, W) up with zeros to ``width``."""
    return path if path.shape[1] == width else pad(path, (0, width - path.shape[1]))
