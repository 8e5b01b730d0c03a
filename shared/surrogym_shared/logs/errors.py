"""Errors of whole logs. A fault in one row only sets that row aside."""

from __future__ import annotations


class UnusableLog(ValueError):
    """A log, its mapping or its columns can't be used. The message says what was expected and what came."""
