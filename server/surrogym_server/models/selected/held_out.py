"""Which samples are held out: pieces of trajectories where samples form some, else single steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples, preceding

Kind = Literal["trajectories", "steps"]
FEWEST = 8  # pieces, for a standard error that says something
SHORTEST, LONGEST = 5, 100  # steps of a piece of a trajectory
SHARE, MOST_FOLDS = 5, 5  # a fold holds out one piece of five
ENOUGH: dict[Kind, int] = {"trajectories": 10, "steps": 100}  # pieces to hold out in all folds together


@dataclass(frozen=True)
class HeldOut:
    """Pieces to hold out, in folds: each fold is held out from a fit of its own."""

    kind: Kind
    folds: tuple[tuple[Tensor, ...], ...]  # rows of consecutive samples of each piece

    @property
    def pieces(self) -> int:
        return sum(map(len, self.folds))


def held_out(definition: EnvironmentDefinition, samples: Samples) -> HeldOut | None:
    """Choose pieces to hold out; None if there are too few samples.

    A trajectory of more than ``LONGEST`` steps is cut. The choice is random, with a fixed seed.
    """
    if len(samples) < FEWEST:
        return None
    pieces = [piece for piece in _pieces(preceding(definition, samples)) if len(piece) >= SHORTEST]
    if len(pieces) >= FEWEST:
        return HeldOut("trajectories", _folds(pieces, ENOUGH["trajectories"]))
    return HeldOut("steps", _folds(torch.arange(len(samples)).tensor_split(len(samples)), ENOUGH["steps"]))


def _pieces(follows: Tensor) -> list[Tensor]:
    """Rows of each piece, of samples that continue the sample before where ``follows`` (n,) is not negative."""
    begins = (follows < 0).nonzero()[:, 0].tolist()
    ends = [*begins[1:], len(follows)]
    trajectories = [torch.arange(begin, end) for begin, end in zip(begins, ends, strict=True)]
    return [piece for rows in trajectories for piece in rows.tensor_split(math.ceil(len(rows) / LONGEST))]


def _folds(pieces: Sequence[Tensor], enough: int) -> tuple[tuple[Tensor, ...], ...]:
    """As few folds as hold out enough pieces."""
    order = torch.randperm(len(pieces), generator=torch.Generator().manual_seed(0)).tolist()
    count = min(MOST_FOLDS, math.ceil(enough * SHARE / len(pieces)))
    return tuple(tuple(pieces[i] for i in order[fold::SHARE]) for fold in range(count))
