"""Real steps that come in other units than those of the specification: one constant factor explains all their errors.

Shapes: n steps, C coordinates, F action entries, K = C + F + 1 columns of a step: coordinates, action and reward.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from math import inf, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.spec import EnvironmentSpec
from surrogym_trainer.evaluation.comparing import StepOfEpisode

DEGREES = 180 / pi
FACTORS = (DEGREES, 10.0, 60.0, 100.0, 1_000.0, 3_600.0, 1e6)  # between usual units of the same quantity
# the factor of rewards is estimated; it counts as another unit if it is negative, above this, or below the inverse
LEAST_FACTOR = 5.0

Array = NDArray[np.float64]


class OtherUnits(NamedTuple):
    """The columns of real steps that seem to come in other units, and the factor by which they do."""

    names: tuple[str, ...]
    factor: float

    def words(self) -> str:
        seem = "seems" if len(self.names) == 1 else "seem"
        return f"{' and '.join(self.names)} {seem} to come in other units: seen = {self.factor:.4g} times expected"


def other_units(
    spec: EnvironmentSpec, steps: Sequence[StepOfEpisode], rewards: Array, misfit: Callable[[Array, Array], float]
) -> OtherUnits | None:
    """Return the factor that explains best why real steps disagree with the model; None if no factor does, or if a
    constant offset of the same columns does as well.

    Args:
        spec: the specification.
        steps: the n steps.
        rewards: the rewards (n,) that the model predicts for them.
        misfit: returns the negative log-likelihood of the steps after each column was multiplied by a factor (K,), and
            a constant (K,) was added; infinity if they still disagree with the model.
    """
    columns = np.array([(*one.coordinates, *one.action, one.reward) for one in steps])
    none, best, least = np.zeros(columns.shape[1]), None, inf
    outputs = [*range(len(spec.coordinates)), -1]
    for places, factor in _guesses(spec, columns, rewards):
        scale = np.ones(len(none))
        scale[list(places)] = 1 / factor
        # the likelihood of the values as they came: a conversion to small values would make any error small
        left = misfit(scale, none) - len(steps) * float(np.log(np.abs(scale[outputs])).sum())
        if left < least and misfit(none + 1, (scale - 1) * columns.mean(0)) == inf:
            best, least = (places, factor), left
    if best is None:
        return None
    names = (*spec.coordinate_names, *(f"action {i}" for i in range(spec.action.size)), "reward")
    return OtherUnits(tuple(names[place] for place in best[0]), best[1])


def _guesses(spec: EnvironmentSpec, columns: Array, rewards: Array) -> Iterator[tuple[tuple[int, ...], float]]:
    """Yield columns that may come in another unit, and the factor: single ones, and angles together with their speed,
    or with all coordinates. Actions are never taken to be too large, because bounds refuse those, and because a worn
    actuator looks the same."""
    count = len(spec.coordinates)
    for factor in FACTORS:
        yield from (((place,), factor) for place in range(count))
        yield from (((place,), 1 / factor) for place in range(columns.shape[1] - 1))
    angles = [place for place, one in enumerate(spec.coordinates) if one.kind == "angle"]
    yield from (((place, other), DEGREES) for place in angles for other in range(count) if other != place)
    if angles and count > 2:
        yield tuple(range(count)), DEGREES
    factor = float(columns[:, -1] @ rewards) / max(float(rewards @ rewards), 1e-300)
    if factor and not 1 / LEAST_FACTOR <= factor <= LEAST_FACTOR:
        yield (columns.shape[1] - 1,), factor


def converted(steps: Sequence[StepOfEpisode], scale: Array, shift: Array) -> list[StepOfEpisode]:
    """Return the steps after each column was multiplied by a factor, ``scale`` (K,), and a constant, ``shift`` (K,),
    was added."""

    def moved(values: Sequence[float], first: int) -> tuple[float, ...]:
        where = slice(first, first + len(values))
        return tuple((np.array(values) * scale[where] + shift[where]).tolist())

    return [
        replace(
            one,
            coordinates=moved(one.coordinates, 0),
            action=moved(one.action, len(one.coordinates)),
            next_coordinates=moved(one.next_coordinates, 0),
            reward=float(one.reward * scale[-1] + shift[-1]),
        )
        for one in steps
    ]
