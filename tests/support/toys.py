"""A base for small simulators whose whole state is one array."""

from __future__ import annotations

import numpy as np

from surrogym_sampler.original.simulator import Simulator


class Toy(Simulator):
    """Reads, writes and shows ``_state``, which ``reset`` and ``step`` of a subclass replace."""

    _state: np.ndarray

    def read(self) -> np.ndarray:
        return self._state.copy()

    def write(self, state: np.ndarray) -> None:
        self._state = state.copy()

    def observe(self) -> np.ndarray:
        return self._state

    def close(self) -> None:
        pass
