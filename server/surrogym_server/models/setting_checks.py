"""Checks of the settings of families."""

from __future__ import annotations


def require_whole(name: str, given: object, least: int, largest: int) -> None:
    """Raise ``ValueError`` if a setting is no whole number from ``least`` to ``largest``."""
    if isinstance(given, bool) or not isinstance(given, int) or not least <= given <= largest:
        raise ValueError(f"expected {name} to be a whole number from {least} to {largest}, got {given!r}")


def require_number(name: str, given: object, largest: float) -> None:
    """Raise ``ValueError`` if a setting is no number from 0 to ``largest``."""
    if isinstance(given, bool) or not isinstance(given, int | float) or not 0 <= given <= largest:
        raise ValueError(f"expected {name} to be a number from 0 to {largest:g}, got {given!r}")
