"""Wire models of logs: recorded real steps as CSV, checked or stored by the server."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from surrogym_shared.logs.columns import LogMapping
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire.base import VISIBLE, Reply, Request

MAX_LOG = 4 * 1024 * 1024  # letters
MAX_REJECTED = 1_000  # rows that a reply lists


class SentLog(Request):
    """Base class of requests with a log."""

    text: Annotated[str, Field(min_length=1, max_length=MAX_LOG, description="CSV with a heading")]
    mapping: LogMapping | None = Field(
        default=None, description="what each column is; null goes by the names of the columns"
    )


class DraftLog(SentLog):
    environment: Annotated[str, Field(max_length=256, pattern=VISIBLE)] = ""
    budget: Annotated[int, Field(ge=0, le=100_000)] = Field(
        default=0, description="real steps that the design may take beyond the log; 0 if there is no machine"
    )


class AddLog(SentLog):
    check_only: bool = Field(default=False, description="whether the rows are only checked, and nothing is stored")


class RejectedRow(Reply):
    line: int = Field(description="of the CSV, the heading is line 1")
    reason: str


class LogReport(Reply):
    """Result of reading a log's rows."""

    rows: int
    steps: int = Field(description="usable ones")
    without_next_state: int = Field(description="rows that end an episode, or stand before a gap in time")
    rejected: int = Field(description="rows that can't be used")
    rejected_rows: list[RejectedRow] = Field(description=f"the first {MAX_REJECTED} of them, with line and reason")
    columns: dict[str, str] = Field(description="the role of each column that is used")
    ignored: dict[str, str] = Field(description="the reason for each column that is not used")
    mapping: LogMapping = Field(description="the mapping that gives the columns these roles")


class DraftedLog(LogReport):
    spec: EnvironmentSpec
    notes: list[str] = Field(description="what the draft was concluded from")


class AddedLog(LogReport):
    stored: int = Field(description="new samples; 0 if the rows were only checked")
    duplicates: int = Field(description="usable steps that were there before")
