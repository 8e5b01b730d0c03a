"""Inverse of the observation: computes coordinates from it, for models whose outputs are changes of the observation.

An angle needs both its cosine and its sine among the entries. A predicted pair need not lie on the unit circle, but it
still has an angle. A linear coordinate needs an entry that is the coordinate itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.terms import parts_of
from surrogym_server.errors import InvalidSpec
from surrogym_shared.kinds import Function
from surrogym_shared.spec import ends_of, limits


@dataclass(frozen=True)
class ObservationInverse:
    """Where coordinates are found in an observation: the indices (value,) or (cos, sin) of the entries of each."""

    # For each of these coordinates: its index, and the indices of the observation entries from which it is computed.
    sources: tuple[tuple[int, tuple[int, ...]], ...]

    @classmethod
    def of(cls, definition: EnvironmentDefinition, *, lags: bool = False) -> ObservationInverse:
        """Find the observation entries from which each moving coordinate can be computed, and with ``lags`` each that
        repeats a past value. Raises ``InvalidSpec`` if there are none for one of them."""
        asked = definition.moving + (definition.lags if lags else ())
        return cls(tuple((i, _source(definition, i)) for i in asked))

    def __call__(self, o: Tensor, q: Tensor) -> Tensor:
        """Return the coordinates (m, C) of m states, computed from their observations o (m, D). Other coordinates
        are copied from q (m, C)."""
        recovered = q.clone()
        for index, entries in self.sources:
            if len(entries) == 2:
                recovered[..., index] = torch.atan2(o[..., entries[1]], o[..., entries[0]])
            else:
                recovered[..., index] = o[..., entries[0]]
        return recovered


def _source(definition: EnvironmentDefinition, index: int) -> tuple[int, ...]:
    coordinate = definition.coordinates[index]
    direct = _entry(definition, "linear", index, *limits(coordinate.sampling))
    if direct is not None:
        return (direct,)
    cosine, sine = (_entry(definition, "cos", index, -1.0, 1.0), _entry(definition, "sin", index, -1.0, 1.0))
    if coordinate.kind == "angle" and cosine is not None and sine is not None:
        return (cosine, sine)
    raise InvalidSpec(
        f"coordinate {coordinate.name!r} can't be computed from the observation, as preset 'paper' and planners need: "
        "expected an observation entry that is the coordinate, or for an angle entries that are its cos and its sin; "
        "add them, or train a policy with preset 'default'"
    )


def _entry(definition: EnvironmentDefinition, function: Function, index: int, low: float, high: float) -> int | None:
    """Return the index of the observation entry that is ``function`` of coordinate number ``index`` alone and is not
    clipped within [low, high]; None if there is no such entry."""
    unit = tuple(float(i == index) for i in range(len(definition.coordinates)))
    for position, entry in enumerate(definition.observation):
        least, most = ends_of(entry.term.low, entry.term.high)
        alone = parts_of(entry.term, definition.coordinate_names) == ((function, 1.0, unit),)
        if alone and least <= low and most >= high:
            return position
    return None
