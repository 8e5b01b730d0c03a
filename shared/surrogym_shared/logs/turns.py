"""Evidence that a column of a log wraps after a full turn, as an angle, a time of day or an encoder does.

A jump alone is no evidence: a tank with a siphon also empties at once. A column wraps if each value after a jump, with
a whole turn added, is the one that the motion predicts. The motion is estimated from the steps without a jump: a linear
regression of the change on the actions, the other states, the position in the turn, and the change before.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from surrogym_shared.logs.table import Bools, Floats
from surrogym_shared.logs.transitions import Transitions

FULL_TURN = 2 * math.pi
KNOWN = {FULL_TURN: "radians", 360.0: "degrees", 400.0: "gon", 1.0: "turns", 24.0: "hours", 60.0: "minutes"} | {
    float(2**bits): "counts" for bits in range(8, 25)
}
FILLED = 0.8  # a column wraps only if its values cover at least this share of a full turn
# A column wraps only if at most this share of its steps are jumps (more than half the column's width).
MOST_JUMPS = 1 / 3
# A column that wraps jumps by a full turn, apart from its predicted change. A jump may differ from a full turn plus the
# predicted change by this many standard deviations of the prediction.
CONTINUES = 4.0
# If the motion is not linear, a jump may differ from a full turn plus the predicted change by this share of a usual
# change.
ROUGHLY = 0.1
# A column wraps only if at most this share of its jumps differs by more from a full turn plus the predicted change.
OUTLIERS = 0.05
BY_CHANCE = 1e-3  # a column certainly wraps if the probability that its jumps equal full turns by chance is below this
NEAR = 1e-3  # the median jump may differ from a known full turn, such as 360 degrees, by this share of the turn
# The standard deviation of the prediction is taken to be at least this share of the width of the column's values.
FINEST = 1e-6


@dataclass(frozen=True)
class Turn:
    """Full turn after which the values of a column wrap, such as 360 for an angle in degrees.

    Attributes:
        size: size of the full turn, in the unit of the column.
        unit: name of the unit in which a full turn has this size, such as degrees; empty if the unit is unknown.
        sure: whether the jumps agree with full turns so closely that this is hardly by chance.
    """

    size: float
    unit: str
    sure: bool


def turn_of(steps: Transitions, index: int) -> Turn | None:
    """Return the full turn after which the values of state column ``index`` wrap; None if they don't wrap."""
    before, after = steps.q[:, index], steps.q_next[:, index]
    change, low, high = after - before, min(before.min(), after.min()), max(before.max(), after.max())
    width = float(high - low)
    jumps = np.abs(change) > width / 2
    count = int(jumps.sum())
    if not 0 < count <= MOST_JUMPS * len(change):
        return None
    forecast, std = _motion(steps, index, change, jumps, width)
    std = max(std, FINEST * width)
    across = np.abs(change - forecast)[jumps]
    size = float(np.median(across))
    turns = [turn for turn in KNOWN if abs(turn - size) <= max(NEAR * turn, CONTINUES * std / math.sqrt(count))]
    whole = bool((before == np.floor(before)).all() and (after == np.floor(after)).all())
    turns = [turn for turn in turns if not (whole and turn in (1.0, FULL_TURN)) and _lies_in(low, high, turn)]
    size = min(turns, key=lambda turn: abs(turn - size), default=size)
    if width < FILLED * size:
        return None
    usual = max(float(np.quantile(np.abs(change[~jumps]), 0.95)), std)
    for within in (CONTINUES * std, max(CONTINUES * std, ROUGHLY * usual)):
        if (np.abs(across - size) > within).mean() > OUTLIERS:
            continue
        chance = min(1.0, 2 * within / usual)
        sure = chance ** (count if turns else count - 1) < BY_CHANCE
        if turns or (sure and count > 1):
            return Turn(size, KNOWN.get(size, ""), sure)
    return None


def _lies_in(low: float, high: float, turn: float) -> bool:
    """Whether values from ``low`` to ``high`` lie within one full turn that begins at 0 or is centred at 0."""
    slack = NEAR * turn
    return (low >= -slack and high <= turn + slack) or (low >= -turn / 2 - slack and high <= turn / 2 + slack)


def _motion(steps: Transitions, index: int, change: Floats, jumps: Bools, width: float) -> tuple[Floats, float]:
    """Fit a linear model of a column's change to the steps without a jump. Return the changes (m,) that it predicts for
    all steps, and the standard deviation of its error at the steps without a jump."""
    slow = ~jumps
    follows = np.zeros(len(change), dtype=np.bool_)
    follows[1:] = (steps.row[1:] == steps.row[:-1] + 1) & (steps.q[1:] == steps.q_next[:-1]).all(1) & slow[:-1]
    earlier = np.full(len(change), float(change[slow].mean()))
    earlier[1:][follows[1:]] = change[:-1][follows[1:]]
    turn = min((turn for turn in KNOWN if FILLED * turn <= width <= turn * (1 + NEAR)), default=width)
    place = 2 * math.pi * steps.q[:, index] / turn
    others = np.delete(steps.q, index, 1)
    columns = [np.sin(place)[:, None], np.cos(place)[:, None], earlier[:, None], steps.u, others]
    x = np.concatenate(columns, 1)
    x = (x - x[slow].mean(0)) / np.where(x[slow].std(0) > 0, x[slow].std(0), 1)
    x = np.concatenate([np.ones((len(x), 1)), x], 1)
    if slow.sum() < 3 * x.shape[1]:
        x = x[:, :1]
    weights = np.linalg.lstsq(x[slow], change[slow], rcond=None)[0]
    forecast = x @ weights
    left = (change - forecast)[slow]
    return forecast, float(math.sqrt((left**2).sum() / max(1, len(left) - x.shape[1])))
