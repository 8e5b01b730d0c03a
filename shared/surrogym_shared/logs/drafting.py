"""Draft a specification from a log, with a note for each conclusion from the data.

A column may wrap after a full turn, as an angle, a time of day or an encoder does. A jump alone is no evidence: a tank
with a siphon also empties at once. A column wraps if each value after a jump, with a whole turn added, is the one that
the motion predicts. The motion is estimated from the steps without a jump: a linear regression of the change on the
actions, the other states, the position in the turn, and the change before.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from surrogym_shared.checks import LARGEST, NARROWEST, RESOLUTION
from surrogym_shared.logs.columns import SECONDS, Roles, heading
from surrogym_shared.logs.table import Bools, Floats, Ints, UnusableLog
from surrogym_shared.logs.transitions import Transitions
from surrogym_shared.spec import (
    Bounds,
    BoxAction,
    Coordinate,
    DeclaredReward,
    Design,
    DiscreteAction,
    EnvironmentSpec,
    Fixed,
    MultiDiscreteAction,
    ObservationEntry,
    Reward,
    RewardTerm,
    Term,
    Uniform,
)

MARGIN = 0.05  # a drafted sampling range is wider than the data by this share of their width on each side
SATURATED_ROWS = 5  # an extreme value of a column counts as a limit only if this many steps end exactly there
SATURATED_SHARE = 0.002  # an extreme value counts as a limit only if this share of all steps ends exactly there
MOST_DISCRETE = 16  # an action with more different values is not drafted as discrete
FEW_EPISODES = 2  # with fewer episodes, a log does not show the time limit and the starts of episodes
USUAL_LIMIT = 200  # drafted time limit of virtual episodes if the log does not show one
MOST_STARTS = 64
FEW_STARTS = 8  # if a log has fewer episodes, virtual episodes also start at other states of the log
SET_POINT = {"setpoint", "setpoints", "sp", "reference", "target"}  # words in the names of columns of set points
FAR = 8.0  # a note names values farther from the median than this many widths of the middle half of the data


@dataclass(frozen=True)
class Draft:
    """A drafted specification, with notes that say what its parts were concluded from."""

    spec: EnvironmentSpec
    notes: tuple[str, ...]


def draft(roles: Roles, steps: Transitions, name: str, budget: int = 0) -> Draft:
    """Draft the specification of the environment that a log was recorded in.

    Args:
        roles: roles of the columns, and declarations about them.
        steps: usable steps of the log, at least two.
        name: name of the environment.
        budget: real steps that a design may take in addition to the log.

    Raises:
        UnusableLog: no state ever moves, an action never varies, or numbers are too large or too close together.
    """
    notes: list[str] = []
    coordinates = [
        coordinate
        for index, one in enumerate(roles.state)
        if (coordinate := _coordinate(roles, steps, one, index, notes)) is not None
    ]
    if not any(c.kind != "constant" for c in coordinates):
        raise UnusableLog(
            f"expected at least one state that changes from row to row, got {list(roles.state)}, which never change: "
            "log a run in which a state moves, or name the states in a mapping file (--map)"
        )
    columns = [index for index, one in enumerate(roles.state) if one in {c.name for c in coordinates}]
    starts = {c.name: _start(c, steps, index) for c, index in zip(coordinates, columns, strict=True)}
    spec = EnvironmentSpec(
        environment=name,
        coordinates=tuple(coordinates),
        observation=tuple(entry for c in coordinates for entry in _entries_of(c)),
        action=_action(roles, steps, notes),
        start=starts,
        starts=_starts(steps, columns, coordinates),
        termination="learned" if bool(steps.terminated.any()) else (),
        time_limit=_time_limit(steps, notes),
        outside_reward=_outside_reward(steps, budget, notes),
        reward=_reward(steps, notes),
        sampling_period=_period(roles, steps),
        design=Design(budget=budget),
    )
    notes += [*_about(roles, steps), *lost_ends(steps)]
    return Draft(spec, tuple(notes))


def _coordinate(roles: Roles, steps: Transitions, name: str, index: int, notes: list[str]) -> Coordinate | None:
    before, after = steps.q[:, index], steps.q_next[:, index]
    low, high = float(min(before.min(), after.min())), float(max(before.max(), after.max()))
    if low == high:
        notes.append(f"{name}: always {low:g}, left out")
        return None
    _require_range(name, low, high)
    if _is_angle(roles, steps, name, index, notes):
        return Coordinate(name=name, kind="angle", sampling=Uniform(low=-math.pi, high=math.pi))
    if name in roles.constants or bool((before == after).all()):
        notes.append(f"{name}: a constant of each episode, as it {_why(name in roles.constants, 'never moves in one')}")
        return Coordinate(name=name, kind="constant", sampling=Uniform(low=low, high=high))
    bounds = _bounds(roles, name, after, (low, high), notes)
    ends = (-math.inf, math.inf) if bounds is None else (bounds.low, bounds.high)
    margin = MARGIN * (high - low)
    least, most = (-math.inf if ends[0] is None else ends[0]), (math.inf if ends[1] is None else ends[1])
    sampling = Uniform(low=max(low - margin, least, -LARGEST), high=min(high + margin, most, LARGEST))
    notes += [f"{name}: {remark}" for remark in _remarks(after)]
    if _is_set_point(roles, name):
        notes.append(
            f"{name}: its name is that of a set point, but it moves within an episode. It is drafted as a state whose "
            f'changes are learned. If it is a set point, declare constants = ["{name}"] in a mapping file (--map), or '
            "leave the column out of it"
        )
    return Coordinate(name=name, sampling=sampling, bounds=bounds)


def _is_set_point(roles: Roles, name: str) -> bool:
    """Whether the name of a state, or of its column, has a word for set points."""
    words = {word.lower() for one in (name, roles.state[name]) for word in heading(one).words}
    return not words.isdisjoint(SET_POINT) or {"set", "point"} <= words


def _require_range(name: str, low: float, high: float) -> None:
    """Raise ``UnusableLog`` if the values of ``name`` from ``low`` to ``high`` are too large or too close together."""
    _require_size(name, low, high)
    least = _narrowest(low, high)
    if high - low < least:
        raise UnusableLog(
            f"{name}: expected values that differ by {least:g} or more, got {low:.12g} to {high:.12g}: convert the "
            "column to another unit, or leave it out with a mapping file (--map)"
        )


def _require_size(name: str, low: float, high: float) -> None:
    if max(abs(low), abs(high)) > LARGEST:
        came = f"{low:g}" if low == high else f"{low:g} to {high:g}"
        raise UnusableLog(
            f"{name}: expected values of at most {LARGEST:g} in size, got {came}: convert the column to "
            "another unit, or remove rows with wrong values"
        )


def _narrowest(low: float, high: float) -> float:
    """Return the smallest width that a range from ``low`` to ``high`` may have in a specification."""
    return max(NARROWEST, RESOLUTION * max(abs(low), abs(high)))


def _why(is_declared: bool, evidence: str) -> str:
    return "is declared" if is_declared else evidence


def _is_angle(roles: Roles, steps: Transitions, name: str, index: int, notes: list[str]) -> bool:
    """Whether a state is an angle in radians. If the mapping has a list of angles, this list decides. Without it, the
    state is an angle if its motion continues across jumps of 2 pi."""
    if roles.angles is not None:
        if name in roles.angles:
            notes.append(f"{name}: an angle in radians, as it is declared")
        return name in roles.angles
    turn = turn_of(steps.q, steps.u, steps.q_next, steps.row, index)
    if turn is None:
        return False
    if turn.sure and turn.size == FULL_TURN:
        notes.append(f"{name}: an angle in radians, as its motion continues across jumps of a full turn")
        return True
    unit = f", as an angle or a clock in {turn.unit} does" if turn.unit else ""
    if not turn.sure:
        unit = f"{unit}, but too irregularly to tell" if unit else ", but too irregularly to tell"
    way = "declare it in angles in a mapping file (--map)"
    if turn.size != FULL_TURN:
        way = f"multiply the column by 2 pi / {turn.size:g}, and {way}"
    notes.append(f"{name}: jumps by {turn.size:g}{unit}. It is drafted as linear. If it wraps, {way}")
    return False


def _bounds(roles: Roles, name: str, after: Floats, ends: tuple[float, float], notes: list[str]) -> Bounds | None:
    """Return the limits of a coordinate: declared ones, or else its smallest and largest value in the log, ``ends``, if
    many steps end exactly there. None if it has no limit."""
    low, high = roles.limits.get(name, (None, None))
    limits = [end if _stays_at(after, end, ends) else None for end in ends]
    for side, end, declared in (("low", limits[0], low), ("high", limits[1], high)):
        if end is not None and declared is None:
            rows = int((after == end).sum())
            notes.append(f"{name}: saturates at {end:g} ({side}), where {ending(rows)} exactly")
    low, high = limits[0] if low is None else low, limits[1] if high is None else high
    return None if low is None and high is None else Bounds(low=low, high=high)


def _stays_at(after: Floats, end: float, ends: tuple[float, float]) -> bool:
    """Whether so many of the values ``after`` (m,) of a coordinate after each of m steps equal ``end``, their smallest
    or largest value, that it must be a limit. ``ends`` has both extreme values."""
    rows = int((after == end).sum())
    others = np.unique(after[(after != ends[0]) & (after != ends[1])], return_counts=True)[1]
    often = rows >= max(SATURATED_ROWS, SATURATED_SHARE * len(after))
    return bool(often and len(others) and rows > 3 * others.max())


def _start(coordinate: Coordinate, steps: Transitions, index: int) -> Uniform | Fixed:
    """Return the distribution of a coordinate at the start: its range over the first states of the log's episodes. If
    the log has only one episode, this is the range over all states."""
    begins = steps.q[steps.first, index]
    values = begins if len(begins) >= FEW_EPISODES else steps.q[:, index]
    if coordinate.kind == "angle":
        values = wrapped(values)
    low, high = float(values.min()), float(values.max())
    return Fixed(value=low) if high - low < _narrowest(low, high) else Uniform(low=low, high=high)


def _starts(steps: Transitions, columns: list[int], coordinates: list[Coordinate]) -> tuple[tuple[float, ...], ...]:
    """Return the states that virtual episodes start at: those at which episodes of the log begin.

    If the log has few episodes, these are evenly spaced states of the whole log. Ranges of the states are not enough,
    because some combinations of values within them may never have occurred.
    """
    rows = np.flatnonzero(steps.first)
    if len(rows) < FEW_STARTS:
        rows = np.arange(len(steps))
    spaced = rows[np.unique(np.linspace(0, len(rows) - 1, min(MOST_STARTS, len(rows))).round().astype(int))]
    states = steps.q[spaced][:, columns].copy()
    for index, coordinate in enumerate(coordinates):
        if coordinate.kind == "angle":
            states[:, index] = wrapped(states[:, index])
    return tuple(tuple(state) for state in states.tolist())


def _outside_reward(steps: Transitions, budget: int, notes: list[str]) -> float | None:
    """Return the reward for each step that is missing after a virtual episode has left the ranges: the log's worst
    reward. Return None if the design takes real steps, or if the log has no rewards."""
    if budget or steps.reward is None:
        return None
    worst = float(steps.reward.min())
    _require_size("the reward", worst, worst)
    notes.append(
        f"outside the ranges: a virtual episode ends, and each missing step up to the time limit pays {worst:g}, the "
        "log's worst reward"
    )
    return worst


def wrapped(angles: Floats) -> Floats:
    """Wrap angles to [-pi, pi)."""
    return np.remainder(angles + np.pi, 2 * np.pi) - np.pi


def _entries_of(coordinate: Coordinate) -> Iterator[ObservationEntry]:
    name = coordinate.name
    if coordinate.kind != "angle":
        yield ObservationEntry(name=name, term=Term.linear(**{name: 1}))
    else:
        yield ObservationEntry(name=f"cos({name})", term=Term.cos(**{name: 1}), low=-1, high=1)
        yield ObservationEntry(name=f"sin({name})", term=Term.sin(**{name: 1}), low=-1, high=1)


def _action(roles: Roles, steps: Transitions, notes: list[str]) -> BoxAction | DiscreteAction | MultiDiscreteAction:
    """Draft the action space from the values in the log.

    The action is discrete if the mapping declares this, or declares choices. Without a declaration, it is discrete if
    each column has all whole numbers from 0 to its largest value, and the columns are no one-hot code. Otherwise it is
    continuous; a note then asks about columns with few whole numbers whether these are choices.

    Raises:
        UnusableLog: a discrete action is declared, and its values are not numbered from 0; or an action never varies.
    """
    names = list(roles.action)
    codes = [np.unique(column) for column in steps.u.T]
    whole = [_are_codes(one) for one in codes]
    counts = [_count(one, roles.limits.get(name, (None, None))[1]) for name, one in zip(names, codes, strict=True)]
    numbered = [few and one[0] == 0 and len(one) == n for one, few, n in zip(codes, whole, counts, strict=True)]
    if roles.choices:
        for name in names:
            values = ", ".join(f"{number} is {value:g}" for number, value in enumerate(roles.choices[name]))
            notes.append(f"action {name}: numbered from 0, as its choices are declared: {values}")
        return _discrete([len(roles.choices[name]) for name in names])
    one_hot = steps.u.shape[1] > 1 and all(numbered) and bool((steps.u.sum(1) == 1).all() and steps.u.max() == 1)
    if one_hot and roles.discrete is None:
        notes.append(
            f"action {', '.join(names)}: one of them is 1 in each row, and the others 0, drafted as amounts: if these "
            "are choices, write the number of the choice from 0 into one column; if they are amounts, declare "
            "discrete = false in a mapping file (--map)"
        )
    elif roles.discrete is not False and all(numbered):
        for name, count in zip(names, counts, strict=True):
            notes.append(f"action {name}: one of {count}, as all values are whole numbers from 0 to {count - 1}")
        return _discrete(counts)
    if roles.discrete:
        if not all((one >= 0).all() and (one == np.floor(one)).all() for one in codes):
            raise UnusableLog(
                f"expected whole numbers from 0 for a discrete action, got {codes[0][:5].tolist()}: name the choices, "
                f"such as {declared_choices(names, codes)}"
            )
        return _discrete(counts)
    if roles.discrete is None and not one_hot:
        notes += _questions(names, codes, whole)
    return _amounts(roles, steps.u)


def _amounts(roles: Roles, values: Floats) -> BoxAction:
    """Draft a continuous action space from its values (m, F). Raises ``UnusableLog`` if an entry never varies."""
    low, high = [], []
    for index, name in enumerate(roles.action):
        ends = roles.limits.get(name, (None, None))
        least = float(values[:, index].min()) if ends[0] is None else ends[0]
        most = float(values[:, index].max()) if ends[1] is None else ends[1]
        if least == most:
            raise UnusableLog(
                f"expected an action {name!r} that varies, got only {least:g}: nothing can be learned of it; "
                "leave it out with a mapping file (--map)"
            )
        _require_range(f"the action {name!r}", least, most)
        low.append(least)
        high.append(most)
    return BoxAction(low=tuple(low), high=tuple(high))


def _are_codes(values: Floats) -> bool:
    """Whether ``values``, the different values of an action entry, are few whole numbers, which may number choices."""
    return bool(2 <= len(values) <= MOST_DISCRETE and (values == np.floor(values)).all())


def _count(values: Floats, most: float | None) -> int:
    """Return the number of choices that are numbered from 0 up to the largest of ``values``, or up to a declared limit,
    ``most``, if that is larger."""
    return int(max(values.max(), values.max() if most is None else most)) + 1


def _discrete(counts: list[int]) -> DiscreteAction | MultiDiscreteAction:
    return DiscreteAction(n=counts[0]) if len(counts) == 1 else MultiDiscreteAction(nvec=tuple(counts))


def _questions(names: list[str], codes: list[Floats], whole: list[bool]) -> Iterator[str]:
    """Yield notes that ask whether an action is discrete, because its values are few whole numbers.

    Args:
        names: names of the action entries.
        codes: different values of each entry.
        whole: whether the values of each entry are few whole numbers.
    """
    values = ", ".join(
        f"{name} of {', '.join(f'{value:g}' for value in one)}"
        for name, one, few in zip(names, codes, whole, strict=True)
        if few
    )
    if not values:
        return
    yield f"action {values}: few whole numbers, drafted as amounts, which a policy may choose between"
    if all(whole):
        yield (
            f"action: for choices, declare {declared_choices(names, codes)} in a mapping file (--map); for amounts, "
            "discrete = false"
        )
    else:
        yield "action: it has choices or amounts, not both; if these are amounts, declare discrete = false (--map)"


def declared_choices(names: list[str], codes: list[Floats]) -> str:
    """Return the line of a mapping file that declares the different values (``codes``) of each action entry as its
    choices."""
    values = ", ".join(
        f"{name} = [{', '.join(f'{value:g}' for value in one[:MOST_DISCRETE])}]"
        for name, one in zip(names, codes, strict=True)
    )
    return f"discrete = {{ {values} }}"


def _time_limit(steps: Transitions, notes: list[str]) -> int:
    if len(steps.episodes) >= FEW_EPISODES:
        return max(steps.episodes)
    notes.append(
        f"time limit: {USUAL_LIMIT} steps of a virtual episode, because the log has too few episodes to show one"
    )
    return USUAL_LIMIT


def _reward(steps: Transitions, notes: list[str]) -> Reward | DeclaredReward:
    if steps.reward is None:
        notes.append(
            "reward: no column, so it is declared as 0; declare the real one in the drafted file before training"
        )
        return DeclaredReward(kind="declared", terms=(RewardTerm(weight=0, shape="one"),))
    return Reward(timing="auto")


def _period(roles: Roles, steps: Transitions) -> float | None:
    """Return the interval between two rows in seconds, in three digits; None if the clock's unit is not known."""
    seconds = SECONDS.get(roles.units.get(roles.time or "", ""))
    if seconds is None or not steps.interval:
        return None
    return float(f"{steps.interval * seconds:.3g}")


def _about(roles: Roles, steps: Transitions) -> list[str]:
    notes = []
    if steps.interval is not None:
        unit = roles.units.get(roles.time or "", "")
        length = f"{steps.interval:g} {unit}" if unit else f"{steps.interval:g}, in the unit of {roles.time}"
        notes.append(f"sampling interval: {length}; a virtual step covers the same time")
    return notes


def lost_ends(steps: Transitions) -> list[str]:
    """Return a note if the log lacks the states in which episodes ended, so that no step shows how an episode ends."""
    if not steps.lost_ends:
        return []
    count = "1 episode ends" if steps.lost_ends == 1 else f"{steps.lost_ends} episodes end"
    return [
        f"terminated: {count} in a terminal state that the log does not have, as it has no columns of next states. So "
        "no step shows an end, a virtual episode never ends before its time limit, and a promise may be far too high: "
        "declare the termination in the drafted file (--draft) before training, or add columns of next states"
    ]


def _remarks(values: Floats) -> list[str]:
    """Return a note if some of the values (m,) lie far from the others; otherwise an empty list."""
    quarter, middle, three = np.quantile(values, [0.25, 0.5, 0.75])
    far: Bools = np.abs(values - middle) > FAR * (three - quarter) if three > quarter else np.zeros(0, dtype=np.bool_)
    if not far.any():
        return []
    worst = values[np.abs(values - middle).argmax()]
    return [f"{ending(int(far.sum()))} far from the others, up to {worst:g}; if these are faults, declare limits"]


def ending(count: int) -> str:
    """Return a number of steps with the verb "end" in its right form, such as "1 step ends" or "2 steps end"."""
    return f"{count} step ends" if count == 1 else f"{count} steps end"


def limited(spec: EnvironmentSpec) -> Mapping[str, str]:
    """Return a description of the range of each coordinate and of the action, by its name."""
    lines = {}
    for c in spec.coordinates:
        low, high = (c.sampling.low, c.sampling.high) if isinstance(c.sampling, Uniform) else c.sampling.limits
        bounds = "" if c.bounds is None else f", saturates at [{_end(c.bounds.low)}, {_end(c.bounds.high)}]"
        lines[c.name] = f"{c.kind}, {low:.6g} to {high:.6g}{bounds}"
    match spec.action:
        case BoxAction() as box:
            lines["action"] = ", ".join(f"{a:.6g} to {b:.6g}" for a, b in zip(box.low, box.high, strict=True))
        case DiscreteAction(n=n):
            lines["action"] = f"one of {n}"
        case _:
            lines["action"] = f"several of {list(spec.action.nvec)}"
    return lines


def _end(value: float | None) -> str:
    return "none" if value is None else f"{value:.6g}"


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


def turn_of(q: Floats, u: Floats, q_next: Floats, row: Ints, index: int) -> Turn | None:
    """Return the full turn after which the values of state column ``index`` wrap in m steps; None if they don't wrap.

    Args:
        q, u, q_next: state (m, C), action (m, F) and next state (m, C) of each step.
        row: number of each step (m,); a step may follow the step with the number before.
        index: the column.
    """
    before, after = q[:, index], q_next[:, index]
    change, low, high = after - before, min(before.min(), after.min()), max(before.max(), after.max())
    width = float(high - low)
    jumps = np.abs(change) > width / 2
    count = int(jumps.sum())
    if not 0 < count <= MOST_JUMPS * len(change):
        return None
    forecast, std = _motion(q, u, q_next, row, index, jumps, width)
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


def _motion(
    q: Floats, u: Floats, q_next: Floats, row: Ints, index: int, jumps: Bools, width: float
) -> tuple[Floats, float]:
    """Fit a linear model of the change of state column ``index`` to those of m steps that have no jump; ``jumps`` (m,)
    marks the others. Return the changes (m,) that it predicts for all steps, and the standard deviation of its error at
    the steps without a jump."""
    change, slow = q_next[:, index] - q[:, index], ~jumps
    follows = np.zeros(len(change), dtype=np.bool_)
    follows[1:] = (row[1:] == row[:-1] + 1) & (q[1:] == q_next[:-1]).all(1) & slow[:-1]
    earlier = np.full(len(change), float(change[slow].mean()))
    earlier[1:][follows[1:]] = change[:-1][follows[1:]]
    turn = min((turn for turn in KNOWN if FILLED * turn <= width <= turn * (1 + NEAR)), default=width)
    place = 2 * math.pi * q[:, index] / turn
    others = np.delete(q, index, 1)
    columns = [np.sin(place)[:, None], np.cos(place)[:, None], earlier[:, None], u, others]
    x = np.concatenate(columns, 1)
    x = (x - x[slow].mean(0)) / np.where(x[slow].std(0) > 0, x[slow].std(0), 1)
    x = np.concatenate([np.ones((len(x), 1)), x], 1)
    if slow.sum() < 3 * x.shape[1]:
        x = x[:, :1]
    weights = np.linalg.lstsq(x[slow], change[slow], rcond=None)[0]
    forecast = x @ weights
    left = (change - forecast)[slow]
    return forecast, float(math.sqrt((left**2).sum() / max(1, len(left) - x.shape[1])))
