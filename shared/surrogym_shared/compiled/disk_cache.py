"""The disk cache of compiled functions. It does not import numba, so that a server can check the cache quickly."""

from __future__ import annotations

import hashlib
import os
import sys
from functools import cache
from pathlib import Path


@cache
def folder(package: str) -> Path | None:
    """Return the cache folder of a package for the present version of its sources; None if nothing can be stored.

    Numba reads its files with pickle, so the folder has to belong to the user.

    Args:
        package: an imported top-level package.
    """
    root = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME")
    try:
        path = (Path(root) if root else Path.home() / ".cache") / "surrogym" / _digest_of_sources(package)
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        state = path.stat()
        own = not hasattr(os, "getuid") or (state.st_uid == os.getuid() and not state.st_mode & 0o022)
        return path if own and os.access(path, os.W_OK) else None
    except (OSError, RuntimeError):  # there is no home folder, or nothing can be written to it
        return None


def has_any(package: str) -> bool:
    """Whether the package's cache folder has a compiled function, which an earlier process stored."""
    path = folder(package)
    return path is not None and any(path.glob("*/*.nbi"))


def _digest_of_sources(package: str) -> str:
    """Return one digest of all source files that a package compiles, and of the files in ``surrogym_shared.compiled``.
    Numba itself checks only the file of the called function."""
    files = set(Path(__file__).parent.glob("*.py"))
    if source := getattr(sys.modules[package], "__file__", None):
        root = Path(source).parent
        files |= {*root.glob("**/compiled/*.py"), *root.glob("**/compiled.py")}
    return hashlib.sha256(b"".join(file.read_bytes() for file in sorted(files))).hexdigest()[:16]
