"""Paths of surrogate files."""

from __future__ import annotations

from pathlib import Path

SUFFIX = ".surrogate"


def existing(path: str | Path) -> Path:
    """Return the path of an existing file.

    Raises:
        FileNotFoundError: there is no such file.
    """
    if not Path(path).exists():
        raise FileNotFoundError(
            f"expected a file that Design.save or surrogym export wrote, got no file at {path}: check the path"
        )
    return Path(path)
