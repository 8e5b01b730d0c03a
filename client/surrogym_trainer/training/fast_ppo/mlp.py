"""A multilayer perceptron with forward and backward passes, whose arrays are reused."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.acting import layers_of
from surrogym_shared.kinds import Activation

Array = NDArray[np.floating[Any]]  # always float32


class Mlp:
    """A network of hidden layers and a linear last layer.

    ``parameters`` and ``gradient`` are vectors that the caller owns; the layers are views of them.

    Args:
        sizes: numbers of inputs, of units in each hidden layer, and of outputs.
        activation: activation of the hidden layers.
        parameters: vector of the parameters, with ``count(sizes)`` entries.
        gradient: vector that receives the gradient.
    """

    def __init__(self, sizes: Sequence[int], activation: Activation, parameters: Array, gradient: Array) -> None:
        self.activation = activation
        self.layers = layers_of(sizes, parameters)
        self._gradients = layers_of(sizes, gradient)
        self._passed: list[Array] = []  # inputs of each layer in the last forward pass
        self._made: dict[tuple[int, int], Array] = {}

    @staticmethod
    def count(sizes: Sequence[int]) -> int:
        return sum((inputs + 1) * outputs for inputs, outputs in pairwise(sizes))

    def forward(self, x: Array) -> Array:
        """Return the outputs (B, O) for inputs (B, I). The next pass with the same number of rows reuses the array."""
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
        """Write the gradient of a loss to ``gradient``. ``slope`` (B, O) is the derivative of the loss with respect to
        the outputs of the last forward pass."""
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
        """Return the derivative of a loss with respect to the input of a layer's activation. ``slope`` is its
        derivative with respect to the activation's output y."""
        if self.activation == "relu":
            slope *= y > 0
            return slope
        rise = self._array(-number, *y.shape)
        np.multiply(y, y, out=rise)
        np.subtract(1, rise, out=rise)
        slope *= rise
        return slope

    def _array(self, place: int, rows: int, columns: int) -> Array:
        """Return the array with the number ``place``, which every batch of this size reuses. Allocating memory for each
        batch would take as long as the matrix products."""
        key = (place, rows)
        if key not in self._made:
            self._made[key] = np.empty((rows, columns), dtype=np.float32)
        return self._made[key]


def orthogonal(rng: np.random.Generator, inputs: int, outputs: int, gain: float) -> Array:
    """Return weights (I, O) with orthogonal columns or rows, times a gain (Saxe et al., 2014)."""
    drawn = rng.normal(size=(max(inputs, outputs), min(inputs, outputs)))
    q, r = np.linalg.qr(drawn)
    q *= np.sign(np.diag(r))
    return (gain * (q if inputs >= outputs else q.T)).astype(np.float32)
