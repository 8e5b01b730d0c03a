"""Where compiled functions are kept on disk. Needs no numba, so that a server can look before it imports that."""

from __future__ import annotations

import hashlib
import os
import sys
from functools import cache
from pathlib import Path


@cache
def folder(package: str) -> Path | None:
    """Where a package's compiled functions are kept, by the version of their sources; None where nothing can be.

    Numba reads its files with pickle, so the folder has to be the user's own.

    Args:
        package: a top-level package that is imported.
    """
    chosen = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME")
    try:
        found = (Path(chosen) if chosen else Path.home() / ".cache") / "surrogym" / _digest_of_sources(package)
        found.mkdir(mode=0o700, parents=True, exist_ok=True)
        state = found.stat()
        own = not hasattr(os, "getuid") or (state.st_uid == os.getuid() and not state.st_mode & 0o022)
        return found if own and os.access(found, os.W_OK) else None
    except (OSError, RuntimeError):  # no home, or a read-only one
        return None


def has_any(package: str) -> bool:
    """Whether an earlier process has kept something there."""
    found = folder(package)
    return found is not None and any(found.glob("*/*.nbi"))


def _digest_of_sources(package: str) -> str:
    """Of a package's compiled files and these: numba looks at the file of the function that is called alone."""
    files = set(Path(__file__).parent.glob("*.py"))
    if source := getattr(sys.modules[package], "__file__", None):
        root = Path(source).parent
        files |= {*root.glob("**/compiled/*.py"), *root.glob("**/compiled.py")}
    return hashlib.sha256(b"".join(file.read_bytes() for file in sorted(files))).hexdigest()[:16]
