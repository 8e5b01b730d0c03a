"""Write steps to files that a log may be read from."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

EVALUATED = "evaluated"  # array that marks steps of an evaluation in the surrogate's own environment


def npz_of_steps(coordinate_names: Sequence[str], arrays: Mapping[str, Any]) -> bytes:
    """Return the content of an NPZ file of n steps.

    Args:
        coordinate_names: names of the coordinates.
        arrays: ``coordinates`` (n, C), ``action`` (n, F), ``next_coordinates`` (n, C), and ``reward``, ``terminated``
            and the like, (n,) each.
    """
    buffer = io.BytesIO()
    np.savez(buffer, coordinate_names=np.array(coordinate_names), **arrays)
    return buffer.getvalue()
