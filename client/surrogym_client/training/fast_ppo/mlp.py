"""Layers with a bias each, forwards and backwards, on arrays that are made once."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.acting import layers_of
from surrogym_shared.network import Activation

Array = NDArray[np.floating[Any]]  # float32


class Mlp:
    """A network of hidden layers and a linear last one.

    ``parameters`` and ``gradient`` are vectors that somebody else may own; the layers are views of them.

    Args:
        sizes: numbers that enter, pass between the layers, and leave.
        activation: of the hidden layers.
        parameters: where the parameters are, ``count(sizes)`` of them.
        gradient: where their gradient goes.
    """

    def __init__(self, sizes: Sequence[int], activation: Activation, parameters: Array, gradient: Array) -> None:
        self.activation = activation
        self.layers = layers_of(sizes, parameters)
        self._gradients = layers_of(sizes, gradient)
        self._passed: list[Array] = []  # what entered each layer in the last pass that was kept
        self._made: dict[tuple[int, int], Array] = {}

    @staticmethod
    def count(sizes: Sequence[int]) -> int:
        return sum((inputs + 1) * outputs for inputs, outputs in pairwise(sizes))

    def forward(self, x: Array) -> Array:
        """Outputs (B, O) of inputs (B, I). The array is used again by the next pass of as many rows."""
        self._passed = [x]
        for number, (weights, bias) in enumerate(self.layers):
            y = self._array(2 * number, len(x), weights.shape[1])
            np.matmul(x, weights, out=y)
            y += bias
            if number == len(self.layers) - 1:
                return y
            np.tanh(y, out=y) if self.activation == "tanh" else np.maximum(y, 0, out=y)
            self._passed.append(y)
            x = y
        raise AssertionError("unreachable: a network has a layer")

    def backward(self, slope: Array) -> None:
        """Write the gradient of a loss whose derivative by the outputs of the last pass is ``slope`` (B, O)."""
        for number in reversed(range(len(self.layers))):
            weights, _ = self.layers[number]
            by_weights, by_bias = self._gradients[number]
            x = self._passed[number]
            np.matmul(x.T, slope, out=by_weights)
            np.sum(slope, axis=0, out=by_bias)
            if number:
                before = self._array(2 * number - 1, len(x), len(weights))
                np.matmul(slope, weights.T, out=before)
                slope = self._through(before, x, number)

    def _through(self, slope: Array, y: Array, number: int) -> Array:
        """The derivative by what entered an activation, from that by its output y."""
        if self.activation == "relu":
            slope *= y > 0
            return slope
        rise = self._array(-number, *y.shape)
        np.multiply(y, y, out=rise)
        np.subtract(1, rise, out=rise)
        slope *= rise
        return slope

    def _array(self, place: int, rows: int, columns: int) -> Array:
        """An array of one place in the passes: new memory for every batch would cost as much as the products."""
        key = (place, rows)
        if key not in self._made:
            self._made[key] = np.empty((rows, columns), dtype=np.float32)
        return self._made[key]


def orthogonal(rng: np.random.Generator, inputs: int, outputs: int, gain: float) -> Array:
    """Weights (I, O) whose columns or rows are orthogonal, times a gain (Saxe et al., 2014)."""
    drawn = rng.normal(size=(max(inputs, outputs), min(inputs, outputs)))
    q, r = np.linalg.qr(drawn)
    q *= np.sign(np.diag(r))
    return (gain * (q if inputs >= outputs else q.T)).astype(np.float32)
