"""Default tolerances: 5 % of each output's standard deviation over the initial design, within bounds.

Default tolerances are frozen after the first round, so that a design does not change its own goal. A size estimated
from few samples can be wrong in two ways: it may be rounding, or the samples may have missed everything of interest. So
sizes have a floor, and a tolerance is computed again when later samples cover a far larger range. The initial design of
an environment with snapshots stays near the resets, so there a tolerance grows with the samples' standard deviation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.distributions import scaling
from surrogym_server.environment.samples import Samples, increments

TOLERANCE = 0.05  # default tolerance, as a share of the output's standard deviation over the initial design
FLOOR = 1e-9  # increments below this share of a coordinate's standard deviation over its range are rounding errors
# A tolerance is derived from the range of the first targets. If that is below this share of the range of all targets so
# far, it is derived again.
NOTHING = 1e-3


def sizes_of(definition: EnvironmentDefinition, samples: Samples) -> list[float]:
    """Return the size of each output (O,): its standard deviation over the samples, or its absolute mean if it never
    varied."""
    targets = _targets(definition, samples)
    spread, mean = targets.std(0, correction=0), targets.mean(0).abs()
    return torch.where(spread > 0, spread, torch.where(mean > 0, mean, 1.0)).tolist()


def default_tolerances(definition: EnvironmentDefinition, sizes: Sequence[float]) -> tuple[float, ...]:
    """Return the default tolerances (O,) of outputs with these ``sizes`` (O,) (standard deviations): 5 % of the size,
    or 1 if the design's ``tolerance`` is `raw`."""
    if definition.design.tolerance == "raw":
        return (1.0,) * len(sizes)
    floors = _floors(definition)
    return tuple(TOLERANCE * max(size, floor) for size, floor in zip(sizes, floors, strict=True))


@dataclass(frozen=True)
class DefaultTolerances:
    """Default tolerances of all O outputs of a design. They are used for outputs without a declared tolerance."""

    values: tuple[float, ...] = ()  # (O,) in each output's unit; empty before the first round
    ranges: tuple[float, ...] = ()  # (O,) ranges of the targets from which the values were computed


def frozen_tolerances(
    definition: EnvironmentDefinition, samples: Samples, before: DefaultTolerances
) -> DefaultTolerances:
    """Return the default tolerances of a round: those of the previous round, ``before``, unless they have to change.

    They are computed from the samples of the first round. For an output whose range of targets has grown by a factor of
    more than 1 / ``NOTHING`` since then, they are computed again. With snapshots they increase whenever the samples of
    a round give a larger tolerance. Tolerances that were stored without ranges don't change. Ranges don't include
    rewards of terminating steps, because the reward's process does not model these.
    """
    sizes, ranges = sizes_of(definition, samples), _ranges(definition, samples)
    current = default_tolerances(definition, sizes)
    if not before.values:
        return DefaultTolerances(current, ranges)
    if not before.ranges or definition.design.tolerance == "raw":
        return before
    old, now = zip(before.values, before.ranges, strict=True), zip(current, ranges, strict=True)
    pairs = [_later(last, new, grows=definition.snapshots) for last, new in zip(old, now, strict=True)]
    return DefaultTolerances(tuple(tolerance for tolerance, _ in pairs), tuple(width for _, width in pairs))


def _later(last: tuple[float, float], new: tuple[float, float], *, grows: bool) -> tuple[float, float]:
    """Return the ``last`` pair of tolerance and range of an output, or the ``new`` pair if the range has grown by a
    factor of more than 1 / ``NOTHING``.

    With ``grows`` the pair with the larger tolerance is returned otherwise.
    """
    if new[1] * NOTHING > last[1]:
        return new
    return max(last, new) if grows else last


def _ranges(definition: EnvironmentDefinition, samples: Samples) -> tuple[float, ...]:
    """Return the range of each output's targets over non-terminating steps, (O,); 0 if it is a rounding error."""
    targets = _targets(definition, samples)[~samples.terminated]
    if not len(targets):
        return (0.0,) * len(definition.outputs)
    width, size = targets.amax(0) - targets.amin(0), targets.abs().amax(0)
    return tuple(torch.where(width > FLOOR * size, width, 0.0).tolist())


def _targets(definition: EnvironmentDefinition, samples: Samples) -> Tensor:
    return torch.cat([increments(definition, samples), samples.reward[:, None]], -1)


def _floors(definition: EnvironmentDefinition) -> list[float]:
    """Return the smallest size (standard deviation) of each output (O,) that is not a rounding error. It is 0 for the
    reward, and for outputs that are observation entries."""
    if definition.moves_observation:
        return [0.0] * len(definition.outputs)
    return [FLOOR * scaling(definition.coordinates[i].sampling)[1] for i in definition.moving] + [0.0]
