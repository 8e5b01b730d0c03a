"""Logging of a server: each record is a line of text or JSON, with the id of the HTTP request during which it arose."""

from __future__ import annotations

import json
import logging
from contextvars import ContextVar
from typing import Literal

LogFormat = Literal["text", "json"]

REQUEST_ID: ContextVar[str | None] = ContextVar("request_id", default=None)


# Control characters in log records are replaced by these escapes. Otherwise a line break in a logged path or name could
# imitate another line of the log.
_ESCAPES = {code: f"\\x{code:02x}" for code in (*range(32), *range(127, 160), 0x2028, 0x2029)}


class _TextFormatter(logging.Formatter):
    def formatMessage(self, record: logging.LogRecord) -> str:
        return super().formatMessage(record).rstrip("\n").translate(_ESCAPES)

    def format(self, record: logging.LogRecord) -> str:
        line = f"{record.levelname} {record.name}: {super().format(record)}"
        request = REQUEST_ID.get()
        return line if request is None else f"{line} [request {request}]"


class _JsonFormatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        fields = {
            "time": self.formatTime(record, "%Y-%m-%dT%H:%M:%S%z"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            "request": REQUEST_ID.get(),
            "error": self.formatException(record.exc_info) if record.exc_info else None,
        }
        return json.dumps({name: value for name, value in fields.items() if value is not None})


def configure(level: str, form: LogFormat) -> None:
    """Send all log records of this process that have at least the level ``level`` to standard error, as text or
    JSON."""
    handler = logging.StreamHandler()
    handler.setFormatter(_JsonFormatter() if form == "json" else _TextFormatter())
    root = logging.getLogger()
    root.handlers = [handler]
    root.setLevel(level.upper())
    for quiet in ("uvicorn.error", "alembic", "httpx", "httpcore"):  # the latter two log the webhook's secret path
        logging.getLogger(quiet).setLevel(max(logging.WARNING, root.level))
