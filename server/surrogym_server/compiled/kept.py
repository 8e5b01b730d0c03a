"""Where compiled functions are kept on disk. Needs no numba, so that a server can look before it imports that."""

from __future__ import annotations

import hashlib
import os
from functools import cache
from pathlib import Path


@cache
def folder() -> Path | None:
    """Where compiled functions are kept, one folder for each version of their sources; None where nothing can be.

    Numba reads its files with pickle, so the folder has to be the user's own.
    """
    chosen = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME")
    try:
        found = (Path(chosen) if chosen else Path.home() / ".cache") / "surrogym" / _digest_of_sources()
        found.mkdir(mode=0o700, parents=True, exist_ok=True)
        state = found.stat()
        own = not hasattr(os, "getuid") or (state.st_uid == os.getuid() and not state.st_mode & 0o022)
        return found if own and os.access(found, os.W_OK) else None
    except (OSError, RuntimeError):  # no home, or a read-only one
        return None


def has_any() -> bool:
    """Whether an earlier process has kept something there."""
    found = folder()
    return found is not None and any(found.glob("*/*.nbi"))


def _digest_of_sources() -> str:
    """Of all compiled files: numba looks at the file of the function that is called alone."""
    root = Path(__file__).parents[1]
    files = sorted({*root.glob("**/compiled/*.py"), *root.glob("**/compiled.py")})
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:16]
