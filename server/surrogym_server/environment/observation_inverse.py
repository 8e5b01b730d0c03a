"""Inverse of the observation: coordinates read back from it, for models whose outputs move the observation.

An angle needs both its cosine and its sine among the entries. Their mean leaves the circle, but the angle is still
defined. A linear coordinate needs an entry that is the coordinate itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.terms import PartDefinition
from surrogym_server.errors import InvalidSpec


@dataclass(frozen=True)
class ObservationInverse:
    """Where each moving coordinate is found in an observation: the indices (value,) or (cos, sin) of its entries."""

    sources: tuple[tuple[int, tuple[int, ...]], ...]  # pairs: index of the coordinate, indices of its entries

    @classmethod
    def of(cls, definition: EnvironmentDefinition) -> ObservationInverse:
        """Find the entries of each moving coordinate. Raises ``InvalidSpec`` if the observation does not determine a
        moving coordinate."""
        return cls(tuple((i, _source(definition, i)) for i in definition.moving))

    def __call__(self, o: Tensor, q: Tensor) -> Tensor:
        """Return the coordinates (m, C) of observations o (m, D). Coordinates that don't move are taken from q (m,
        C)."""
        recovered = q.clone()
        for index, entries in self.sources:
            if len(entries) == 2:
                recovered[..., index] = torch.atan2(o[..., entries[1]], o[..., entries[0]])
            else:
                recovered[..., index] = o[..., entries[0]]
        return recovered


def _source(definition: EnvironmentDefinition, index: int) -> tuple[int, ...]:
    coordinate = definition.coordinates[index]
    unit = tuple(float(i == index) for i in range(len(definition.coordinates)))
    direct = _entry(definition, PartDefinition("linear", 1.0, unit), coordinate.sampling.low, coordinate.sampling.high)
    if direct is not None:
        return (direct,)
    cosine, sine = (_entry(definition, PartDefinition(f, 1.0, unit), -1.0, 1.0) for f in ("cos", "sin"))
    if coordinate.kind == "angle" and cosine is not None and sine is not None:
        return (cosine, sine)
    raise InvalidSpec(
        f"preset 'paper' moves the observation, and coordinate {coordinate.name!r} can't be read back from it: "
        "expected an entry that is the coordinate, or for an angle both its cos and its sin; use preset 'default'"
    )


def _entry(definition: EnvironmentDefinition, part: PartDefinition, low: float, high: float) -> int | None:
    """Return the index of the observation entry that consists of this part alone and is not clipped within [low, high];
    None if there is no such entry."""
    for position, term in enumerate(definition.observation_terms):
        if term.parts == (part,) and term.low <= low and term.high >= high:
            return position
    return None
