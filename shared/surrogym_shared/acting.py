"""A policy as plain arrays, and the code by which it acts, which is the same on client and server.

Shapes: N lanes (environments that step together), D observation entries, A outputs of the network, F action entries.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.distributions import Bounded, Choices, distribution_of
from surrogym_shared.kinds import Activation
from surrogym_shared.network import Layer, Network, forward, most_probable
from surrogym_shared.policy_sizes import MAX_LAYERS, MAX_PARAMETERS, MAX_ROLLOUT, MAX_UNITS

MAX_LOG_DEVIATION = 80  # largest log standard deviation whose exponential is finite in float32

Array = NDArray[np.floating[Any]]


class NoiseKey(NamedTuple):
    """Key of the random noise that is added to a policy's actions. Equal keys give equal noise.

    Noise that is held for several steps explores further than noise that changes at every step.
    """

    seed: int
    step: int = 0  # number of the rollout's first step; each further step has the next number
    hold: int = 1  # number h of steps with the same noise: steps 0 to h - 1, h to 2 h - 1, ...

    def later(self, steps: int) -> NoiseKey:
        """Return the key with the noise of this key, beginning ``steps`` steps later."""
        return self._replace(step=self.step + steps)


class KeyedGenerator:
    """Random generator that is reset to each key. A new generator for each step would be slow, because its construction
    reads system entropy."""

    def __init__(self) -> None:
        self._bits = np.random.Philox(0)
        self._generator = np.random.Generator(self._bits)

    def at(self, key: NoiseKey) -> np.random.Generator:
        """Return the generator, reset to the seed and step of a key. Lane i draws its noise after lane i - 1, so the
        noise of a lane does not depend on the number of further lanes."""
        self._bits.state = {
            "bit_generator": "Philox",
            "state": {"counter": _words(0, 0, key.step // key.hold, 0), "key": _words(key.seed, 0)},
            "buffer": _words(0, 0, 0, 0),
            # Mark the generator's buffer of random numbers as empty, so that no number drawn under an earlier key is
            # returned.
            "buffer_pos": 4,
            "has_uint32": 0,
            "uinteger": 0,
        }
        return self._generator


@dataclass(frozen=True)
class ActingPolicy:
    """Policy network as plain arrays. Its outputs are continuous actions before their tanh, or scores of discrete
    choices.

    All arrays are float32 or all are float64, and the network computes in this precision.

    Raises:
        ValueError: arrays that don't fit together, that are too large, or that contain NaN or infinity.
    """

    mean: Array  # (D,) mean of each of D observation entries, which is subtracted
    deviation: Array  # (D,) number by which each of D observation entries minus its mean is divided
    layers: tuple[Layer, ...]
    activation: Activation = "tanh"  # activation function of the hidden layers
    # (F,) log standard deviation of the noise of each of F continuous action entries; None without noise.
    log_deviations: Array | None = None

    def __post_init__(self) -> None:
        arrays = self._arrays_by_name()
        if not 1 <= len(self.layers) <= MAX_LAYERS:
            raise ValueError(f"policy: expected 1 to {MAX_LAYERS} layers, got {len(self.layers)}")
        for name, array in arrays.items():
            if array.dtype not in (np.float32, np.float64) or array.dtype != self.mean.dtype:
                raise ValueError(f"policy: expected {name} as {_dtype_names(self.mean.dtype)}, got {array.dtype}")
        self._check_shapes()
        for name, array in arrays.items():
            if not np.isfinite(array).all():
                raise ValueError(f"policy: expected finite numbers in {name}, got NaN or infinity")
        if self.log_deviations is not None and np.abs(self.log_deviations).max() > MAX_LOG_DEVIATION:
            most = np.abs(self.log_deviations).max()
            raise ValueError(
                f"policy: expected log_deviations between -{MAX_LOG_DEVIATION} and {MAX_LOG_DEVIATION}, got "
                f"{most:g} in size"
            )
        if not (self.deviation > 0).all():
            raise ValueError(f"policy: expected numbers above 0 in deviation, got {self.deviation.min():g}")

    @classmethod
    def of(cls, network: Network) -> Self:
        """Make a policy that takes a network's most probable actions."""
        return cls(network.mean, network.deviation, network.layers, network.activation)

    @property
    def dtype(self) -> np.dtype[Any]:
        return self.mean.dtype

    @property
    def units(self) -> tuple[int, ...]:
        """Number of outputs of each layer. The last number is A, the outputs of the whole network."""
        return tuple(len(layer.bias) for layer in self.layers)

    @property
    def vector(self) -> Array:
        """Return weights and bias of each layer as one vector."""
        return np.concatenate([part.ravel() for layer in self.layers for part in layer])

    def _arrays_by_name(self) -> dict[str, Array]:
        arrays = {"mean": self.mean, "deviation": self.deviation}
        for i, layer in enumerate(self.layers):
            arrays |= {f"layers[{i}].weights": layer.weights, f"layers[{i}].bias": layer.bias}
        return arrays if self.log_deviations is None else arrays | {"log_deviations": self.log_deviations}

    def _check_shapes(self) -> None:
        size = self.mean.size
        shapes: dict[str, tuple[int, ...]] = {"mean": (size,), "deviation": (size,)}
        for i, layer in enumerate(self.layers):
            after = layer.bias.size
            if not 1 <= after <= MAX_UNITS:
                raise ValueError(f"policy: expected 1 to {MAX_UNITS} units in layers[{i}], got {after}")
            shapes |= {f"layers[{i}].weights": (size, after), f"layers[{i}].bias": (after,)}
            size = after
        if self.log_deviations is not None:
            shapes["log_deviations"] = (max(self.log_deviations.size, 1),)
        for name, array in self._arrays_by_name().items():
            if array.shape != shapes[name]:
                raise ValueError(f"policy: expected {name} of shape {shapes[name]}, got {array.shape}")
        if (count := parameters_of(self.mean.size, self.units)) > MAX_PARAMETERS:
            raise ValueError(f"policy: expected at most {MAX_PARAMETERS} weights and biases, got {count}")


@dataclass(frozen=True)
class PolicyRun:
    """Request to let a policy act for T steps; see ``surrogym_shared.port.PolicyPort.rollout_policy``.

    Raises:
        ValueError: the number of steps or the key is out of range.
    """

    policy: ActingPolicy
    steps: int
    noise: NoiseKey | None = None
    # (N,) mask of N lanes: stop once an episode has ended in each masked lane; None: take all ``steps``.
    until: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.steps <= MAX_ROLLOUT:
            raise ValueError(f"steps: expected 1 to {MAX_ROLLOUT}, got {self.steps}")
        if self.noise is not None and not (all(0 <= word < 2**63 for word in self.noise) and self.noise.hold):
            noise = tuple(self.noise)
            raise ValueError(f"noise: expected a seed and a step of 0 to 2^63 - 1 and a hold of 1 or more, got {noise}")


class Acted(NamedTuple):
    """Actions of a policy in one step."""

    action: Array  # (N, F) actions of F entries in N lanes, before they are clipped to their bounds
    log_probability: Array | None  # (N,) log probability of the action in each of N lanes; None without noise
    sent: NDArray[Any]  # (N, F) actions as a surrogate takes them: clipped to their bounds, or numbers of choices


@dataclass(frozen=True)
class Actor:
    """A policy together with the action space in which it acts.

    Raises:
        ValueError: the policy was made for other observations or another action space.
    """

    policy: ActingPolicy
    observation: int  # number of entries of an observation, D
    low: NDArray[np.float64]  # (F,) lower bound of each of F continuous action entries
    high: NDArray[np.float64]  # (F,) upper bound of each of F continuous action entries
    counts: tuple[int, ...] = ()  # number of choices of each entry of a discrete action; empty for a continuous one
    noisy: bool = False

    def __post_init__(self) -> None:
        policy, log = self.policy, self.policy.log_deviations
        if policy.mean.size != self.observation:
            raise ValueError(
                f"policy: expected a mean of {self.observation} entries, as an observation has, got {policy.mean.size}"
            )
        if policy.units[-1] != self._distribution.outputs:
            outputs = self._distribution.outputs
            raise ValueError(
                f"policy: expected {outputs} units in the last layer, as the action space needs, got {policy.units[-1]}"
            )
        if self.counts and log is not None:
            raise ValueError("policy: expected no log_deviations with discrete actions, got some: leave them out")
        if self.noisy and not self.counts and log is None:
            raise ValueError("policy: expected log_deviations with noise, got none: give them, or request no noise")
        if log is not None and log.size != len(self.low):
            raise ValueError(f"policy: expected log_deviations of {len(self.low)} entries, got {log.size}")

    def act(self, observation: NDArray[Any], noise: NoiseKey | None) -> Acted:
        """Return the policy's actions for N observations of D entries, (N, D): with the noise of a key, or the most
        probable actions if ``noise`` is None.

        Raises:
            ValueError: the network's outputs are not finite.
        """
        policy = self.policy
        x = ((observation - policy.mean) / policy.deviation).astype(policy.dtype, copy=False)
        y = forward(policy.layers, policy.activation, x)
        if not np.isfinite(y).all():
            raise ValueError("policy: expected finite outputs of the network, got NaN or infinity")
        if noise is None:
            for_surrogate = most_probable(y, self.low, self.high, self.counts)
            return Acted(for_surrogate.reshape(len(y), -1).astype(np.float64), None, for_surrogate)
        further = np.zeros(0, dtype=policy.dtype) if policy.log_deviations is None else policy.log_deviations
        action, log = self._distribution.sample(y, further, self._keyed.at(noise))
        return Acted(action, log, self._distribution.sent(action))

    @cached_property
    def _keyed(self) -> KeyedGenerator:
        return KeyedGenerator()

    @cached_property
    def _distribution(self) -> Bounded | Choices:
        return distribution_of(self.counts, self.low, self.high, self.policy.dtype)


def layers_of(sizes: Sequence[int], vector: Array) -> tuple[Layer, ...]:
    """Split a vector of parameters into the layers of a network, which are views of the vector.

    ``sizes`` are the numbers of the network's inputs, of the hidden units of each layer, and of its outputs.
    """
    layers, begin = [], 0
    for inputs, outputs in pairwise(sizes):
        middle, end = begin + inputs * outputs, begin + (inputs + 1) * outputs
        layers.append(Layer(vector[begin:middle].reshape(inputs, outputs), vector[middle:end]))
        begin = end
    return tuple(layers)


def parameters_of(observation: int, units: Sequence[int]) -> int:
    """Number of weights and biases of a network, given its observation entries and the units of each layer."""
    return sum((inputs + 1) * outputs for inputs, outputs in pairwise((observation, *units)))


def _words(*words: int) -> NDArray[np.uint64]:
    return np.array(words, dtype=np.uint64)


def _dtype_names(dtype: np.dtype[Any]) -> str:
    return str(dtype) if dtype in (np.float32, np.float64) else "float32 or float64"
