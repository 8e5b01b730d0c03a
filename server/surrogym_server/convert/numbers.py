"""Conversion between arrays and nested lists."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_server.errors import InvalidInput


def numbers(what: str, rows: Sequence[Any]) -> NDArray[np.float64]:
    """Convert nested lists of numbers to an array. ``what`` is their name in the error message.

    Raises:
        InvalidInput: the rows have different lengths.
    """
    try:
        return np.array(rows, dtype=np.float64)
    except (ValueError, TypeError) as error:
        raise InvalidInput(f"{what}: expected rows of equal length, got rows of different lengths") from error


def as_tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
