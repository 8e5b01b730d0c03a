"""Small environments with known equations, for tests of a model family."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch

from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples
from surrogym_server.environment.step_rules import settle, with_lags
from surrogym_server.models.port import DynamicsModel, Learned, Learner
from surrogym_server.models.registry import learner_of
from surrogym_server.sampling.latin_hypercube import random_points
from surrogym_shared.spec import EnvironmentSpec

SAMPLES, POINTS = 24, 40
LARGEST_SPEED, END = 6.0, 4.5
SPEED = {"kind": "uniform", "low": -5.0, "high": 5.0}
PENDULUM: dict[str, Any] = {
    "coordinates": [
        {"name": "angle", "kind": "angle", "sampling": {"kind": "uniform", "low": -3.141592, "high": 3.141592}},
        {"name": "speed", "sampling": SPEED, "bounds": {"low": -LARGEST_SPEED, "high": LARGEST_SPEED}},
    ],
    "observation": [
        {"name": "cos", "term": {"parts": [{"function": "cos", "weights": {"angle": 1}}]}},
        {"name": "sin", "term": {"parts": [{"function": "sin", "weights": {"angle": 1}}]}},
        {"name": "speed", "term": {"parts": [{"function": "linear", "weights": {"speed": 1}}]}},
    ],
    "action": {"kind": "box", "low": [-2.0], "high": [2.0]},
    "start": {"angle": {"kind": "uniform", "low": -1.0, "high": 1.0}, "speed": SPEED},
    "time_limit": 20,
}
FAST = {
    "term": {"parts": [{"function": "linear", "weights": {"speed": 1}}]},
    "relation": ">",
    "value": END,
}
COST = {"kind": "declared", "terms": [{"shape": "square", "weight": -1, "of": [{"action": [1.0]}]}]}
LAGS: list[dict[str, Any]] = [
    {"name": "turned", "sampling": {"kind": "uniform", "low": -0.6, "high": 0.6}},
    {"name": "pushed", "sampling": {"kind": "uniform", "low": -2.0, "high": 2.0}},
    {"name": "steps", "sampling": {"kind": "uniform", "low": 0.0, "high": 1.0}, "bounds": {"low": 0.0, "high": 1.0}},
]
LAGS[0]["lag"], LAGS[1]["lag"] = {"kind": "change", "of": "angle"}, {"kind": "action", "entry": 0}
LAGS[2]["lag"] = {"kind": "steps"}
REST = {lag["name"]: {"kind": "fixed", "value": 0.0} for lag in LAGS}
VARIATIONS: dict[str, dict[str, Any]] = {
    "learned reward": {},
    "declared reward": {"reward": COST},
    "declared end": {"termination": [[FAST]]},
    "learned end": {"termination": "learned"},
    "discrete actions": {"action": {"kind": "discrete", "n": 3}},
    "lags": {"coordinates": [*PENDULUM["coordinates"], *LAGS], "start": PENDULUM["start"] | REST, "query": "rollout"},
}


@dataclass(frozen=True)
class ModelCase:
    """A test case of a model family: an environment, the learned model, and points at which the model is tested."""

    name: str
    definition: EnvironmentDefinition
    count: int = SAMPLES  # number of real steps from which the model learns

    def __str__(self) -> str:
        return self.name

    @property
    def learner(self) -> Learner:
        return learner_of(self.definition.learning.model)

    @cached_property
    def samples(self) -> Samples:
        """Real steps from which the model learns."""
        return _real_steps(self, self.count, seed=0)

    @cached_property
    def unseen(self) -> Samples:
        """Real steps from which the model has not learned."""
        return _real_steps(self, POINTS, seed=1)

    @cached_property
    def learned(self) -> Learned:
        return self.learner.learn(self.definition, self.samples)

    @property
    def model(self) -> DynamicsModel:
        return self.learned.model

    @property
    def points(self) -> Points:
        return Points(self.unseen.q, self.unseen.u)

    def noise(self, *shape: int) -> torch.Tensor:
        """Return standard normal random numbers of the given shape. Each call with the same shape returns the same."""
        return torch.randn(*shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


def model_cases(
    family: str, settings: Mapping[str, float | bool | str] | None = None, samples: int = SAMPLES
) -> tuple[ModelCase, ...]:
    """Return test cases for a model family with these settings: one for each of several environments, in each of which
    the model learns from ``samples`` real steps."""
    design = {"model": {"name": family, "settings": dict(settings or {})}, "monte_carlo": 64, "initial": SAMPLES}
    return tuple(
        ModelCase(
            name, definition_from_spec(EnvironmentSpec.model_validate(PENDULUM | changes | {"design": design})), samples
        )
        for name, changes in VARIATIONS.items()
    )


def close(one: torch.Tensor, other: torch.Tensor) -> bool:
    """Whether two tensors are equal except for rounding."""
    return torch.allclose(one, other, rtol=1e-7, atol=1e-9)


def _real_steps(case: ModelCase, count: int, seed: int) -> Samples:
    """Return ``count`` steps of a pendulum from random states under random actions, which push the pendulum. The reward
    is the declared one, or else depends on the angle and the push."""
    q, u = random_points(case.definition, count, np.random.default_rng(seed))
    angle, speed = q[:, 0], q[:, 1]
    push = u[:, 0] - 1 if case.definition.action.nvec else u[:, 0]
    faster = (speed + 0.1 * (5 * angle.sin() + 3 * push)).clamp(-LARGEST_SPEED, LARGEST_SPEED)
    arrived = settle(case.definition, torch.cat([torch.stack([angle + 0.1 * faster, faster], -1), q[:, 2:]], -1))
    q_next = with_lags(case.definition, q, u, arrived)
    known = case.definition.declared_reward
    reward = angle.cos() - 0.1 * push.square() if known is None else known(q, u)
    ends = case.definition.learns_termination | bool(case.definition.termination_groups)
    return Samples(q, u, q_next, reward, (q_next[:, 1] > END) & ends)
