"""Write steps to CSV cells and NPZ files that can be read again as a log."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from surrogym_shared.logs.table import is_number
from surrogym_shared.words import visible

# Characters with which a formula begins in a spreadsheet; the last four are full-width forms.
FORMULA = "=+-@\uff1d\uff0b\uff0d\uff20"
# Name of the array that marks a file's steps as those of an evaluation in the surrogate's environment.
EVALUATED = "evaluated"


def spreadsheet_cell(value: Any) -> Any:
    """Return a cell for CSV that spreadsheets don't read as a formula and terminals don't read as a control sequence.
    Numbers stay unchanged."""
    if not isinstance(value, str):
        return value
    text = visible(value)
    return f"'{text}" if text.strip()[:1] in (*FORMULA,) and not is_number(text) else text


def npz_of_steps(coordinate_names: Sequence[str], arrays: Mapping[str, Any]) -> bytes:
    """Return the content of an NPZ file of n steps.

    Args:
        coordinate_names: names of the coordinates.
        arrays: ``coordinates`` (n, C), ``action`` (n, F), ``next_coordinates`` (n, C), and further arrays (n,) such as
            ``reward`` and ``terminated``.
    """
    buffer = io.BytesIO()
    np.savez(buffer, coordinate_names=np.array(coordinate_names), **arrays)
    return buffer.getvalue()
