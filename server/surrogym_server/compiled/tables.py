"""Tables: many matrices in one array, so that a compiled function takes only two arguments for all its data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surrogym_shared.compiled.jit import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
# S matrices in two arrays: the K numbers of all matrices in succession, (K,); and for each matrix the index of its
# first number, its number of rows and its number of columns, (S, 3).
Tables = tuple[Floats, Ints]


class TablesBuilder:
    """Builder of ``Tables``: one array with the numbers of many matrices, and the place of each matrix in it. A vector
    is a matrix of one row; whole numbers are stored as float64."""

    def __init__(self) -> None:
        self._matrices: list[NDArray[Any]] = []

    def add(self, *matrices: ArrayLike) -> int:
        """Append matrices to the tables, and return the index of the first one."""
        first = len(self._matrices)
        self._matrices += [np.atleast_2d(np.asarray(matrix, dtype=np.float64)) for matrix in matrices]
        return first

    def reserve(self) -> int:
        """Append an empty matrix to the tables, which ``fill`` replaces later, and return its index."""
        return self.add(np.zeros((1, 0)))

    def fill(self, place: int, matrix: ArrayLike) -> None:
        self._matrices[place] = np.atleast_2d(np.asarray(matrix, dtype=np.float64))

    def build(self) -> Tables:
        sizes = [matrix.size for matrix in self._matrices]
        begins = np.concatenate([[0], np.cumsum(sizes)[:-1]])
        shapes = [(int(begin), *matrix.shape) for begin, matrix in zip(begins, self._matrices, strict=True)]
        flat: Sequence[NDArray[Any]] = [matrix.reshape(-1) for matrix in self._matrices]
        return np.concatenate(flat), np.array(shapes, dtype=np.int64)


@compiled
def matrix(numbers: Floats, places: Ints, place: int) -> Floats:
    """Return the matrix number ``place`` of the tables ``numbers`` and ``places`` (see ``Tables``), without a copy."""
    begin, rows, columns = places[place, 0], places[place, 1], places[place, 2]
    return numbers[begin : begin + rows * columns].reshape((rows, columns))
