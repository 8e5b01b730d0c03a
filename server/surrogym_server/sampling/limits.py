"""Declared limits at which many samples end. A limit cuts the increments off, so such samples say little about the
dynamics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples

MANY = 0.2  # share of the samples that is worth a word
SLACK = 1e-9  # of the width between the limits, for rounding


@dataclass(frozen=True)
class Limit:
    """A declared limit of a coordinate at which samples end."""

    coordinate: str
    side: Literal["lower", "upper"]
    value: float
    share: float  # of the samples


def reached_limits(definition: EnvironmentDefinition, samples: Samples) -> tuple[Limit, ...]:
    """Limits at which at least ``MANY`` of the samples end, the most frequent first."""
    if not len(samples):
        return ()
    found: list[Limit] = []
    for index in definition.moving:
        coordinate, after = definition.coordinates[index], samples.q_next[:, index]
        width = coordinate.high - coordinate.low
        slack = SLACK * (width if width < float("inf") else 1.0)
        lower, upper = after <= coordinate.low + slack, after >= coordinate.high - slack
        found += [
            Limit(coordinate.name, "lower", coordinate.low, float(lower.double().mean())),
            Limit(coordinate.name, "upper", coordinate.high, float(upper.double().mean())),
        ]
    return tuple(sorted((one for one in found if one.share >= MANY), key=lambda one: -one.share))
