"""Errors that concern a whole log. A fault of a single row is no error: the row is only left out."""

from __future__ import annotations


class UnusableLog(ValueError):
    """A log, its mapping or its columns can't be used. The message says what was expected and what came."""
