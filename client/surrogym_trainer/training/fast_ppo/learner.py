"""Actor, critic and Adam: the state that an update of proximal policy optimisation changes.

Loss of a batch, with ratio r = p(a) / p_old(a) and advantages A of mean 0 and deviation 1 in the batch:

    -mean(min(r A, clip(r, 1 - c, 1 + c) A)) + v mean((V - R)^2)

References: Schulman et al. (2017), arXiv 1707.06347, eq. 7; Kingma and Ba (2015). The constants are those of
Stable-Baselines3; the update, in ``compiled``, equals its update, apart from rounding. The action distributions are
those of ``surrogym_shared.distributions``.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.acting import ActingPolicy, layers_of, parameters_of
from surrogym_shared.archives import Header, read_arrays, read_entries
from surrogym_shared.compiled import available
from surrogym_shared.distributions import Bounded, distribution_of
from surrogym_shared.kinds import Activation
from surrogym_shared.network import MAX_BYTES, Layer, Network, bounds_of, forward
from surrogym_shared.spec import EnvironmentSpec
from surrogym_trainer.policies.card import UnusablePolicy
from surrogym_trainer.policies.defaults import CRITIC, EXPLORATION
from surrogym_trainer.policies.files import load_network
from surrogym_trainer.policies.predict import Predict

Array = NDArray[np.floating[Any]]  # always float32

HIDDEN_GAIN, ACTION_GAIN, VALUE_GAIN = 2**0.5, 0.01, 1.0
NARROWEST = 0.1  # if inputs are standardised again, the smallest new standard deviation, as a share of the previous one
LEARNER = "learner.npz"  # name of the entry in a policy's file from which its training can continue
VECTORS = ("parameters", "first", "second")


@cache
def compiled_update() -> Callable[..., None]:
    """Return the update in compiled code.

    Raises:
        ValueError: this installation can't compile it.
    """
    if available():
        with suppress(ImportError):  # SciPy is not installed, or numba does not support this version of NumPy
            from surrogym_trainer.training.fast_ppo.compiled import update

            return update
    raise ValueError(
        "algorithm FASTPPO: expected numba and SciPy, which compile it, got an installation without one, or with "
        "SURROGYM_COMPILED=0: run pip install 'surrogym[train]', or take --algorithm ppo"
    )


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
    """Actor, critic and Adam, with all parameters in one vector.

    Args:
        spec: specification of the environment.
        mean: mean (D,) by which observations are standardised.
        deviation: standard deviation (D,) by which observations are standardised.
        units: numbers of units in the actor's hidden layers.
        rng: draws the initial parameters.

    Raises:
        ValueError: this installation can't compile the update.
    """

    def __init__(
        self,
        spec: EnvironmentSpec,
        mean: NDArray[np.float64],
        deviation: NDArray[np.float64],
        units: tuple[int, ...],
        rng: np.random.Generator,
    ) -> None:
        self._spec = spec
        self.mean, self.deviation = mean.astype(np.float32), deviation.astype(np.float32)
        counts, none = spec.action.policy_counts, np.zeros(0, dtype=np.float32)
        self.distribution = shape = distribution_of(counts, *bounds_of(spec), np.dtype(np.float32))
        self.activation: Activation = "relu" if counts else "tanh"
        centre, reach = (shape.centre, shape.reach) if isinstance(shape, Bounded) else (none, none)
        inputs = len(spec.observation)
        actor, critic = (inputs, *units, shape.outputs), (inputs, *CRITIC, 1)
        ends = np.cumsum([parameters_of(inputs, actor[1:]), parameters_of(inputs, critic[1:]), len(reach)])
        self.parameters = np.zeros(ends[-1], dtype=np.float32)
        self._first, self._second = np.zeros_like(self.parameters), np.zeros_like(self.parameters)
        self._updates = 0
        self.actor = layers_of(actor, self.parameters[: ends[0]])
        self.critic = layers_of(critic, self.parameters[ends[0] : ends[1]])
        self.further = self.parameters[ends[1] :]  # (F,) log standard deviations of continuous actions
        self._explores: Array = np.log(EXPLORATION * reach)
        self.further[:] = self._explores
        sizes = (np.array(one, dtype=np.int64) for one in (actor, critic, ends, counts))
        self._fixed = *sizes, self.activation == "relu", centre, reach
        self._update = compiled_update()
        _initialise(self.actor, ACTION_GAIN, rng)
        _initialise(self.critic, VALUE_GAIN, rng)

    def standardised(self, observation: NDArray[Any]) -> Array:
        x: Array = ((observation - self.mean) / self.deviation).astype(np.float32, copy=False)
        return x

    def acting(self) -> ActingPolicy:
        """Return the actor and its noise as arrays, which are views of the parameters."""
        log_deviations = self.further if len(self.further) else None
        return ActingPolicy(self.mean, self.deviation, self.actor, self.activation, log_deviations)

    def values(self, x: Array) -> Array:
        """Return the critic's values (B,) of standardised observations (B, D)."""
        return forward(self.critic, self.activation, x)[:, 0]

    def update(self, batch: Batch, objective: Objective, rate: float) -> None:
        """Take one step of Adam, with a learning rate, on the loss of a batch."""
        self._updates += 1
        rows = batch.observations, batch.actions, batch.log_probabilities, batch.advantages, batch.returns
        moments, constants = (self._first, self._second), (self._updates, *astuple(objective), rate)
        self._update(self.parameters, *moments, *self._fixed, *rows, *constants)

    def keep_noise(self, share: float) -> None:
        """Raise the standard deviations of continuous actions to at least this share of their first values."""
        np.maximum(self.further, self._explores + np.float32(np.log(share)), out=self.further)

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
        weights, bias = self.actor[0]
        bias += middle @ weights
        weights *= spread[:, None]
        self.mean, self.deviation = self.mean + middle * self.deviation, self.deviation * spread
        _initialise(self.critic, VALUE_GAIN, rng)
        self._first[:], self._second[:], self._updates = 0, 0, 0

    def policy(self) -> Network:
        """Return the policy of the actor's most probable actions, with the current parameters."""
        return Network(
            self.mean.astype(np.float64),
            self.deviation.astype(np.float64),
            tuple(Layer(weights.astype(np.float64), bias.astype(np.float64)) for weights, bias in self.actor),
            *bounds_of(self._spec),
            self._spec.action.policy_counts,
            self.activation,
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
    distribution = distribution_of(policy.counts, policy.low, policy.high, np.dtype(np.float32))
    parameters, rng = _state(path, _require_parameters)["parameters"], np.random.default_rng(0)
    further = parameters[len(parameters) - (0 if policy.counts else len(policy.low)) :]
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


def _initialise(layers: Sequence[Layer], last_gain: float, rng: np.random.Generator) -> None:
    """Draw weights (I, O) with orthogonal columns or rows, times a gain (Saxe et al., 2014). Biases are 0."""
    for weights, bias in layers:
        bias[:] = 0
        gain = last_gain if bias is layers[-1].bias else HIDDEN_GAIN
        q, r = np.linalg.qr(rng.normal(size=sorted(weights.shape, reverse=True)))
        q *= np.sign(np.diag(r))
        weights[:] = (gain * (q if len(q) == len(weights) else q.T)).astype(np.float32)
