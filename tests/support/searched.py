"""Where a process of a test looks for packages."""

from __future__ import annotations

import sys
from pathlib import Path


def with_path(folder: Path) -> str:
    """This process's own search path too: the tests may run from a checkout."""
    return ":".join([str(folder), *(path for path in sys.path if path.endswith(("server", "client", "shared")))])
