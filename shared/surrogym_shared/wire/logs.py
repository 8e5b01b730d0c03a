"""Wire models of logs: recorded real steps as CSV, checked or stored by the server."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from surrogym_shared.logs.columns import LogMapping
from surrogym_shared.patterns import VISIBLE
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire.base import Reply, Request

MAX_LOG = 4 * 1024 * 1024  # largest number of characters of a log
MAX_REJECTED = 1_000  # largest number of rejected rows that a reply lists


class SentLog(Request):
    """Base class of requests that send a log as CSV text."""

    text: Annotated[str, Field(min_length=1, max_length=MAX_LOG, description="the log as CSV with a heading")]
    mapping: LogMapping | None = Field(
        default=None, description="role of each column of the log; null: the names of the columns decide"
    )


class DraftLog(SentLog):
    """Request to draft a specification from a log."""

    environment: Annotated[str, Field(max_length=256, pattern=VISIBLE)] = Field(
        default="", description="name of the environment"
    )
    budget: Annotated[int, Field(ge=0, le=100_000)] = Field(
        default=0, description="real steps that the design may take in addition to the log; 0 if it can take none"
    )


class AddLog(SentLog):
    """Request to check the rows of a log against a specification, and to store them as samples."""

    check_only: bool = Field(default=False, description="whether to check the rows without storing anything")


class RejectedRow(Reply):
    """A row of a log that can't be used."""

    line: int = Field(description="line of the CSV; the heading is line 1")
    reason: str = Field(description="why the row can't be used")


class LogReport(Reply):
    """Report on the rows of a log and the roles of its columns."""

    rows: int = Field(description="number of rows of the log, without the heading")
    steps: int = Field(description="number of usable steps")
    without_next_state: int = Field(
        description="number of rows without a next state, because an episode ends there, or a gap in time follows"
    )
    rejected: int = Field(description="number of rows that can't be used")
    rejected_rows: list[RejectedRow] = Field(
        description=f"the first {MAX_REJECTED} rows that can't be used, with line and reason"
    )
    columns: dict[str, str] = Field(description="role of each used column, by the column's name")
    ignored: dict[str, str] = Field(description="why a column is not used, by the column's name")
    mapping: LogMapping = Field(description="mapping that gives the columns these roles")


class DraftedLog(LogReport):
    """Reply with a specification drafted from a log, and with the report on the log's rows."""

    spec: EnvironmentSpec = Field(description="drafted specification, which a person should check")
    notes: list[str] = Field(description="sentences that say from which data the parts of the draft were concluded")


class AddedLog(LogReport):
    """Reply after the usable rows of a log were stored as samples, or only checked, with the report on the rows."""

    stored: int = Field(description="number of new samples; 0 if the rows were only checked")
    duplicates: int = Field(description="number of usable steps that were stored before")
