"""Measurement of how many of a policy's states are far from the data of a log, and search for an end of a sampling
range that a policy often exceeds. All functions are pure.

Shapes: n logged steps, m steps of the policy, C coordinates, F action entries.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.kinds import Side
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.spec.coordinates import Coordinate, limits
from surrogym_trainer.evaluation.audit import on_one_scale
from surrogym_trainer.policies.evidence import RangeLeft

USUAL = 0.99  # the spacing of a log is this quantile of the distances from each logged step to the nearest other one
# a step of the policy lies outside the log if every logged step is farther away than this multiple of the log's spacing
FARTHER = 2.0
# no warning is given if at most this share of the policy's steps lies outside the log, or of its states beyond an end
# of a sampling range
LITTLE = 0.05
MOST = 2_000  # at most this number of logged steps is compared with at most this number of steps of the policy
AT_ONCE = 256  # to limit memory, distances are computed for this number of steps at once

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Outside:
    """The part of a policy's steps that is far from a log.

    Attributes:
        share: share of the policy's steps that are far from every logged one.
        name: the coordinate that leaves the range of the log in at least half of these steps; empty if there is none.
        way: smallest and largest value of this coordinate in these steps of the policy.
        log: smallest and largest value of this coordinate in the log.
    """

    share: float
    name: str = ""
    way: tuple[float, float] = (0.0, 0.0)
    log: tuple[float, float] = (0.0, 0.0)

    @property
    def much(self) -> bool:
        return self.share > LITTLE

    def words(self) -> str:
        """Return a sentence about the part of the policy's steps that is outside the log."""
        where = ""
        if self.name:
            where = (
                f", with {self.name} between {self.way[0]:.4g} and {self.way[1]:.4g} "
                f"(the log: {self.log[0]:.4g} to {self.log[1]:.4g})"
            )
        return f"{100 * self.share:.0f} % of the policy's steps lie outside the log{where}"


def outside_of(spec: EnvironmentSpec, q: Array, u: Array, way_q: Array, way_u: Array) -> Outside:
    """Compare the states and actions of a policy with a log.

    Args:
        spec: specification of the environment.
        q, u: logged states (n, C) and actions (n, F).
        way_q, way_u: states (m, C) that the policy visits, and its actions (m, F) there.
    """
    kept, walked = _thinned(len(q)), _thinned(len(way_q))
    logged_q, passed_q = q[kept], way_q[walked]
    scaled = on_one_scale(
        spec, np.concatenate([logged_q, passed_q]), np.concatenate([u[kept], way_u[walked]]), len(kept)
    )
    logged, passed = scaled[: len(kept)], scaled[len(kept) :]
    limit = FARTHER * float(np.quantile(_nearest(logged, logged, itself=True), USUAL))
    far = _nearest(passed, logged) > limit
    if not far.any():
        return Outside(0.0)
    low, high = logged_q.min(0), logged_q.max(0)
    beyond = ((passed_q[far] < low) | (passed_q[far] > high)).sum(0)
    worst = int(np.argmax(beyond))
    share = float(far.mean())
    if beyond[worst] < far.sum() / 2:
        # no single coordinate leaves the log's range, so the cause is a gap, several coordinates together, or the
        # action
        return Outside(share)
    values = passed_q[far, worst]
    ends = (float(values.min()), float(values.max()))
    return Outside(share, spec.coordinate_names[worst], ends, (float(low[worst]), float(high[worst])))


def _thinned(count: int) -> NDArray[np.intp]:
    """Return at most ``MOST`` of ``count`` row numbers, evenly spaced."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST)).astype(np.intp))


def _nearest(points: Array, to: Array, *, itself: bool = False) -> Array:
    """Return the distance (k,) from each of k ``points`` to the nearest point in ``to``. If both are the same points,
    ``itself`` leaves out the distance of a point to itself."""
    found = np.empty(len(points))
    for first in range(0, len(points), AT_ONCE):
        rows = points[first : first + AT_ONCE]
        squares = (rows**2).sum(1)[:, None] + (to**2).sum(1) - 2 * rows @ to.T
        if itself:
            squares[np.arange(len(rows)), first + np.arange(len(rows))] = np.inf
        found[first : first + len(rows)] = np.sqrt(np.maximum(squares.min(1), 0.0))
    return found


# no warning is given if the original environment can be set to all but this share of a policy's states
MOST_UNTESTABLE = 0.2
SIDES: tuple[Side, ...] = ("lower", "upper")


def range_left(spec: EnvironmentSpec, q: Array) -> RangeLeft | None:
    """Return the end of a sampling range that a policy's states q (m, C) exceed most often; None if no end is exceeded
    by more than a share of ``LITTLE`` of the states.

    Angles have no ends. Constants and lags are not tested, because they follow from the other coordinates.
    """
    found = [_left(coordinate, values, side) for coordinate, values in _with_ends(spec, q) for side in SIDES]
    worst = max(found, key=lambda one: one.share, default=None)
    return worst if worst is not None and worst.share > LITTLE else None


def untestable(spec: EnvironmentSpec, q: Array) -> tuple[str, float] | None:
    """Return the coordinate that most often prevents the original environment from being set to a policy's states q (m,
    C), and the share of these states, which no audit can test.

    None if the share is at most ``MOST_UNTESTABLE``, or if the environment can't be set to any state. Angles, constants
    and lags are left out.
    """
    if spec.query == "rollout":
        return None
    found = [(coordinate.name, _beyond(coordinate.settable, values)) for coordinate, values in _with_ends(spec, q)]
    worst = max(found, key=lambda one: one[1], default=None)
    return worst if worst is not None and worst[1] > MOST_UNTESTABLE else None


def _with_ends(spec: EnvironmentSpec, q: Array) -> list[tuple[Coordinate, Array]]:
    """Return the coordinates whose sampling range has ends, each with its values (m,)."""
    return [(c, q[:, i]) for i, c in enumerate(spec.coordinates) if c.kind == "linear" and c.moves]


def _beyond(ends: tuple[float, float], values: Array) -> float:
    return float(((values < ends[0]) | (values > ends[1])).mean())


def _left(coordinate: Coordinate, values: Array, side: Side) -> RangeLeft:
    low, high = limits(coordinate.sampling)
    end, beyond = (low, values < low) if side == "lower" else (high, values > high)
    farthest = values.min() if side == "lower" else values.max()
    return RangeLeft(
        coordinate=coordinate.name, side=side, end=end, share=float(beyond.mean()), farthest=float(farthest)
    )
