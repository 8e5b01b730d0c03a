"""Logs of real steps: read, checked row by row, drafted into a specification, and sent to a surrogate.

Examples:
    >>> from surrogym_client.logs import import_log
    >>> import_log("reactor.csv", register="reactor").taken
"""

from __future__ import annotations

from surrogym_client.logs.errors import UnusableLog
from surrogym_client.logs.importing import Imported, ReadLog, import_log, read_log, send

__all__ = ["Imported", "ReadLog", "UnusableLog", "import_log", "read_log", "send"]
