"""Roles of the columns of a log (state, action, reward, ...), found by their names or declared by a mapping. The
heading of a column has a name, which consists of words, and perhaps a unit."""

from __future__ import annotations

import json
import re
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, ValidationError

from surrogym_shared.checks import LARGEST
from surrogym_shared.fail_fast import FailFast
from surrogym_shared.logs.table import UnusableLog
from surrogym_shared.spec.base import MAX_DIMENSIONS
from surrogym_shared.words import listed

UNIT = re.compile(
    r"""^(?P<name>.*?\S)\s*(?:
        \[(?P<square>(?!\d+\])[^\[\]]*)\]      # such as time [s], but not action[0]
        | \((?P<round>(?!\d+\))[^()]*)\)       # such as time (s)
        | \s/\s*(?P<slash>[^\s/]+)             # such as T / K
        | \sin\s(?P<words>\S+)                 # such as time in s
    )$""",
    re.VERBOSE,
)
WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[^\W\d_A-Z]+|\d+")
NO_UNIT = ("", "-", "--", "1")
TIMES = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds", "sek"), "s"),
    **dict.fromkeys(("ms", "msec", "millis", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "µs", "μs", "usec", "microsecond", "microseconds"), "us"),
    **dict.fromkeys(("ns", "nsec", "nanosecond", "nanoseconds"), "ns"),
    **dict.fromkeys(("min", "mins", "minute", "minutes"), "min"),
    **dict.fromkeys(("h", "hr", "hrs", "hour", "hours"), "h"),
    **dict.fromkeys(("d", "day", "days"), "d"),
}
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3_600.0, "d": 86_400.0}  # by unit of time


@dataclass(frozen=True)
class Heading:
    """Heading of a column, such as ``T [K]``.

    Attributes:
        column: the whole heading.
        name: heading without the unit, such as ``T``.
        unit: unit, such as ``K``; empty if the heading has none.
        words: words of the name in lower case, such as ``("step", "reward")`` for ``stepReward``; single letters keep
            their case, because t is a time and T a temperature.
    """

    column: str
    name: str
    unit: str
    words: tuple[str, ...]

    @property
    def plain(self) -> str:
        """Words of the name, joined by ``_``."""
        return "_".join(self.words)


def heading(column: str) -> Heading:
    """Split the heading of a column into name, words and unit."""
    match = UNIT.match(column)
    name, unit = column, ""
    if match is not None:
        name = match["name"]
        unit = next(group for group in match.groups()[1:] if group is not None).strip()
    words = tuple(word if len(word) == 1 else word.lower() for word in WORDS.findall(name))
    return Heading(column, name, "" if unit in NO_UNIT else unit, words)


def timed(one: Heading) -> Heading:
    """Return a heading whose name ends with a unit of time, as ``time_s`` and ``timestampMs`` do, with this word as its
    unit. Return other headings unchanged."""
    if one.unit or len(one.words) < 2 or one.words[-1].lower() not in TIMES:
        return one
    return Heading(one.column, one.name, one.words[-1], one.words[:-1])


SINGLE = {
    "reward": ("reward", "rewards", "rews", "r"),
    "terminated": ("terminated", "terminations", "terminal", "terminals", "done", "dones"),
    "truncated": ("truncated", "truncations", "timeout", "timeouts"),
    "episode": ("episode", "episode_id", "trajectory", "run"),
    "time": ("time", "t", "timestamp", "time_stamp", "seconds"),
}
# Names of a column that marks every end of an episode, as in Gym and Stable-Baselines3. If the log also has a column of
# timeouts, the ends that are marked there don't count as terminations.
EITHER_END = (
    "done",
    "dones",
)
SHORT_TIMES = ("s", "ms", "us", "ns")  # units of time after the letter t in a column's name: t_s is a time, t_d is not
ACTION = re.compile(r"^(?:actions?|acts?|u)(?:[._](.+)|\[(\d+)\])?$|^actions?[\s-]+(.+)$", re.IGNORECASE)
STATE = re.compile(r"^(?:q|states?|obs|observations?|coordinates?)(?:[._](.+)|\[(\d+)\])$", re.IGNORECASE)
NEXT = re.compile(r"^next[._\s-]+(.+)$|^(.+)[._\s-]+next$", re.IGNORECASE)

COLUMN, COLUMNS = "the name of a column", "a list of columns, or a table of your names and their columns"
NAMES = "a list of names of states"
EXPECTED = {
    "state": COLUMNS,
    "action": COLUMNS,
    "next": "a table of states and the columns of their next values",
    **dict.fromkeys(SINGLE, COLUMN),
    "limits": "a table of names and their two ends, such as level = [0, 2.5]",
    "angles": NAMES,
    "constants": NAMES,
    "discrete": "true, false, or a table of actions and the values of their choices, such as switch = [1, 2, 3]",
}
SHOWN = 60  # a message shows at most this many characters of a wrong value
LONGEST = 64  # largest number of characters of a coordinate's name
MOST = 1_000  # largest number of columns that a mapping may name for one role, such as state or action

Choices = Annotated[list[float], Field(min_length=2, max_length=MOST)]
Limits = Annotated[list[float | None], Field(min_length=2, max_length=2)]


@dataclass(frozen=True)
class Roles:
    """Roles of the columns of a log.

    Attributes:
        state: column of each coordinate, by the coordinate's name.
        action: column of each action entry, by the entry's name.
        following: column of each coordinate's next value, by the coordinate's name; empty without such columns.
        reward, terminated, truncated, episode, time: column with this role; None without such a column.
        limits: declared lowest and highest value of coordinates and action entries, by name; None is no limit.
        angles: names of the coordinates that are angles; None lets the data decide.
        constants: names of coordinates that are declared as constants of an episode.
        discrete: whether the action is declared as discrete; None lets the data decide.
        choices: declared values of the choices of each action entry, by its name; empty without such a declaration. The
            surrogate numbers them from 0.
        ignored: columns without a role.
        units: unit of each used column whose heading has one, by the column's name.
    """

    state: Mapping[str, str]
    action: Mapping[str, str]
    following: Mapping[str, str] = field(default_factory=dict)
    reward: str | None = None
    terminated: str | None = None
    truncated: str | None = None
    episode: str | None = None
    time: str | None = None
    limits: Mapping[str, tuple[float | None, float | None]] = field(default_factory=dict)
    angles: frozenset[str] | None = None
    constants: frozenset[str] = frozenset()
    discrete: bool | None = None
    choices: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    ignored: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)

    @property
    def used(self) -> dict[str, str]:
        """Role of each used column in words, by the column's name."""
        roles = {column: f"state {name}" for name, column in self.state.items()}
        roles |= {column: f"action {name}" for name, column in self.action.items()}
        roles |= {column: f"next state {name}" for name, column in self.following.items()}
        roles |= {column: role for role in SINGLE if (column := getattr(self, role)) is not None}
        return {
            column: f"{role} ({self.units[column]})" if column in self.units else role for column, role in roles.items()
        }

    @property
    def mapping(self) -> LogMapping:
        """Mapping that declares these roles, as a mapping file would."""
        single = {role: getattr(self, role) for role in SINGLE}
        return LogMapping(
            state=dict(self.state),
            action=dict(self.action),
            next=dict(self.following),
            limits={name: list(ends) for name, ends in self.limits.items()},
            angles=None if self.angles is None else sorted(self.angles),
            constants=sorted(self.constants),
            discrete={name: list(values) for name, values in self.choices.items()} or self.discrete,
            **single,
        )


Columns = Annotated[dict[str, str], Field(max_length=MOST)] | Annotated[list[str], Field(max_length=MOST)]


class LogMapping(FailFast):
    """Roles of the columns of a log, as a person declares them.

    ``state`` and ``action`` are lists or tables. In a list, each column is also the name of the coordinate or action
    entry. A table has the column of each coordinate or action entry by its name.
    """

    model_config = ConfigDict(extra="forbid")

    state: Columns = Field(description="column of each coordinate of the state")
    action: Columns = Field(description="column of each entry of the action")
    next: dict[str, str] = Field(
        default_factory=dict,
        max_length=MOST,
        description="column of each coordinate's next value, by the coordinate's name",
    )
    reward: str | None = Field(default=None, description="column of the reward")
    terminated: str | None = Field(
        default=None, description="column that marks steps which end the episode in a terminal state"
    )
    truncated: str | None = Field(
        default=None,
        description="column that marks steps which end the episode for another reason, such as a time limit",
    )
    episode: str | None = Field(default=None, description="column of the episode's name or number")
    time: str | None = Field(default=None, description="column of the time")
    limits: dict[str, Limits] = Field(
        default_factory=dict,
        max_length=MOST,
        description="lowest and highest value of coordinates and action entries, by name; null: no limit",
    )
    angles: Annotated[list[str], Field(max_length=MOST)] | None = Field(
        default=None, description="names of the coordinates that are angles in radians; null: the data decide"
    )
    constants: list[str] = Field(
        default_factory=list, max_length=MOST, description="names of coordinates that don't change within an episode"
    )
    discrete: bool | dict[str, Choices] | None = Field(
        default=None,
        description="whether the action is discrete and its values are numbers of choices from 0; or, for other "
        "values, the values of the choices of each action entry, by its name; null: the data decide",
    )


def roles_by_name(names: Sequence[str]) -> Roles:
    """Find the roles of columns by their names; see the how-to page on logs.

    Raises:
        UnusableLog: there are no states or no actions, or too many; or two columns have the same state, action or role.
    """
    headings = [heading(name) for name in names]
    single: dict[str, Any] = {role: _only(role, headings, names_of_role) for role, names_of_role in SINGLE.items()}
    left = [one for one in headings if one.column not in single.values()]
    action = _single("action", [(_part(match) or "0", one.column) for one in left if (match := ACTION.match(one.name))])
    left = [one for one in left if one.column not in action.values()]
    marked = _single("state", [(_part(match), one.column) for one in left if (match := STATE.match(one.name))])
    ahead = [(_part(match), one.column) for one in left if (match := NEXT.match(one.name))]
    following = _single("next state", [(_of_next(part, marked), name) for part, name in ahead])
    plain = [one for one in left if one.column not in following.values()]
    often = Counter(one.name for one in plain)
    state = marked or {one.name if often[one.name] == 1 else one.column: one.column for one in plain}
    _require(names, state, action)
    columns = {*state.values(), *action.values(), *following.values(), *single.values()}
    ignored = tuple(name for name in names if name not in columns)
    return _checked(Roles(state, action, following, **single, ignored=ignored, units=_units(names, columns)))


def _units(names: Iterable[str], columns: Iterable[str | None]) -> dict[str, str]:
    """Return the unit of each used column whose heading has a unit, by the column's name."""
    headings = {name: _as_time(heading(name)) or heading(name) for name in names if name in set(columns)}
    return {name: one.unit for name, one in headings.items() if one.unit}


def _as_time(one: Heading) -> Heading | None:
    """Return the heading of a column of times, split into name and unit; None for a heading that is not of times."""
    for quantity in (one, timed(one)):
        short = len(quantity.plain) == 1
        units = SHORT_TIMES if short and quantity is not one else TIMES
        if quantity.plain in SINGLE["time"] and (not quantity.unit or not short or quantity.unit in units):
            return quantity
    return None


def mapping_of(mapping: Path | Mapping[str, Any] | LogMapping, where: str) -> LogMapping:
    """Parse a mapping of columns to roles.

    Args:
        mapping: a JSON or TOML file, the content of one, or a parsed mapping.
        where: name of the mapping in error messages.

    Raises:
        OSError: the file can't be read.
        UnusableLog: the content is not a mapping.
    """
    if isinstance(mapping, LogMapping):
        return mapping
    return _mapped(_content(mapping) if isinstance(mapping, Path) else mapping, where)


def _content(path: Path) -> Mapping[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
        content: Mapping[str, Any] = json.loads(text) if path.suffix.lower() == ".json" else tomllib.loads(text)
    except UnicodeDecodeError as error:
        raise UnusableLog(f"expected JSON or TOML in {path}, got other bytes than UTF-8: write it in UTF-8") from error
    except RecursionError as error:
        raise UnusableLog(
            f"expected a table of columns in {path}, got lists or tables nested too deeply: write them without nesting"
        ) from error
    except ValueError as error:
        raise UnusableLog(f"expected JSON or TOML in {path}, got text with an error: {error}") from error
    return content


def roles_by_mapping(mapped: LogMapping, names: Sequence[str], where: str = "the mapping") -> Roles:
    """Find the roles of columns by a parsed mapping.

    Raises:
        UnusableLog: the mapping names a missing column, gives one column two roles, or contradicts itself.
    """
    fields: dict[str, Any] = {role: getattr(mapped, role) or None for role in SINGLE}
    state, action = _by_name(mapped.state), _by_name(mapped.action)
    columns = [*state.values(), *action.values(), *mapped.next.values(), *filter(None, fields.values())]
    if missing := [column for column in columns if column not in names]:
        raise UnusableLog(f"{where} names the column {missing[0]!r}: expected one of {listed(names)}")
    _require(names, state, action)
    _require_one_role(mapped, where)
    _require_declared(mapped, state, action, where)
    return _checked(
        Roles(
            state,
            action,
            mapped.next,
            **fields,
            limits={name: (ends[0], ends[1]) for name, ends in mapped.limits.items()},
            angles=None if mapped.angles is None else frozenset(mapped.angles),
            constants=frozenset(mapped.constants),
            discrete=mapped.discrete if not isinstance(mapped.discrete, dict) else True,
            choices=_choices(mapped, action, where),
            ignored=tuple(name for name in names if name not in columns),
            units=_units(names, columns),
        )
    )


def _choices(mapped: LogMapping, action: Mapping[str, str], where: str) -> dict[str, tuple[float, ...]]:
    """Return the declared choices of each action entry, by its name; empty if the mapping declares none.

    Raises:
        UnusableLog: some entries lack choices, or have the same choice twice.
    """
    if not isinstance(mapped.discrete, dict):
        return {}
    if set(mapped.discrete) != set(action):
        raise UnusableLog(
            f"{where}: expected discrete to list the choices of each action entry ({listed(list(action))}), got "
            "choices of "
            f"{listed(list(mapped.discrete))}"
        )
    for name, values in mapped.discrete.items():
        if len(set(values)) < len(values):
            raise UnusableLog(f"{where}: expected different choices of {name!r} in discrete, got {values}")
    return {name: tuple(mapped.discrete[name]) for name in action}


def _single(role: str, pairs: Iterable[tuple[str, str]]) -> dict[str, str]:
    """Return the column of each state or action, by the name of the state or action. Raises ``UnusableLog`` if two
    columns have the same name."""
    columns: dict[str, str] = {}
    for name, column in pairs:
        if name in columns:
            raise UnusableLog(
                f"expected one column for the {role} {name!r}, got two: {columns[name]} and {column}: rename one, or "
                "name the columns in a mapping file (--map)"
            )
        columns[name] = column
    return columns


def _require_one_role(mapped: LogMapping, where: str) -> None:
    """Raise ``UnusableLog`` if a mapping names a column twice."""
    tables = {"state": mapped.state, "action": mapped.action, "next state": mapped.next}
    pairs = [
        (f"{role} {name}", column)
        for role, columns in tables.items()
        for name, column in (columns.items() if isinstance(columns, dict) else zip(columns, columns, strict=True))
    ]
    pairs += [(role, column) for role in SINGLE if (column := getattr(mapped, role))]
    roles: dict[str, str] = {}
    for role, column in pairs:
        if column in roles:
            raise UnusableLog(f"{where}: expected one role for the column {column!r}, got {roles[column]} and {role}")
        roles[column] = role


def _require_declared(mapped: LogMapping, state: Iterable[str], action: Iterable[str], where: str) -> None:
    """Raise ``UnusableLog`` if limits, angles or constants of a mapping have unknown names or contradict each other."""
    states, actions = list(state), list(action)
    for key, entries, choices in (
        ("limits", mapped.limits, [*states, *actions]),
        ("angles", mapped.angles or (), states),
        ("constants", mapped.constants, states),
    ):
        if unknown := sorted(set(entries) - set(choices)):
            what = "one of" if key == "limits" else "one of the states"
            raise UnusableLog(f"{where} names {unknown[0]!r} in {key}: expected {what} {choices}")
    if both := sorted(set(mapped.angles or ()) & set(mapped.constants)):
        raise UnusableLog(f"{where}: expected {both[0]!r} in angles or in constants, got it in both: remove one")
    if both := sorted(set(mapped.limits) & set(states) & set(actions)):
        raise UnusableLog(
            f"{where}: expected limits of a state or of an action, got {both[0]!r}, which is both: rename one of them"
        )
    for name, (low, high) in mapped.limits.items():
        ends = [end for end in (low, high) if end is not None]
        if not all(abs(end) <= LARGEST for end in ends):
            raise UnusableLog(
                f"{where}: expected limits of {name!r} to be at most {LARGEST:g} in size, got [{low}, {high}]"
            )
        if len(ends) == 2 and ends[0] >= ends[1]:
            raise UnusableLog(f"{where}: expected limits of {name!r} with the lowest value first, got [{low}, {high}]")


def _mapped(content: Mapping[str, Any], where: str) -> LogMapping:
    """Parse a mapping. The error names everything that is wrong with it."""
    if not isinstance(content, Mapping):
        raise UnusableLog(f"expected a table with the keys state and action in {where}, got {_short(content)}")
    try:
        return LogMapping.model_validate(content)
    except ValidationError as error:
        keys = dict.fromkeys(str(fault["loc"][0]) for fault in error.errors())
        faults = "; ".join(_fault(key, content) for key in keys)
        raise UnusableLog(f"{where} is not a mapping of columns: {faults}") from error


def _fault(key: str, content: Mapping[str, Any]) -> str:
    if key not in EXPECTED:
        return f"expected the keys {', '.join(EXPECTED)}, got {key!r}"
    if key not in content:
        return f"expected the key {key} with {EXPECTED[key]}, got none"
    return f"{key}: expected {EXPECTED[key]}, got {_short(content[key])}"


def _short(value: object) -> str:
    try:
        text = repr(value)
    except RecursionError:
        text = "a value that is nested too deeply"
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def _checked(roles: Roles) -> Roles:
    """Return the roles if they are consistent: at most ``MAX_DIMENSIONS`` states and actions, and next states of all
    coordinates or of none. Otherwise raise ``UnusableLog``."""
    for what, names in (("states", roles.state), ("actions", roles.action)):
        if len(names) > MAX_DIMENSIONS:
            raise UnusableLog(
                f"expected at most {MAX_DIMENSIONS} {what}, got {len(names)}: choose some in a mapping file (--map)"
            )
    if long := [name for name in roles.state if not 1 <= len(name) <= LONGEST]:
        raise UnusableLog(
            f"expected names of states with 1 to {LONGEST} characters, got {long[0]!r}: rename it in a mapping file "
            "(--map)"
        )
    if roles.following and set(roles.following) != set(roles.state):
        odd = sorted(set(roles.following) ^ set(roles.state))[0]
        raise UnusableLog(
            f"expected columns of the next state for all states ({listed(roles.state)}) or for none, got columns for "
            f"{listed(roles.following)} ({odd!r} is only in one of the lists): name the columns in a mapping file "
            "(--map)"
        )
    for name, column in roles.following.items():
        unit, other = roles.units.get(roles.state[name], ""), roles.units.get(column, "")
        if unit and other and unit != other:
            raise UnusableLog(
                f"expected the next state {name!r} in {unit}, as {roles.state[name]!r} is, got {column!r}: convert"
                " the column"
            )
    return roles


def _require(names: Iterable[str], state: Mapping[str, str], action: Mapping[str, str]) -> None:
    for what, columns, example in (("action", action, "action_valve"), ("state", state, "state_temperature")):
        if not columns:
            raise UnusableLog(
                f"expected a column of the {what}, such as {example}, got {listed(names)}: rename it, or name the "
                "columns in a mapping file (--map)"
            )


def _only(role: str, headings: Iterable[Heading], names: Sequence[str]) -> str | None:
    """Return the column whose heading is one of the known ``names`` of a role; None if there is no such column. Raises
    ``UnusableLog`` if there are several.

    Case only matters for single letters: t is a time, T a temperature. A letter with a physical unit is a quantity.
    """
    if role == "time":
        columns = [one.column for one in headings if _as_time(one) is not None]
    else:
        columns = [one.column for one in headings if one.plain in names and not (len(one.plain) == 1 and one.unit)]
    if len(columns) > 1:
        raise UnusableLog(
            f"expected one column for the role {role}, got {' and '.join(columns)}: rename one, or name the "
            "columns in a mapping file (--map)"
        )
    return columns[0] if columns else None


def _of_next(part: str, states: Mapping[str, str]) -> str:
    """Return the name of the state whose next value a column has. ``part`` is the column's name without the mark of a
    next state, such as ``q_0`` for the column ``next.q_0``. The name is ``q_0`` if there is a state of this name,
    otherwise ``0``."""
    return part if part in states else _part(STATE.match(part)) or part


def _part(match: re.Match[str] | None) -> str:
    """Return the first group of a match that is not empty: the part of a column's name without the prefix or ending
    that marks its role. Empty without a match."""
    return "" if match is None else next((part for part in match.groups() if part), "")


def _by_name(columns: dict[str, str] | list[str]) -> dict[str, str]:
    return columns if isinstance(columns, dict) else {name: name for name in columns}
