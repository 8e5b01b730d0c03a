"""A log into a surrogate: read, checked, drafted, and sent in batches that may be sent again."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from surrogym_client.logs.columns import Roles, roles_by_file, roles_by_map, roles_by_name
from surrogym_client.logs.drafting import Draft, draft, wrapped
from surrogym_client.logs.errors import UnusableLog
from surrogym_client.logs.reading import read
from surrogym_client.logs.rewards import declared_reward
from surrogym_client.logs.rows import rows_of
from surrogym_client.logs.table import Bools, Floats, Table
from surrogym_client.logs.too_few import TooFewSteps, require_steps
from surrogym_client.logs.transitions import Transitions, transitions_of
from surrogym_client.logs.units import require_units
from surrogym_client.original.terms import terminates
from surrogym_client.transport.api import Api
from surrogym_shared.spec import BoxAction, EnvironmentSpec
from surrogym_shared.spec.base import NAME_PATTERN
from surrogym_shared.wire import NewSample

BATCH = 2_000  # steps between two reports of progress
SAMPLER = "log"

Progress = Callable[[float, str], None]
Mapping_ = Mapping[str, Any]


@dataclass(frozen=True)
class ReadLog:
    """A log whose rows were checked.

    Attributes:
        table: as it was read.
        roles: what its columns are.
        steps: what can be used of it.
        spec: the specification that it was checked against, or that was drafted from it.
        notes: what the draft was concluded from; none where a specification was given.
    """

    table: Table
    roles: Roles
    steps: Transitions
    spec: EnvironmentSpec
    notes: tuple[str, ...] = ()

    @cached_property
    def rejected(self) -> list[tuple[int, str]]:
        """The line and the reason of each row that was set aside."""
        return [(int(self.table.lines[row]), reason) for row, reason in self.steps.rejected.items()]

    @property
    def ignored(self) -> dict[str, str]:
        """The columns and arrays of the file that are not used, with the reason."""
        return {**self.table.ignored, **dict.fromkeys(self.roles.ignored, "it has no role")}

    def write_rejected(self, path: Path) -> None:
        """Write the rows that were set aside as CSV: line, reason, and the row as it stands in the log."""
        _write_rejected(path, self.table, self.steps)


@dataclass(frozen=True)
class Imported:
    """What an import came to.

    Attributes:
        log: the log, with its specification and the rows that were set aside.
        surrogate: where its steps went; None where nothing was sent.
        sent: usable steps.
        duplicates: of them were there before.
        rejected_file: where the rows are that were set aside; None where there is none.
    """

    log: ReadLog
    surrogate: str | None = None
    sent: int = 0
    duplicates: int = 0
    rejected_file: Path | None = None

    @property
    def taken(self) -> int:
        """Steps that are new to the surrogate."""
        return self.sent - self.duplicates


@dataclass(frozen=True)
class Options:
    """How a log is read. Raises nothing by itself."""

    mapping: Path | Mapping_ | None = None  # file, or what stands in one; None goes by the names of the columns
    spec: EnvironmentSpec | None = None  # that the log is checked against; None drafts one
    budget: int = 0  # of a drafted one
    name: str = ""  # of its environment; the file's by default
    progress: Progress = field(default=lambda _share, _words: None)


def read_log(path: str | Path, options: Options | None = None) -> ReadLog:
    """Read a log and check its rows; nothing is sent.

    Raises:
        UnusableLog: no log, or columns without a clear role.
        TooFewSteps: no usable step, or a single one where a specification is to be drafted.
        OSError: a file can't be read.
    """
    path, options = Path(path), options or Options()
    options.progress(0.0, f"reading {path}")
    table = read(path)
    roles = _roles(table, options.mapping)
    if options.spec is not None:
        roles = _of_spec(roles, options.spec)
    options.progress(0.1, f"checking {len(table)} rows")
    rows = rows_of(table, roles, options.spec)
    if options.spec is not None:
        require_units(rows.q, options.spec)
    steps = transitions_of(rows)
    if options.spec is None:
        require_steps(table, steps, 2)
        drafted: Draft = draft(roles, steps, options.name or path.stem, options.budget)
        return ReadLog(table, roles, _shaped(drafted.spec, roles, steps), drafted.spec, drafted.notes)
    steps = _consistent(options.spec, _shaped(options.spec, roles, steps))
    require_steps(table, steps, 1)
    return ReadLog(table, roles, steps, options.spec)


def send(api: Api, name: str, log: ReadLog, progress: Progress = lambda _share, _words: None) -> tuple[int, int]:
    """Send the usable steps of a log to a surrogate; returns how many, and how many were there before.

    It may be interrupted, and sent again: a step that is there is not stored twice.
    """
    steps, duplicates = log.steps, 0
    reward = steps.reward
    if reward is None:
        reward = declared_reward(log.spec, steps.q, steps.u, steps.q_next, steps.terminated)
    for first in range(0, len(steps), BATCH):
        rows = range(first, min(first + BATCH, len(steps)))
        batch = [_sample(steps, reward, row) for row in rows]
        added = api.add_samples(name, SAMPLER, batch, purpose="logged", complete=rows.stop == len(steps))
        duplicates += added.duplicates
        progress(rows.stop / len(steps), f"{rows.stop} of {len(steps)} steps stored")
    return len(steps), duplicates


def import_log(
    path: str | Path,
    *,
    register: str | None = None,
    to: str | None = None,
    mapping: str | Path | Mapping_ | None = None,
    spec: EnvironmentSpec | None = None,
    budget: int = 0,
    rejected: str | Path | None = None,
    url: str | None = None,
    token: str | None = None,
    progress: Progress = lambda _share, _words: None,
) -> Imported:
    """Check a log of real steps, and give its usable steps to a surrogate on a server.

    Args:
        path: CSV, NPZ or Parquet, or the name of a Minari data set.
        register: name of a new surrogate, with the drafted specification, or with ``spec``.
        to: name of a surrogate that is there, by whose specification the rows are checked.
        mapping: what the columns are: a JSON or TOML file, or the same as a dictionary; None goes by their names.
        spec: the specification that the rows are checked against; None drafts one.
        budget: real steps that the design of a drafted one may ask for; 0 where there is no machine.
        rejected: where the rows go that can't be used; by default beside the log.
        url, token: of the server, as ``Api`` takes them.
        progress: called with a share in [0, 1] and a few words.

    Raises:
        ValueError: both ``register`` and ``to``, or ``to`` with ``spec``.
        UnusableLog: no log, columns without a clear role, or ``register`` is no name of a surrogate.
        TooFewSteps: no usable step, or a single one where a specification is to be drafted.
        SurrogymClientError: as every request.

    Examples:
        >>> import_log("reactor.csv", register="reactor").taken
    """
    if (register is not None and to is not None) or (to is not None and spec is not None):
        raise ValueError("expected one of register and to, and spec only without to")
    if register is not None and not re.match(NAME_PATTERN, register):
        raise UnusableLog(
            "expected a name of at most 64 letters, digits, '.', '_' and '-' for the surrogate, with a letter or digit "
            f"first, got {register!r}"
        )
    given = Path(mapping) if isinstance(mapping, str) else mapping
    options = Options(given, spec, budget, progress=lambda share, words: progress(0.3 * share, words))
    if register is None and to is None:
        log, kept = _read_or_keep(Path(path), options, rejected)
        return Imported(log, rejected_file=kept)
    with Api(url, token) as api:
        if to is not None:
            options = replace(options, spec=api.surrogate(to).spec)
        log, kept = _read_or_keep(Path(path), options, rejected)
        if register is not None:
            api.create_surrogate(register, log.spec)
        name = register or to or ""
        sent, duplicates = send(api, name, log, lambda share, words: progress(0.3 + 0.7 * share, words))
    return Imported(log, name, sent, duplicates, kept)


def keep_rejected(path: Path, log: ReadLog, where: str | Path | None = None) -> Path | None:
    """Write the rows that were set aside beside the log; None where there are none and no such file stands there."""
    return _keep(path, log.table, log.steps, where)


def _keep(path: Path, table: Table, steps: Transitions, where: str | Path | None) -> Path | None:
    path = path if path.name else path.resolve()  # "." is the folder of a data set too
    file = Path(where) if where is not None else path.with_name(f"{path.stem}.rejected.csv")
    if not steps.rejected and not file.exists():
        return None
    _write_rejected(file, table, steps)
    return file


def _read_or_keep(path: Path, options: Options, where: str | Path | None) -> tuple[ReadLog, Path | None]:
    """The log, and the file of the rows that were set aside, which is written in any case."""
    try:
        log = read_log(path, options)
    except TooFewSteps as error:
        file = _keep(path, error.table, error.steps, where)
        words = f"{error}; all of these rows are in {file}" if error.steps.rejected else str(error)
        raise TooFewSteps(words, error.table, error.steps) from error
    return log, keep_rejected(path, log, where)


def _write_rejected(path: Path, table: Table, steps: Transitions) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["line", "reason", *table.names])
        for row, reason in steps.rejected.items():
            writer.writerow([table.lines[row], reason, *table.row(row)])


def _roles(table: Table, mapping: Path | Mapping_ | None) -> Roles:
    if mapping is None:
        return roles_by_name(table.names)
    if isinstance(mapping, Path):
        return roles_by_file(mapping, table.names)
    return roles_by_map(mapping, table.names)


def _of_spec(roles: Roles, spec: EnvironmentSpec) -> Roles:
    """The roles with the coordinates of a specification, in its order; other states are ignored."""
    if missing := [name for name in spec.coordinate_names if name not in roles.state]:
        raise UnusableLog(
            f"expected the coordinates {list(spec.coordinate_names)} of the specification, got {list(roles.state)}: "
            f"{missing[0]!r} is missing; name the columns in a mapping file (--map)"
        )
    if len(roles.action) != spec.action.size:
        raise UnusableLog(f"expected {spec.action.size} columns of the action, got {list(roles.action.values())}")
    if roles.reward is None and spec.reward.kind == "learned":
        raise UnusableLog("expected a column of the reward, which the specification has learned, got none")
    return replace(
        roles,
        state={name: roles.state[name] for name in spec.coordinate_names},
        following={name: roles.following[name] for name in spec.coordinate_names} if roles.following else {},
        ignored=(*roles.ignored, *(one for name, one in roles.state.items() if name not in spec.coordinate_names)),
    )


def _shaped(spec: EnvironmentSpec, roles: Roles, steps: Transitions) -> Transitions:
    """The steps with the coordinates of a specification alone, and their angles wrapped."""
    names = list(roles.state)
    kept = [names.index(name) for name in spec.coordinate_names]
    q, q_next = steps.q[:, kept].copy(), steps.q_next[:, kept].copy()
    for index, coordinate in enumerate(spec.coordinates):
        if coordinate.kind == "angle":
            q[:, index], q_next[:, index] = wrapped(q[:, index]), wrapped(q_next[:, index])
    return replace(steps, q=q, q_next=q_next)


def _consistent(spec: EnvironmentSpec, steps: Transitions) -> Transitions:
    """The steps but those that the specification contradicts: a discrete action that is no whole number, an end where
    none is declared, and none where one is."""
    reasons: dict[int, str] = {}
    if not isinstance(spec.action, BoxAction):
        for place in np.flatnonzero((steps.u != np.floor(steps.u)).any(1)).tolist():
            reasons[place] = f"action: expected whole numbers, got {steps.u[place].tolist()}"
    if spec.termination != "learned":
        declared = terminates(spec, steps.q_next)
        for place in np.flatnonzero(declared != steps.terminated).tolist():
            reasons.setdefault(place, _contradiction(bool(declared[place])))
    rejected = {int(steps.row[place]): reason for place, reason in reasons.items()}
    kept = np.array([place not in reasons for place in range(len(steps))], dtype=np.bool_)
    return _without(steps, kept, rejected) if reasons else steps


def _contradiction(declared: bool) -> str:
    if declared:
        return "terminated: expected 1, as a declared termination holds at the next state, got 0"
    return "terminated: expected 0, as no declared termination holds at the next state, got 1"


def _without(steps: Transitions, kept: Bools, rejected: dict[int, str]) -> Transitions:
    fields: dict[str, Any] = {
        name: getattr(steps, name)[kept] for name in ("row", "q", "u", "q_next", "terminated", "truncated", "first")
    }
    reward: Floats | None = None if steps.reward is None else steps.reward[kept]
    return replace(steps, **fields, reward=reward, rejected=dict(sorted({**steps.rejected, **rejected}.items())))


def _sample(steps: Transitions, reward: Floats, row: int) -> NewSample:
    return NewSample(
        coordinates=steps.q[row].tolist(),
        action=steps.u[row].tolist(),
        next_coordinates=steps.q_next[row].tolist(),
        reward=float(reward[row]),
        terminated=bool(steps.terminated[row]),
        truncated=bool(steps.truncated[row]),
    )
