"""Files of whole surrogates, by their paths."""

from __future__ import annotations

from pathlib import Path

SUFFIX = ".surrogate"


def existing(path: str | Path) -> Path:
    """A path to a file. Raises ``FileNotFoundError`` where there is none, in words."""
    if not Path(path).exists():
        raise FileNotFoundError(f"expected a file that Design.save or surrogym export wrote, got no file at {path}")
    return Path(path)
