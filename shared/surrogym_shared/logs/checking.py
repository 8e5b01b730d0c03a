"""Check the rows of a log against a specification, or draft a specification from them."""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from surrogym_shared.faults import first_fault
from surrogym_shared.logs.columns import Roles
from surrogym_shared.logs.drafting import Draft, declared_choices, draft, lost_ends, wrapped
from surrogym_shared.logs.rewards import declared_reward
from surrogym_shared.logs.rows import require_period, require_units, rows_of, unit_notes
from surrogym_shared.logs.table import Bools, Floats, Table, UnusableLog
from surrogym_shared.logs.transitions import Transitions, require_steps, transitions_of
from surrogym_shared.logs.writing import spreadsheet_cell
from surrogym_shared.spec import BoxAction, EnvironmentSpec
from surrogym_shared.terms import terminates

SHOWN = 8  # an error message shows at most this many different values of a column
HEADING = ("line", "reason")  # first columns of a CSV file of rejected rows, before the columns of the log
OURS = ",".join(HEADING).encode() + b","


@dataclass(frozen=True)
class ReadLog:
    """A log whose rows were checked.

    Attributes:
        table: the log as it was read.
        roles: roles of its columns.
        steps: usable steps of the log.
        spec: the specification that the log was checked against, or that was drafted from the log.
        notes: sentences on how the file was read, on the order of the rows, and on the reasons for a drafted
            specification.
    """

    table: Table
    roles: Roles
    steps: Transitions
    spec: EnvironmentSpec
    notes: tuple[str, ...] = ()

    @cached_property
    def rejected(self) -> list[tuple[int, str]]:
        """Line and reason of each row that was set aside."""
        return [(int(self.table.lines[row]), reason) for row, reason in self.steps.rejected.items()]

    @property
    def ignored(self) -> dict[str, str]:
        """Reason for each column or array of the file that is not used."""
        return {**dict.fromkeys(self.roles.ignored, "it has no role"), **self.table.ignored}

    @cached_property
    def reward(self) -> Floats:
        """Rewards of the usable steps (m,), from the log, or from the declared reward if the log has none."""
        steps = self.steps
        if steps.reward is not None:
            return steps.reward
        return declared_reward(self.spec, steps.q, steps.u, steps.q_next, steps.terminated)


def check_log(table: Table, roles: Roles, spec: EnvironmentSpec) -> ReadLog:
    """Check the rows of a log against a specification. Limits, choices, units, ends and the clock are not checked in
    the log of an evaluation, because the environment itself wrote it.

    Raises:
        UnusableLog: the columns don't fit the specification, or are in other units; or the interval between two rows is
            not the sampling period of the specification.
        TooFewSteps: no step is usable.
    """
    roles = _of_spec(roles, spec)
    rows = rows_of(table, roles, None if table.evaluated else spec)
    if not table.evaluated:
        _require_choices(spec, roles, rows.u)
    steps = _shaped(spec, roles, transitions_of(rows))
    units: list[str] = []
    if not table.evaluated:
        require_units(rows.q, spec)
        units = unit_notes(rows.q, spec)
        if rows.following is not None:
            require_units(rows.following, spec, "next ")
        require_period(roles, steps.interval, spec.sampling_period)
        steps = _consistent(spec, steps)
    require_steps(table, steps, 1)
    lost = lost_ends(steps) if spec.termination == "learned" else []
    return ReadLog(table, roles, steps, spec, (*table.remarks, *steps.notes, *lost, *units))


def draft_log(table: Table, roles: Roles, name: str, budget: int = 0) -> ReadLog:
    """Check the rows of a log, and draft the specification of the environment that it was recorded in.

    Args:
        table: the log as it was read.
        roles: roles of its columns.
        name: name of the environment.
        budget: real steps that a design may take in addition to the log.

    Raises:
        UnusableLog: no state ever moves, an action never varies, or a specification can't have such names or numbers.
        TooFewSteps: fewer than two steps are usable.
    """
    steps = transitions_of(rows_of(table, roles))
    require_steps(table, steps, 2)
    try:
        drafted: Draft = draft(roles, steps, name, budget)
    except ValidationError as error:
        raise UnusableLog(
            f"no valid specification can be drafted from the log: {first_fault(error)}; change the log or the mapping "
            "file"
        ) from error
    notes = (*table.remarks, *steps.notes, *drafted.notes)
    return ReadLog(table, roles, _shaped(drafted.spec, roles, steps), drafted.spec, notes)


def write_rejected(path: Path, table: Table, steps: Transitions) -> None:
    """Write the rows that were set aside as CSV: line, reason, and the cells as in the log."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*HEADING, *map(spreadsheet_cell, table.heading or table.names)])
        for row, reason in steps.rejected.items():
            writer.writerow([table.lines[row], *map(spreadsheet_cell, [reason, *table.row(row)])])


def is_of_rejected(path: Path) -> bool:
    """Whether a file is empty, or begins with the heading that ``write_rejected`` writes."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(len(OURS) + 1)
    return not head or head.startswith(OURS)


def _of_spec(roles: Roles, spec: EnvironmentSpec) -> Roles:
    """Return the roles with only those states that are coordinates of a specification, in its order."""
    if missing := [name for name in spec.coordinate_names if name not in roles.state]:
        raise UnusableLog(
            f"expected the coordinates {list(spec.coordinate_names)} of the specification, got {list(roles.state)}: "
            f"{missing[0]!r} is missing; name the columns of the states in a mapping file (--map)"
        )
    if len(roles.action) != spec.action.size:
        raise UnusableLog(
            f"expected {spec.action.size} columns of the action, got {list(roles.action.values())}: name them "
            "in a mapping file (--map)"
        )
    if roles.reward is None and spec.reward.kind == "learned":
        raise UnusableLog(
            "expected a column of the reward, because the specification says that the reward is learned from real "
            "steps, got none: name it in a mapping file (--map)"
        )
    return replace(
        roles,
        state={name: roles.state[name] for name in spec.coordinate_names},
        following={name: roles.following[name] for name in spec.coordinate_names} if roles.following else {},
        ignored=(*roles.ignored, *(one for name, one in roles.state.items() if name not in spec.coordinate_names)),
    )


def _require_choices(spec: EnvironmentSpec, roles: Roles, values: Floats) -> None:
    """Raise ``UnusableLog`` if the values (n, F) of a discrete action may be codes instead of the choices' numbers.

    Values pass as numbers if they include 0, and either all of them are numbers of choices or each choice occurs. In
    the second case the other values are faults of single rows. A mapping may also declare codes or numbers explicitly.
    """
    if isinstance(spec.action, BoxAction):
        return
    for name, count, column in zip(roles.action, spec.action.nvec, values.T, strict=True):
        if (declared := roles.choices.get(name)) is not None:
            if len(declared) != count:
                raise UnusableLog(
                    f"action {name}: expected {count} choices in discrete, as in the specification, got "
                    f"{list(declared)}: correct the mapping file (--map)"
                )
            continue
        present = set(np.unique(column[np.isfinite(column)]).tolist())
        missing = set(range(count)) - present
        if present and not roles.discrete and (0 in missing or (missing and not present <= set(range(count)))):
            some = [np.unique(one[np.isfinite(one)]) for one in values.T]
            raise UnusableLog(
                f"action {name}: expected the numbers of its choices from 0 to {count - 1}, got "
                f"{', '.join(f'{value:g}' for value in sorted(present)[:SHOWN])}: declare all codes in this order in a "
                f"mapping file (--map), such as {declared_choices(list(roles.action), some)}, or discrete = true if "
                "these are the numbers"
            )


def _shaped(spec: EnvironmentSpec, roles: Roles, steps: Transitions) -> Transitions:
    """Return the steps with only those states that are coordinates of a specification, in its order. Angles are wrapped
    to [-pi, pi)."""
    names = list(roles.state)
    columns = [names.index(name) for name in spec.coordinate_names]
    q, q_next = steps.q[:, columns].copy(), steps.q_next[:, columns].copy()
    for index, coordinate in enumerate(spec.coordinates):
        if coordinate.kind == "angle":
            q[:, index], q_next[:, index] = wrapped(q[:, index]), wrapped(q_next[:, index])
    return replace(steps, q=q, q_next=q_next)


def _consistent(spec: EnvironmentSpec, steps: Transitions) -> Transitions:
    """Return the steps without those that contradict the specification, which are rejected with a reason.

    These are steps with a discrete action that is not a whole number, steps that are marked as terminated although no
    declared termination holds, and steps that are not marked although one holds.
    """
    reasons: dict[int, str] = {}
    if not isinstance(spec.action, BoxAction):
        for place in np.flatnonzero((steps.u != np.floor(steps.u)).any(1)).tolist():
            reasons[place] = f"action: expected whole numbers, got {steps.u[place].tolist()}"
    if spec.termination != "learned":
        declared = terminates(spec, steps.q_next)
        for place in np.flatnonzero(declared != steps.terminated).tolist():
            reasons.setdefault(place, _contradiction(bool(declared[place])))
    rejected = {int(steps.row[place]): reason for place, reason in reasons.items()}
    sound = np.array([place not in reasons for place in range(len(steps))], dtype=np.bool_)
    return _without(steps, sound, rejected) if reasons else steps


def _contradiction(declared: bool) -> str:
    if declared:
        return "terminated: expected 1, as a declared termination holds at the next state, got 0"
    return "terminated: expected 0, as no declared termination holds at the next state, got 1"


def _without(steps: Transitions, sound: Bools, rejected: dict[int, str]) -> Transitions:
    fields: dict[str, Any] = {
        name: getattr(steps, name)[sound] for name in ("row", "q", "u", "q_next", "terminated", "truncated", "first")
    }
    reward: Floats | None = None if steps.reward is None else steps.reward[sound]
    return replace(steps, **fields, reward=reward, rejected=dict(sorted({**steps.rejected, **rejected}.items())))
