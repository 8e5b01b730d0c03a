"""Settings of families that are whole numbers."""

from __future__ import annotations


def require_whole(name: str, given: object, least: int, largest: int) -> None:
    """Raise ``ValueError`` if a setting is no whole number from ``least`` to ``largest``."""
    if isinstance(given, bool) or not isinstance(given, int) or not least <= given <= largest:
        raise ValueError(f"expected {name} to be a whole number from {least} to {largest}, got {given!r}")
