"""Type of a policy as a function: observations in, actions out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Predict = Callable[[NDArray[np.float32]], NDArray[Any]]
"""Observations (N, D) to actions (N,) or (N, F)."""
