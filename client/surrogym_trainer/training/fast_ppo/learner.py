"""Actor, critic and Adam: the update of proximal policy optimisation.

Loss of a batch, with ratio r = p(a) / p_old(a) and advantages A of mean 0 and deviation 1 in the batch:

    -mean(min(r A, clip(r, 1 - c, 1 + c) A)) + v mean((V - R)^2)

References: Schulman et al. (2017), arXiv 1707.06347, eq. 7; Kingma and Ba (2015). The constants are those of
Stable-Baselines3; the update equals its update, apart from rounding. The action distributions are those of
``surrogym_shared.distributions``; their initial parameters and derivatives are here. The perceptrons reuse their
arrays.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_shared import distributions
from surrogym_shared.acting import ActingPolicy, layers_of
from surrogym_shared.archives import Header, read_arrays, read_entries
from surrogym_shared.compiled import available
from surrogym_shared.distributions import log_softmax, middle_and_reach
from surrogym_shared.kinds import Activation
from surrogym_shared.network import MAX_BYTES, Layer, Network, bounds_of
from surrogym_shared.spec import EnvironmentSpec
from surrogym_trainer.policies.card import UnusablePolicy
from surrogym_trainer.policies.defaults import CRITIC, EXPLORATION
from surrogym_trainer.policies.files import load_network
from surrogym_trainer.policies.predict import Predict
from surrogym_trainer.training.fast_ppo.adam import EPSILON, FIRST_DECAY, SECOND_DECAY

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
        """Return the derivative (B, units) of a loss with respect to the input of a hidden layer's activation.
        ``slope`` (B, units), which is overwritten, is the derivative with respect to the activation's output y (B,
        units). ``number`` is the number of the layer."""
        if self.activation == "relu":
            slope *= y > 0
            return slope
        rise = self._array(-number, *y.shape)
        np.multiply(y, y, out=rise)
        np.subtract(1, rise, out=rise)
        slope *= rise
        return slope

    def _array(self, place: int, rows: int, columns: int) -> Array:
        """Return the work array (rows, columns) with the number ``place``, which every batch with this number of rows
        reuses. Allocating memory for each batch would take as long as the matrix products."""
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


@dataclass(frozen=True)
class Bounded(distributions.Bounded):
    """Continuous actions within bounds; their standard deviations do not depend on the state. Its methods give the
    derivatives that a learner needs; those of ``Choices`` are the same."""

    activation: Activation = "tanh"  # activation of the hidden layers of actor and critic

    def further(self) -> Array:
        """Return the initial logarithms of the standard deviations (F,)."""
        logarithms: Array = np.log(EXPLORATION * self.reach).astype(np.float32)
        return logarithms

    def arrays(self) -> tuple[tuple[int, ...], Array, Array]:
        """Return, for compiled code, the numbers of choices of discrete actions, and the centre (F,) and the reach
        (F,), half the width, of the bounds of continuous actions. Parts that do not apply are empty."""
        return (), self.centre, self.reach

    def slopes(self, outputs: Array, further: Array, actions: Array, by: Array) -> tuple[Array, Array]:
        """Return the derivatives of a loss with respect to the outputs (B, A) and to the further parameters (K,).

        Args:
            outputs: outputs of the actor (B, A).
            further: the distribution's further parameters (K,).
            actions: the actions taken (B, F).
            by: the derivatives of the loss with respect to the log probabilities (B,).
        """
        bent = np.tanh(outputs)
        z = (actions - self.centre - self.reach * bent) * np.exp(-further)
        by_mean = by[:, None] * z * np.exp(-further)
        return by_mean * self.reach * (1 - bent * bent), (by[:, None] * (z * z - 1)).sum(0)


@dataclass(frozen=True)
class Choices(distributions.Choices):
    """Discrete actions, with a softmax for each entry."""

    activation: Activation = "relu"

    def further(self) -> Array:
        return np.zeros(0, dtype=np.float32)

    def arrays(self) -> tuple[tuple[int, ...], Array, Array]:
        return self.counts, self.further(), self.further()

    def slopes(self, outputs: Array, further: Array, actions: Array, by: Array) -> tuple[Array, Array]:
        slopes, rows = [], np.arange(len(outputs))
        for i, part in enumerate(self.parts(outputs)):
            slope = -np.exp(log_softmax(part))
            slope[rows, actions[:, i].astype(np.int64)] += 1
            slopes.append(by[:, None] * slope)
        return np.concatenate(slopes, 1), np.zeros_like(further)


def distribution_of(counts: tuple[int, ...], low: NDArray[np.float64], high: NDArray[np.float64]) -> Bounded | Choices:
    """Return the distribution of discrete actions with these numbers of choices, or of continuous actions within bounds
    (F,)."""
    if counts:
        return Choices(counts)
    return Bounded(*middle_and_reach(low, high, np.dtype(np.float32)))


HIDDEN_GAIN, ACTION_GAIN, VALUE_GAIN = 2**0.5, 0.01, 1.0
NARROWEST = 0.1  # if inputs are standardised again, the smallest new standard deviation, as a share of the previous one
LEARNER = "learner.npz"  # name of the entry in a policy's file from which its training can continue
VECTORS = ("parameters", "first", "second")


Update = Callable[..., None]


@cache
def compiled_update() -> Update | None:
    """Return the update in compiled code; None if this installation can't compile it."""
    if not available():
        return None
    try:
        from surrogym_trainer.training.fast_ppo.compiled import update
    except ImportError:  # SciPy is not installed, or numba does not support this version of NumPy
        return None
    return update


@dataclass(frozen=True)
class Objective:
    """The constants of the loss and of one optimiser step. Their defaults are those of the search ``FastPpo``."""

    clip_range: float
    vf_coef: float
    max_grad_norm: float


@dataclass(frozen=True)
class Batch:
    """Transitions to learn from, one in each of B rows."""

    observations: Array  # (B, D) standardised observations of B transitions, D entries each
    actions: Array  # (B, F) actions taken, F entries each
    log_probabilities: Array  # (B,) log probabilities of the actions when they were taken
    advantages: Array  # (B,) estimated advantage of each of the B actions
    returns: Array  # (B,) value that the critic learns for each of the B observations, from scaled rewards

    def at(self, rows: NDArray[np.int64] | slice) -> Batch:
        """Return the batch of the selected rows."""
        return Batch(*(getattr(self, one.name)[rows] for one in fields(self)))


class Learner:
    """Actor, critic and Adam, with all parameters in one vector so that each update takes few operations."""

    def __init__(
        self,
        spec: EnvironmentSpec,
        mean: NDArray[np.float64],
        deviation: NDArray[np.float64],
        units: tuple[int, ...],
        rng: np.random.Generator,
        *,
        compiled: bool = True,
    ) -> None:
        """Make a learner with new networks.

        Args:
            spec: specification of the environment.
            mean: mean (D,) by which observations are standardised.
            deviation: standard deviation (D,) by which observations are standardised.
            units: numbers of units in the actor's hidden layers.
            rng: draws the initial parameters.
            compiled: whether to update in compiled code, if this installation can.
        """
        self._spec = spec
        self.mean, self.deviation = mean.astype(np.float32), deviation.astype(np.float32)
        self.distribution = distribution_of(spec.action.policy_counts, *bounds_of(spec))
        inputs, further = len(spec.observation), self.distribution.further()
        actor, critic = (inputs, *units, self.distribution.outputs), (inputs, *CRITIC, 1)
        ends = np.cumsum([Mlp.count(actor), Mlp.count(critic), len(further)])
        self.parameters = np.zeros(ends[-1], dtype=np.float32)
        self._gradient = np.zeros_like(self.parameters)
        self._first, self._second = np.zeros_like(self.parameters), np.zeros_like(self.parameters)
        self._updates = 0
        activation, first, second = self.distribution.activation, slice(0, ends[0]), slice(ends[0], ends[1])
        self.actor = Mlp(actor, activation, self.parameters[first], self._gradient[first])
        self.critic = Mlp(critic, activation, self.parameters[second], self._gradient[second])
        self.further, self._further_gradient = self.parameters[ends[1] :], self._gradient[ends[1] :]
        self.further[:] = further
        counts, centre, reach = self.distribution.arrays()
        sizes = (np.array(one, dtype=np.int64) for one in (actor, critic, ends, counts))
        self._fixed = *sizes, activation == "relu", centre, reach
        self._update = compiled_update() if compiled else None
        _initialise(self.actor, ACTION_GAIN, rng)
        _initialise(self.critic, VALUE_GAIN, rng)

    def standardised(self, observation: NDArray[Any]) -> Array:
        x: Array = ((observation - self.mean) / self.deviation).astype(np.float32, copy=False)
        return x

    def acting(self) -> ActingPolicy:
        """Return the actor and its noise as arrays, which are views of the parameters."""
        layers = tuple(Layer(*layer) for layer in self.actor.layers)
        log_deviations = self.further if len(self.further) else None
        return ActingPolicy(self.mean, self.deviation, layers, self.distribution.activation, log_deviations)

    def values(self, x: Array) -> Array:
        """Return the critic's values (B,) of standardised observations (B, D)."""
        return self.critic.forward(x)[:, 0].copy()

    def update(self, batch: Batch, objective: Objective, rate: float) -> None:
        """Take one step of Adam, with a learning rate, on the loss of a batch."""
        self._updates += 1
        if self._update is not None:
            moments = self._first, self._second
            rows = batch.observations, batch.actions, batch.log_probabilities, batch.advantages, batch.returns
            self._update(self.parameters, *moments, *self._fixed, *rows, self._updates, *astuple(objective), rate)
            return
        size = len(batch.returns)
        outputs = self.actor.forward(batch.observations)
        advantages = batch.advantages
        if size > 1:
            advantages = (advantages - advantages.mean()) / (advantages.std(ddof=1) + np.float32(1e-8))
        log = self.distribution.log_probability(outputs, self.further, batch.actions)
        ratio = np.exp(log - batch.log_probabilities)
        clip = np.float32(objective.clip_range)
        # 1 where the probability ratio is not clipped; 0 where it is, as the loss does not depend on it there
        free = np.where(advantages > 0, ratio <= 1 + clip, ratio >= 1 - clip)
        by = -(advantages * ratio * free) / np.float32(size)
        by_outputs, self._further_gradient[:] = self.distribution.slopes(outputs, self.further, batch.actions, by)
        self.actor.backward(by_outputs)
        error = self.critic.forward(batch.observations)[:, 0] - batch.returns
        self.critic.backward((error * np.float32(2 * objective.vf_coef / size))[:, None])
        self._adam(objective.max_grad_norm, rate)

    def limit_noise(self, logarithms: Array, share: float) -> None:
        """Lower the standard deviations of continuous actions to at most ``share`` times given standard deviations,
        whose ``logarithms`` (F,) are passed."""
        np.minimum(self.further, logarithms + np.float32(np.log(share)), out=self.further)

    def _adam(self, largest: float, rate: float) -> None:
        gradient = self._gradient
        norm = float(np.sqrt(gradient @ gradient))
        gradient *= np.float32(min(1.0, largest / (norm + 1e-6)))
        self._first *= np.float32(FIRST_DECAY)
        self._first += np.float32(1 - FIRST_DECAY) * gradient
        gradient *= gradient
        self._second *= np.float32(SECOND_DECAY)
        self._second += np.float32(1 - SECOND_DECAY) * gradient
        root = np.sqrt(self._second)
        root *= np.float32((1 - SECOND_DECAY**self._updates) ** -0.5)
        root += np.float32(EPSILON)
        step = np.float32(rate / (1 - FIRST_DECAY**self._updates))
        self.parameters -= step * self._first / root

    def take_up(self, learned: LearnedNetwork) -> None:
        """Take over parameters, statistics and Adam's moments of another learner of the same network."""
        self.mean, self.deviation = learned.policy.mean.astype(np.float32), learned.policy.deviation.astype(np.float32)
        self.restore(learned.state)

    def standardise_anew(self, x: Array, rng: np.random.Generator) -> None:
        """Standardise inputs by the mean and the standard deviation of other observations. The actor's outputs don't
        change.

        The critic and Adam's moments start afresh.

        Args:
            x: the other observations (B, D), standardised by the previous mean and standard deviation. Each new
                deviation is at least ``NARROWEST`` of the previous one.
            rng: generator of the critic's initial parameters.
        """
        middle, spread = x.mean(0), np.maximum(x.std(0), NARROWEST)
        weights, bias = self.actor.layers[0]
        bias += middle @ weights
        weights *= spread[:, None]
        self.mean, self.deviation = self.mean + middle * self.deviation, self.deviation * spread
        _initialise(self.critic, VALUE_GAIN, rng)
        self._first[:], self._second[:], self._updates = 0, 0, 0

    def policy(self) -> Network:
        """Return the policy of the actor's most probable actions, with the current parameters."""
        layers = self.actor.layers
        return Network(
            self.mean.astype(np.float64),
            self.deviation.astype(np.float64),
            tuple(Layer(weights.astype(np.float64), bias.astype(np.float64)) for weights, bias in layers),
            *bounds_of(self._spec),
            self._spec.action.policy_counts,
            self.distribution.activation,
        )

    def state(self) -> dict[str, NDArray[Any]]:
        """Return the arrays that a later training needs besides the policy: all parameters, and the moments of Adam."""
        vectors = zip(VECTORS, (self.parameters, self._first, self._second), strict=True)
        return {"updates": np.array(self._updates), **{name: vector.copy() for name, vector in vectors}}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restore the arrays that ``state`` returned."""
        for name, vector in zip(VECTORS, (self.parameters, self._first, self._second), strict=True):
            vector[:] = state[name]
        self._updates = int(state["updates"])

    def require(self, headers: Mapping[str, Header]) -> None:
        """Check that arrays, given by their headers (shape and type), are a saved state of this network.

        Raises:
            ValueError: an array is missing, or has another shape or type.
        """
        shapes = {**dict.fromkeys(VECTORS, self.parameters.shape), "updates": ()}
        found = {name: header.shape for name, header in headers.items()}
        if found != shapes:
            raise ValueError(
                f"expected the state of a training of {self.parameters.size} parameters, got arrays of {found}: give a "
                "policy with the same network, or start a new training"
            )


@dataclass(frozen=True)
class LearnedNetwork:
    """A policy together with the state of its learner."""

    policy: Network
    state: Mapping[str, NDArray[Any]]

    def save(self, path: Path) -> None:
        """Write the policy and the learner's state to one file."""
        self.policy.save(path)
        file = io.BytesIO()
        arrays: dict[str, Any] = dict(self.state)
        np.savez(file, **arrays)
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr(LEARNER, file.getvalue())


def restored(path: Path, spec: EnvironmentSpec, units: tuple[int, ...]) -> Learner:
    """Restore the learner from a policy's file.

    Args:
        path: the policy's file.
        spec: specification of the environment.
        units: numbers of units in the actor's hidden layers.

    Raises:
        UnusablePolicy: the file contains no learner, or one of another network.
    """
    policy = load_network(path)
    learner = Learner(spec, policy.mean, policy.deviation, units, np.random.default_rng(0))
    learner.restore(_state(path, learner.require))
    return learner


def noisy(path: Path) -> Predict:
    """Load a policy that acts with its noise, which is the same each time the file is read. Raises ``UnusablePolicy``
    if the file contains no learner."""
    policy = load_network(path)
    distribution = distribution_of(policy.counts, policy.low, policy.high)
    parameters, rng = _state(path, _require_parameters)["parameters"], np.random.default_rng(0)
    further = parameters[len(parameters) - len(distribution.further()) :]
    return lambda observation: distribution.sent(
        distribution.sample(policy.outputs(observation).astype(np.float32), further, rng)[0]
    )


def _require_parameters(headers: Mapping[str, Header]) -> None:
    if "parameters" not in headers or len(headers["parameters"].shape) != 1:
        raise ValueError(
            "expected an array 'parameters' of shape (n,) in the file, got none: give a policy that fastppo saved"
        )


def _state(path: Path, require: Callable[[Mapping[str, Header]], None]) -> dict[str, NDArray[Any]]:
    try:
        entries = read_entries(path, MAX_BYTES)
        if LEARNER not in entries:
            raise ValueError(
                "the file has no state of a training by fastppo; give a policy that surrogym train saved with this "
                "algorithm"
            )
        return read_arrays(entries[LEARNER], MAX_BYTES, require)
    except (OSError, ValueError) as error:
        raise UnusablePolicy(f"training can't continue from {path}: {error}") from error


def _initialise(network: Mlp, last_gain: float, rng: np.random.Generator) -> None:
    for number, (weights, bias) in enumerate(network.layers):
        bias[:] = 0
        last = number == len(network.layers) - 1
        weights[:] = orthogonal(rng, len(weights), weights.shape[1], last_gain if last else HIDDEN_GAIN)
