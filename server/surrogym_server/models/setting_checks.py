"""Checks of the settings of model families."""

from __future__ import annotations


def require_whole(name: str, value: object, least: int, largest: int) -> None:
    """Raise ``ValueError`` unless the setting ``name`` is a whole number from ``least`` to ``largest``."""
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= largest:
        raise ValueError(f"expected the setting {name} to be a whole number from {least} to {largest}, got {value!r}")


def require_number(name: str, value: object, largest: float) -> None:
    """Raise ``ValueError`` unless the setting ``name`` is a number from 0 to ``largest``."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= largest:
        raise ValueError(f"expected the setting {name} to be a number from 0 to {largest:g}, got {value!r}")
