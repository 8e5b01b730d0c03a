"""Turns: what an angle moved by, where it came back wrapped."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from surrogym_server.environment.angle_unwrapping import angle_increments
from surrogym_server.environment.definition import EnvironmentDefinition, wrap

DT = 0.2


def spun(fastest: float, count: int = 60, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Steps of an angle as fast as ``fastest``, pulled on by gravity: q, q_next and increments."""
    rng = torch.Generator().manual_seed(seed)
    angle, speed = (2 * torch.rand(2, count, generator=rng, dtype=torch.float64) - 1) * torch.tensor(
        [[math.pi], [fastest]], dtype=torch.float64
    )
    after = speed + DT * 9.81 * angle.sin()
    change = DT * (speed + after) / 2
    return torch.stack([angle, speed], -1), torch.stack([wrap(angle + change), after], -1), change


@pytest.mark.parametrize("fastest", [30.0, 60.0])
def test_an_angle_that_turns_more_than_half_a_circle_per_step_is_unwrapped(
    pendulum_definition: EnvironmentDefinition, fastest: float
) -> None:
    q, q_next, change = spun(fastest)
    assert (change.abs() > math.pi).sum() > 10
    assert torch.allclose(angle_increments(pendulum_definition, q, q_next)[:, 0], change, atol=1e-9)


def test_a_slow_angle_keeps_its_increment_bit_for_bit(pendulum_definition: EnvironmentDefinition) -> None:
    q, q_next, _ = spun(8.0)
    assert torch.equal(angle_increments(pendulum_definition, q, q_next), wrap(q_next - q)[:, :1])


def test_angles_unrelated_to_the_speeds_are_not_unwrapped(pendulum_definition: EnvironmentDefinition) -> None:
    rng = torch.Generator().manual_seed(1)
    q, q_next = (6 * torch.rand(60, 2, generator=rng, dtype=torch.float64) - 3 for _ in range(2))
    assert torch.equal(angle_increments(pendulum_definition, q, q_next), wrap(q_next - q)[:, :1])


def test_angles_of_too_few_steps_are_not_unwrapped(pendulum_definition: EnvironmentDefinition) -> None:
    q, q_next, _ = spun(60.0, count=5)
    assert torch.equal(angle_increments(pendulum_definition, q, q_next), wrap(q_next - q)[:, :1])
