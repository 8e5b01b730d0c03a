"""Default tolerances: 5 % of each output's standard deviation over the initial design, within bounds.

They are frozen after the first round, so that a design does not change its own goal. A size estimated from few samples
can be wrong in two ways: it may be mere rounding, or the samples may have missed everything of interest. So sizes have
a floor, and a tolerance is computed again when later samples cover a far larger range. The initial design of an
environment with snapshots stays near the resets, so there a tolerance grows with the samples' standard deviation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.distributions import scaling
from surrogym_server.environment.samples import Samples, increments

TOLERANCE = 0.05  # of the output's standard deviation over the initial design
FLOOR = 1e-9  # of a coordinate's standard deviation over its range: a smaller increment is rounding
NOTHING = 1e-3  # of the range seen later: the first samples are useless if they lie closer together


def sizes_of(definition: EnvironmentDefinition, samples: Samples) -> list[float]:
    """Size of each output (O,): its standard deviation over the samples, or that of its mean if it never varied."""
    targets = _targets(definition, samples)
    spread, mean = targets.std(0, correction=0), targets.mean(0).abs()
    return torch.where(spread > 0, spread, torch.where(mean > 0, mean, 1.0)).tolist()


def usual_tolerances(definition: EnvironmentDefinition, sizes: Sequence[float]) -> tuple[float, ...]:
    """Default tolerance of each output, of sizes (O,): 5 % of its size, or 1 in its unit as in the paper."""
    if definition.design.tolerance == "raw":
        return (1.0,) * len(sizes)
    floors = _floors(definition)
    return tuple(TOLERANCE * max(size, floor) for size, floor in zip(sizes, floors, strict=True))


@dataclass(frozen=True)
class Usual:
    """Default tolerances (O,) of a design, and the ranges (O,) that they were computed from."""

    tolerances: tuple[float, ...] = ()
    ranges: tuple[float, ...] = ()


def frozen_tolerances(definition: EnvironmentDefinition, samples: Samples, before: Usual) -> Usual:
    """Keep the tolerances of the round before. Compute them from the samples if there are none, or if the range of the
    targets has grown by more than 1 / ``NOTHING`` since. With snapshots, take larger ones than before in each round.

    A pure function of samples and state, so that a repeated round gives the same result. States of older designs have
    no ranges; then nothing changes. Rewards of terminating steps are not counted, because the reward's process does not
    model them.
    """
    sizes, ranges = sizes_of(definition, samples), _ranges(definition, samples)
    current = usual_tolerances(definition, sizes)
    if not before.tolerances:
        return Usual(current, ranges)
    if not before.ranges or definition.design.tolerance == "raw":
        return before
    old, now = zip(before.tolerances, before.ranges, strict=True), zip(current, ranges, strict=True)
    pairs = [_later(last, new, grows=definition.snapshots) for last, new in zip(old, now, strict=True)]
    return Usual(tuple(tolerance for tolerance, _ in pairs), tuple(width for _, width in pairs))


def _later(last: tuple[float, float], new: tuple[float, float], *, grows: bool) -> tuple[float, float]:
    """Tolerance and range of one output after a round, from those before it and those of all samples."""
    if new[1] * NOTHING > last[1]:
        return new
    return max(last, new) if grows else last


def _ranges(definition: EnvironmentDefinition, samples: Samples) -> tuple[float, ...]:
    """Range of the targets of non-terminating steps, (O,); 0 if it is mere rounding."""
    targets = _targets(definition, samples)[~samples.terminated]
    if not len(targets):
        return (0.0,) * len(definition.outputs)
    width, size = targets.amax(0) - targets.amin(0), targets.abs().amax(0)
    return tuple(torch.where(width > FLOOR * size, width, 0.0).tolist())


def _targets(definition: EnvironmentDefinition, samples: Samples) -> Tensor:
    return torch.cat([increments(definition, samples), samples.reward[:, None]], -1)


def _floors(definition: EnvironmentDefinition) -> list[float]:
    """Smallest size of each output (O,) that is more than rounding. For the reward, whose range is unknown, 0."""
    if definition.moves_observation:
        return [0.0] * len(definition.outputs)
    return [FLOOR * scaling(definition.coordinates[i].sampling)[1] for i in definition.moving] + [0.0]
