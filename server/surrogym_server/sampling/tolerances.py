"""Default tolerances: 5 % of each output's standard deviation over the initial design.

Default tolerances stay the same after the first round, so that a design does not change its own goal. There are three
exceptions, because few samples can be misleading. A standard deviation that may be a rounding error is replaced by a
lower limit. A tolerance is computed again when later samples cover a far larger range. With snapshots the initial
design stays near the resets, so a tolerance grows with the samples' standard deviation.
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
# Changes of a coordinate below this share of the standard deviation of its sampling range are rounding errors.
FLOOR = 1e-9
# If the samples from which a default tolerance was computed cover less than this share of the output's range over all
# samples so far, the tolerance is computed again.
NOTHING = 1e-3


def sizes_of(definition: EnvironmentDefinition, samples: Samples) -> list[float]:
    """Return the size of each output (O,): its standard deviation over the samples, or its absolute mean if it never
    varied, or 1 if it was always 0."""
    targets = _targets(definition, samples)
    spread, mean = targets.std(0, correction=0), targets.mean(0).abs()
    return torch.where(spread > 0, spread, torch.where(mean > 0, mean, 1.0)).tolist()


def default_tolerances(definition: EnvironmentDefinition, sizes: Sequence[float]) -> tuple[float, ...]:
    """Return the default tolerances (O,) of outputs with these ``sizes`` (O,), their standard deviations: 5 % of the
    size, or 1 if the design's ``tolerance`` is `raw`."""
    if definition.design.tolerance == "raw":
        return (1.0,) * len(sizes)
    floors = _floors(definition)
    return tuple(TOLERANCE * max(size, floor) for size, floor in zip(sizes, floors, strict=True))


@dataclass(frozen=True)
class DefaultTolerances:
    """Default tolerances of all O outputs of a design. They are used for outputs without a declared tolerance."""

    values: tuple[float, ...] = ()  # (O,) tolerance of each output, in its unit; empty before the first round
    ranges: tuple[float, ...] = ()  # (O,) largest less smallest value of each output when its tolerance was computed


def frozen_tolerances(
    definition: EnvironmentDefinition, samples: Samples, before: DefaultTolerances
) -> DefaultTolerances:
    """Return the default tolerances of a round: those of the previous round, ``before``, unless they have to change.

    They are computed from the samples of the first round. If the range of an output's values has grown since then by a
    factor of more than 1 / ``NOTHING`` (1,000), its tolerance is computed again. With snapshots a tolerance also
    increases whenever the samples of a round give a larger one. Tolerances that were stored without ranges don't
    change. Ranges don't include rewards of terminating steps, because the process of the reward does not model these.
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
    """Return the pair of tolerance and range of an output that a round uses: the ``new`` pair if the range has grown by
    a factor of more than 1 / ``NOTHING`` (1,000); otherwise the ``last`` pair, that of the previous round, or, if
    ``grows``, the pair with the larger tolerance.
    """
    if new[1] * NOTHING > last[1]:
        return new
    return max(last, new) if grows else last


def _ranges(definition: EnvironmentDefinition, samples: Samples) -> tuple[float, ...]:
    """Return the largest less the smallest value of each output over non-terminating steps, (O,); 0 if the difference
    is a rounding error."""
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
