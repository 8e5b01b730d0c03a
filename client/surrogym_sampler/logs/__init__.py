"""Read logs of real steps, check their rows, draft a specification from them, and send the steps to a surrogate.

Examples:
    >>> from surrogym_sampler.logs import import_log
    >>> import_log("reactor.csv", register="reactor").taken
"""

from __future__ import annotations

from surrogym_sampler.logs.importing import Imported, import_log, read_log, send
from surrogym_shared.logs.checking import ReadLog
from surrogym_shared.logs.table import UnusableLog

__all__ = ["Imported", "ReadLog", "UnusableLog", "import_log", "read_log", "send"]
