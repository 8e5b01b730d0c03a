"""Local Gaussian processes in Black-DROPS' loop: each prediction is conditioned on the nearest samples only.

D. Nguyen-Tuong, J. Peters, M. Seeger, "Local Gaussian Process Regression for Real Time Online Model Learning and
Control", NIPS 2008. The authors divide the samples into regions and weight the predictions of the nearest regions. Here
each point has a region of its own, the samples nearest to it. The policy search is that of Black-DROPS.

Shapes: n samples, m points, k nearest samples, I inputs, E outputs.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from surrogym_lab.peers.methods.black_drops import BlackDrops, Settings
from surrogym_lab.peers.methods.gaussian_process import JITTER, Processes, fit
from surrogym_sampler.original.protocol import Array

NEAREST = 20  # samples of a prediction


class LocalProcesses(BlackDrops):
    """Black-DROPS with local Gaussian processes. Hyperparameters are fitted as there, once for all points."""

    def __init__(self, settings: Settings | None = None, nearest: int = NEAREST) -> None:
        super().__init__(settings)
        self._nearest = nearest

    def model(self, x: Array, y: Array, rng: np.random.Generator, check: Callable[[], None]) -> Nearest:
        return Nearest(fit(x, y, self._settings.signal_to_noise, rng, check), x, y, self._nearest)


class Nearest:
    """Predictions from the nearest samples. Distances are divided by the length scales of each output.

    Args:
        fitted: processes with the hyperparameters.
        x: inputs (n, I) of all samples, also of those that were not fitted to.
        y: outputs (n, E).
        most: k.
    """

    def __init__(self, fitted: Processes, x: Array, y: Array, most: int) -> None:
        self._y = y
        self._most = min(most, len(x))
        self._scale = fitted.lengthscale.numpy()
        self._signal, self._noise = fitted.signal.numpy() ** 2, fitted.noise.numpy() ** 2  # variances
        self._scaled = x / self._scale[:, None]  # (E, n, I)
        variance = self._noise + JITTER * self._signal
        self._covariances = [
            signal * np.exp(-_squared(z, z) / 2) + added * np.eye(len(x))
            for z, signal, added in zip(self._scaled, self._signal, variance, strict=True)
        ]

    def predict(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation (m, E) of the functions at points (m, I), without noise."""
        each = [self._output(output, x.numpy()) for output in range(len(self._scale))]
        mean, deviation = (torch.from_numpy(np.stack(part, 1)) for part in zip(*each, strict=True))
        return mean, deviation

    def _output(self, output: int, x: Array) -> tuple[Array, Array]:
        """Means and standard deviations (m,) of one output."""
        squared = _squared(x / self._scale[output], self._scaled[output])
        near = np.argpartition(squared, self._most - 1, axis=1)[:, : self._most]  # (m, k)
        k = self._signal[output] * np.exp(-np.take_along_axis(squared, near, 1) / 2)
        among = self._covariances[output][near[:, :, None], near[:, None]]  # (m, k, k)
        solved = np.linalg.solve(among, np.stack([self._y[near, output], k], -1))
        mean, explained = (k[:, None] @ solved)[:, 0].T
        return mean, np.sqrt(np.maximum(self._signal[output] - explained, 1e-12))


def _squared(a: Array, b: Array) -> Array:
    """Squared distances (m, n) of points (m, I) and (n, I)."""
    apart: Array = (a**2).sum(1)[:, None] + (b**2).sum(1) - 2 * a @ b.T
    return np.maximum(apart, 0)
