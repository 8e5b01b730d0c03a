"""Conversion of logs: from CSV text to checked rows, and from checked rows to samples and replies."""

from __future__ import annotations

from typing import Any

from surrogym_server.convert.stored import read_stored
from surrogym_server.errors import InvalidInput
from surrogym_server.services.samples import AddedLog
from surrogym_server.storage.records import NewSample
from surrogym_shared import wire
from surrogym_shared.logs.checking import ReadLog, check_log, draft_log
from surrogym_shared.logs.columns import Roles
from surrogym_shared.logs.roles import read_roles
from surrogym_shared.logs.table import Table, UnusableLog
from surrogym_shared.logs.text import table_of_text
from surrogym_shared.spec import EnvironmentSpec

MOST_ROWS = 50_000
LONGEST_REASON = 300  # the reason why a row of a log was rejected is cut to this many characters
WHERE = "the log"


def drafted_log(body: wire.DraftLog) -> ReadLog:
    """Read a log and draft a specification from it. Raises ``InvalidInput`` if the log can't be used."""
    try:
        table, roles = _table(body)
        return draft_log(table, roles, body.environment, body.budget)
    except UnusableLog as error:
        raise InvalidInput(str(error)) from error


def checked_log(body: wire.AddLog, spec: dict[str, Any]) -> ReadLog:
    """Read a log, and check it against the stored specification ``spec``.

    Raises:
        InvalidInput: the log can't be used.
        Damaged: the stored specification can't be read.
    """
    read = read_stored(EnvironmentSpec, "a stored specification", spec)
    try:
        table, roles = _table(body)
        return check_log(table, roles, read)
    except UnusableLog as error:
        raise InvalidInput(str(error)) from error


def logged_samples(log: ReadLog) -> list[NewSample]:
    """Return the usable steps of a log as samples, in the order of the log."""
    steps = log.steps
    columns = (steps.q, steps.u, steps.q_next, log.reward, steps.terminated, steps.truncated)
    return [
        NewSample(tuple(q), tuple(u), tuple(q_next), reward, terminated, truncated)
        for q, u, q_next, reward, terminated, truncated in zip(*(column.tolist() for column in columns), strict=True)
    ]


def drafted_report(log: ReadLog) -> wire.DraftedLog:
    return wire.DraftedLog(**_report(log), spec=log.spec, notes=list(log.notes))


def added_report(log: ReadLog, added: AddedLog) -> wire.AddedLog:
    return wire.AddedLog(**_report(log), stored=added.stored, duplicates=added.duplicates)


def _table(body: wire.DraftLog | wire.AddLog) -> tuple[Table, Roles]:
    if "\0" in body.text or "\ufffd" in body.text:
        raise UnusableLog(
            f"expected {WHERE} as text in UTF-8, got another encoding: convert it, or use the command surrogym import"
        )
    table = table_of_text(body.text.removeprefix("\ufeff"), WHERE, MOST_ROWS)
    if not len(table):
        raise UnusableLog(f"expected at least one row below the heading in {WHERE}, got none: add a row for each step")
    return read_roles(table, body.mapping)


def _report(log: ReadLog) -> dict[str, Any]:
    first = log.rejected[: wire.MAX_REJECTED]
    return {
        "rows": len(log.table),
        "steps": len(log.steps),
        "without_next_state": log.steps.ends,
        "rejected": len(log.rejected),
        "rejected_rows": [wire.RejectedRow(line=line, reason=reason[:LONGEST_REASON]) for line, reason in first],
        "columns": log.roles.used,
        "ignored": log.ignored,
        "mapping": log.roles.mapping,
    }
