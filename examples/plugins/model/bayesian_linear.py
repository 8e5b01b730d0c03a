"""A family of dynamics models in one file: Bayesian linear regression on features of state and action.

Features are each coordinate, cosine and sine of an angle, the action, and the squares of all. With y = phi(x) w + noise
and a normal prior on w, everything is in closed form: C. Bishop, "Pattern Recognition and Machine Learning" (2006),
section 3.3. Shapes as in ``surrogym_server.models.port``; d features, p outputs of one regression.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import FeatureMap, encode
from surrogym_server.environment.observation_inverse import ObservationInverse
from surrogym_server.environment.samples import Samples, increments, saturated
from surrogym_server.environment.step_rules import moved, paid, placed
from surrogym_server.errors import InvalidInput
from surrogym_server.models.abilities import FunctionDraws, LeaveOneOut, LeaveOneOutErrors
from surrogym_server.models.port import DynamicsModel, Learned, Learner, ModelCodec, StoredModel, Transition, Warm
from surrogym_server.tensors import in_rows

LEAST_NOISE = 1e-6  # of an output's own deviation


@dataclass(frozen=True)
class Regression:
    """What the samples tell of some outputs: weights, and root root^T noise^2, the covariance of each output's."""

    weights: Tensor  # (d, p)
    root: Tensor  # (d, d)
    noise: Tensor  # (p,)
    scale: Tensor  # (p,)
    errors: Tensor  # (p, 3) leave-one-out: root mean square, shares within one and two deviations

    @classmethod
    def of(cls, x: Tensor, y: Tensor, ridge: float) -> Regression:
        """Of features x (n, d) and targets y (n, p)."""
        scale = y.std(0, correction=0)
        scale = torch.where(scale > 0, scale, 1.0)
        covariance = torch.linalg.inv(x.T @ x + ridge * torch.eye(x.shape[1], dtype=x.dtype))
        root = torch.linalg.cholesky((covariance + covariance.T) / 2)
        weights = root @ (root.T @ (x.T @ y))
        left_over = y - x @ weights
        noise = torch.maximum(left_over.square().mean(0).sqrt(), LEAST_NOISE * scale)
        leverage = (x @ root).square().sum(1, keepdim=True).clamp_max(1 - 1e-9)
        wrong = left_over / (1 - leverage)  # PRESS, in closed form
        within = [(wrong.abs() <= k * noise / (1 - leverage).sqrt()).double().mean(0) for k in (1, 2)]
        errors = torch.stack([wrong.square().mean(0).sqrt(), *within], 1)
        return cls(*map(in_rows, (weights, root, noise, scale, errors)))

    def std(self, x: Tensor) -> Tensor:
        """Of the mean at features x (m, d), (m, p)."""
        return torch.linalg.vector_norm(x @ self.root, dim=1)[:, None] * self.noise


@dataclass(frozen=True)
class LinearModel(DynamicsModel, FunctionDraws, LeaveOneOut):
    """Three regressions: of the increments, of the reward, and of the labels of an end."""

    definition: EnvironmentDefinition
    changes: Regression
    pay: Regression
    end: Regression
    terminal_reward: float
    samples: int
    digest: str

    def transition(
        self,
        q: Tensor,
        u: Tensor,
        *,
        noise: Tensor | None = None,
        process: Tensor | None = None,
        stds: bool = False,
        reward_std: bool = False,
    ) -> Transition:
        x = features(self.definition, q, u)
        spread = self.changes.std(x)
        change = x @ self.changes.weights
        change = change if noise is None else change + spread * noise
        return self._transition(q, u, change, self.pay.weights, process, spread, stds, reward_std)

    @property
    def path_size(self) -> int:
        d, p = self.changes.weights.shape
        return d * (p + 1)

    def draw(self, noise: Tensor) -> Tensor:
        """Weights of a function: how far they are from the mean's."""
        d, p = self.changes.weights.shape
        z = noise.reshape(len(noise), d, p + 1)
        drawn = [self.changes.root @ z[..., :p] * self.changes.noise, self.pay.root @ z[..., p:] * self.pay.noise]
        return torch.cat(drawn, -1).flatten(1)

    def transition_along(
        self,
        paths: Tensor,
        q: Tensor,
        u: Tensor,
        *,
        process: Tensor | None = None,
        stds: bool = False,
        reward_std: bool = False,
    ) -> Transition:
        d, p = self.changes.weights.shape
        away = paths[:, : self.path_size].reshape(len(paths), d, p + 1)
        x = features(self.definition, q, u)
        change = torch.einsum("md,mdp->mp", x, self.changes.weights + away[..., :p])
        spread, pay = self.changes.std(x), self.pay.weights + away[..., p:]
        return self._transition(q, u, change, pay, process, spread, stds, reward_std)

    def means(self, q: Tensor, u: Tensor) -> Tensor:
        change = features(self.definition, q, u) @ self.changes.weights
        made = self.transition(q, u)
        reward = paid(self.terminal_reward, made.reward, self.terminated(made.q_next))
        return torch.cat([change, reward[:, None]], -1)

    def learned_termination(self, q: Tensor) -> Tensor:
        u = q.new_zeros(len(q), self.definition.action.size)
        return (features(self.definition, q, u) @ self.end.weights)[:, 0].clamp(0, 1)

    @property
    def scales(self) -> Tensor:
        return torch.cat([self.changes.scale, self.pay.scale])

    @property
    def structures(self) -> tuple[str, ...]:
        return ("linear in features and their squares",) * len(self.definition.outputs)

    @property
    def description(self) -> dict[str, Any]:
        noise = torch.cat([self.changes.noise, self.pay.noise]).tolist()
        outputs = [{"name": n, "noise": s} for n, s in zip(self.definition.outputs, noise, strict=True)]
        return {"outputs": outputs, "terminal_reward": self.terminal_reward, "samples": self.samples}

    def leave_one_out(self) -> tuple[LeaveOneOutErrors, ...]:
        return tuple(LeaveOneOutErrors(*row) for row in torch.cat([self.changes.errors, self.pay.errors]).tolist())

    def _transition(
        self,
        q: Tensor,
        u: Tensor,
        change: Tensor,
        pay: Tensor,
        process: Tensor | None,
        spread: Tensor,
        stds: bool,
        reward_std: bool,
    ) -> Transition:
        """The step of changes (m, M), paid by weights ``pay`` (d, 1), or (m, d, 1) of each row's own function."""
        change = change if process is None else change + self.changes.noise * process
        q_next = moved(self.definition, self._inverse, q, u, placed(self.definition, change))
        state = q_next if self.definition.reward_timing == "after" else q
        x = features(self.definition, state, u)
        reward, doubt = (x[:, None] @ pay)[:, 0, 0], self.pay.std(x)[:, 0]
        if (known := self.definition.declared_reward) is not None:
            reward, doubt = known(q_next if known.after else q, u), torch.zeros_like(doubt)
        return Transition(q_next, reward, spread if stds else None, doubt if reward_std else None)

    @cached_property
    def _inverse(self) -> ObservationInverse | None:
        return ObservationInverse.of(self.definition) if self.definition.moves_observation else None


class LinearCodec(ModelCodec):
    def encode(self, model: DynamicsModel) -> StoredModel:
        if not isinstance(model, LinearModel):
            raise TypeError(f"expected a linear model, got {type(model).__name__}")
        arrays = {f"{part}.{name}": a for part in PARTS for name, a in vars(getattr(model, part)).items()}
        return StoredModel({name: getattr(model, name) for name in NUMBERS}, arrays)

    def decode(self, definition: EnvironmentDefinition, stored: StoredModel) -> LinearModel:
        d, count = _width(definition), len(definition.outputs)
        parts = {part: _read(stored.tensors, part, d, p) for part, p in zip(PARTS, (count - 1, 1, 1), strict=True)}
        numbers = [make(stored.header[name]) for name, make in NUMBERS.items()]
        if not torch.tensor(numbers[:2], dtype=torch.float64).isfinite().all():
            raise InvalidInput(f"expected finite numbers, got {numbers[:2]}")
        return LinearModel(definition, *parts.values(), *numbers)


@dataclass(frozen=True)
class BayesianLinear(Learner):
    """``ridge`` is the variance of the noise over that of the prior."""

    ridge: float = 1e-6

    def __post_init__(self) -> None:
        if not 0 < self.ridge < 1e6:
            raise ValueError(f"expected a positive ridge, got {self.ridge}")

    @property
    def codec(self) -> ModelCodec:
        return LinearCodec()

    def learn(self, definition: EnvironmentDefinition, samples: Samples, warm: Warm | None = None) -> Learned:
        del warm  # nothing is searched for
        if len(samples) < 2:
            raise InvalidInput(f"expected at least two samples, got {len(samples)}")
        x, free = features(definition, samples.q, samples.u), ~saturated(definition, samples.q_next)
        free = free if int(free.sum()) >= 2 else torch.ones_like(free)
        changes = Regression.of(x[free], increments(definition, samples)[free], self.ridge)
        known, goes_on = definition.declared_reward, ~samples.terminated
        goes_on = goes_on if int(goes_on.sum()) >= 2 else torch.ones_like(goes_on)
        x = features(definition, samples.q_next if definition.reward_timing == "after" else samples.q, samples.u)
        pay = Regression.of(x[goes_on], samples.reward[goes_on, None], self.ridge)
        beyond = (samples.reward - (x @ pay.weights)[:, 0])[~goes_on]
        terminal = known.terminal if known is not None else float(beyond.mean()) if len(beyond) else 0.0
        x = features(definition, samples.q_next, torch.zeros_like(samples.u))
        end = Regression.of(x, samples.terminated[:, None].double(), self.ridge)
        model = LinearModel(definition, changes, pay, end, terminal, len(samples), samples.digest)
        return Learned(model, {})


NUMBERS = {"terminal_reward": float, "samples": int, "digest": str}
PARTS = ("changes", "pay", "end")


def features(definition: EnvironmentDefinition, q: Tensor, u: Tensor) -> Tensor:
    """1, the encoded state and action, and their squares, at q (m, C) and u (m, F): (m, d)."""
    state = "observation" if definition.moves_observation else "both"
    x = encode(definition, FeatureMap(state, "one_hot" if definition.action.nvec else "value"), q, u)
    return torch.cat([torch.ones_like(x[:, :1]), x, x.square()], -1)


def _width(definition: EnvironmentDefinition) -> int:
    q = torch.zeros(1, len(definition.coordinates), dtype=torch.float64)
    return features(definition, q, q.new_zeros(1, definition.action.size)).shape[1]


def _read(arrays: dict[str, Tensor], part: str, d: int, p: int) -> Regression:
    shapes = {"weights": (d, p), "root": (d, d), "noise": (p,), "scale": (p,), "errors": (p, 3)}
    for name, shape in shapes.items():
        array = arrays[f"{part}.{name}"]
        if array.shape != shape or array.dtype != torch.float64 or not bool(array.isfinite().all()):
            raise InvalidInput(f"expected {part}.{name} of finite float64 {shape}, got {tuple(array.shape)}")
    return Regression(*(arrays[f"{part}.{name}"] for name in shapes))
