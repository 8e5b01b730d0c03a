"""Models whose predictions are known exactly, for the virtual environment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.step_rules import settle
from surrogym_server.models.port import DynamicsModel, Transition


@dataclass(frozen=True)
class ExactModel(DynamicsModel):
    """``move`` gives q' of (q, u), ``pay`` the reward of (q, u); both deviate as told, in each output alike."""

    definition: EnvironmentDefinition
    move: Callable[[Tensor, Tensor], Tensor]
    pay: Callable[[Tensor, Tensor], Tensor]
    std: float = 0.0
    reward_std: Callable[[Tensor], Tensor] = lambda q: torch.zeros(len(q), dtype=torch.float64)
    terminal_reward: float = 0.0
    process_std: float = 0.0
    samples: int = 1
    digest: str = ""

    @property
    def scales(self) -> Tensor:
        return torch.ones(len(self.definition.outputs), dtype=torch.float64)

    @property
    def structures(self) -> tuple[str, ...]:
        return ("exact",) * len(self.definition.outputs)

    @property
    def description(self) -> dict[str, Any]:
        return {"outputs": [{"name": name} for name in self.definition.outputs]}

    def learned_termination(self, q: Tensor) -> Tensor:
        raise AssertionError("its termination is declared")

    def means(self, q: Tensor, u: Tensor) -> Tensor:
        return torch.cat([(self.move(q, u) - q)[:, list(self.definition.moving)], self.pay(q, u)[:, None]], -1)

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
        q_next, moving = self.move(q, u), list(self.definition.moving)
        if process is not None:
            q_next[..., moving] += self.process_std * process
        if noise is not None:
            q_next[..., moving] += self.std * noise
        std = torch.full((len(q), len(moving)), self.std, dtype=q.dtype)
        return Transition(
            settle(self.definition, q_next),
            self.pay(q, u),
            std if stds else None,
            self.reward_std(q) if reward_std else None,
        )


def exact_pendulum() -> ExactModel:
    """Gymnasium's Pendulum-v1: g = 10, m = l = 1, dt = 0.05."""

    def move(q: Tensor, u: Tensor) -> Tensor:
        speed = (q[:, 1] + (15 * q[:, 0].sin() + 3 * u[:, 0]) * 0.05).clamp(-8, 8)
        return torch.stack([q[:, 0] + 0.05 * speed, speed], -1)

    def pay(q: Tensor, u: Tensor) -> Tensor:
        return -(q[:, 0].square() + 0.1 * q[:, 1].square() + 0.001 * u[:, 0].square())

    return ExactModel(definition_from_spec(pendulum()), move, pay)


def exact_cartpole() -> ExactModel:
    """Gymnasium's CartPole-v1: explicit Euler, tau = 0.02."""

    def move(q: Tensor, u: Tensor) -> Tensor:
        _, velocity, pole, omega = q.unbind(-1)
        force = 20 * u[:, 0] - 10
        pushed = (force + 0.05 * omega.square() * pole.sin()) / 1.1
        turned = (9.8 * pole.sin() - pole.cos() * pushed) / (0.5 * (4 / 3 - 0.1 * pole.cos().square() / 1.1))
        driven = pushed - 0.05 * turned * pole.cos() / 1.1
        rates = torch.stack([velocity, driven, omega, turned], -1)
        return q + 0.02 * rates

    def pay(q: Tensor, u: Tensor) -> Tensor:
        return q.new_ones(len(q))

    return ExactModel(definition_from_spec(cartpole()), move, pay)
