"""Tolerances that nobody set: 5 % of each output's deviation over the initial design, within what makes sense.

They are frozen after the first round, so that a design does not move its own goal. Two things are wrong with a size
that a few samples gave: it may be nothing but rounding, and it may be that of samples that met nothing. So sizes have
a floor, and a tolerance is taken again once something other than nothing is met.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.distributions import scaling
from surrogym_server.environment.samples import Samples, increments

TOLERANCE = 0.05  # of the output's deviation over the initial design
FLOOR = 1e-9  # of a coordinate's deviation over its range: a smaller increment is rounding
NOTHING = 1e-3  # of the range met since: first samples that lie closer met nothing


def sizes_of(definition: EnvironmentDefinition, samples: Samples) -> list[float]:
    """Size of each output (O,): its deviation over the samples at hand, or that of its mean, if it never varied."""
    targets = _targets(definition, samples)
    spread, mean = targets.std(0, correction=0), targets.mean(0).abs()
    return torch.where(spread > 0, spread, torch.where(mean > 0, mean, 1.0)).tolist()


def usual_tolerances(definition: EnvironmentDefinition, sizes: Sequence[float]) -> tuple[float, ...]:
    """Tolerance of each output, of sizes (O,), that nobody set: 5 % of its size, or as printed 1 in its unit."""
    if definition.design.tolerance == "raw":
        return (1.0,) * len(sizes)
    floors = _floors(definition)
    return tuple(TOLERANCE * max(size, floor) for size, floor in zip(sizes, floors, strict=True))


@dataclass(frozen=True)
class Usual:
    """The tolerances (O,) that a design goes by where nobody set one, and the ranges (O,) that they were taken from."""

    tolerances: tuple[float, ...] = ()
    ranges: tuple[float, ...] = ()


def frozen_tolerances(definition: EnvironmentDefinition, samples: Samples, before: Usual) -> Usual:
    """The tolerances of the round before; of the samples where there are none, or where they met nothing before: what
    has been met since lies over a range more than 1 / ``NOTHING`` times as wide.

    A pure function of samples and state, so that a round that is taken again comes to the same. Without the ranges, as
    in states of designs that began before they were kept, nothing changes. What a step that ends an episode pays is
    not counted: it is beyond the reward's process.
    """
    sizes, ranges = sizes_of(definition, samples), _ranges(definition, samples)
    taken = usual_tolerances(definition, sizes)
    if not before.tolerances:
        return Usual(taken, ranges)
    if not before.ranges or definition.design.tolerance == "raw":
        return before
    old, now = zip(before.tolerances, before.ranges, strict=True), zip(taken, ranges, strict=True)
    kept = [new if new[1] * NOTHING > last[1] else last for last, new in zip(old, now, strict=True)]
    return Usual(tuple(tolerance for tolerance, _ in kept), tuple(width for _, width in kept))


def _ranges(definition: EnvironmentDefinition, samples: Samples) -> tuple[float, ...]:
    """How far apart the targets of steps that go on lie, (O,); 0 where that is rounding."""
    targets = _targets(definition, samples)[~samples.terminated]
    if not len(targets):
        return (0.0,) * len(definition.outputs)
    width, size = targets.amax(0) - targets.amin(0), targets.abs().amax(0)
    return tuple(torch.where(width > FLOOR * size, width, 0.0).tolist())


def _targets(definition: EnvironmentDefinition, samples: Samples) -> Tensor:
    return torch.cat([increments(definition, samples), samples.reward[:, None]], -1)


def _floors(definition: EnvironmentDefinition) -> list[float]:
    """Least size of each output (O,) that is no rounding; of the reward, whose range nobody knows, 0."""
    if definition.moves_observation:
        return [0.0] * len(definition.outputs)
    return [FLOOR * scaling(definition.coordinates[i].sampling)[1] for i in definition.moving] + [0.0]
