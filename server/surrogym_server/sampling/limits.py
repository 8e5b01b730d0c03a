"""Find declared limits of coordinates at which many samples end.

A limit cuts the change of a coordinate off, so samples that end at a limit say little about the dynamics.
"""

from __future__ import annotations

from dataclasses import dataclass

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples, limit_sides
from surrogym_shared.kinds import Side

MANY = 0.2  # a bound of a coordinate is reported if at least this share of the samples end at it


@dataclass(frozen=True)
class Limit:
    """Declared limit of a coordinate at which many samples end."""

    coordinate: str
    side: Side
    value: float
    share: float  # share of the samples whose next state is at this bound


def reached_limits(definition: EnvironmentDefinition, samples: Samples) -> tuple[Limit, ...]:
    """Return the limits at which at least the share ``MANY`` (0.2) of the samples end, the most frequent first."""
    if not len(samples):
        return ()
    limits: list[Limit] = []
    sides = limit_sides(definition, samples.q_next)
    for index in definition.moving:
        coordinate, side = definition.coordinates[index], sides[:, index]
        low, high = coordinate.saturation
        limits += [
            Limit(coordinate.name, "lower", low, float((side < 0).double().mean())),
            Limit(coordinate.name, "upper", high, float((side > 0).double().mean())),
        ]
    return tuple(sorted((one for one in limits if one.share >= MANY), key=lambda one: -one.share))
