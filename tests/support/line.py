"""A point on a line that should go to 1, where the optimal trajectory is known: full speed ahead, then rest."""

from __future__ import annotations

import torch
from torch import Tensor

from support.exact_models import ExactModel
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.samples import Samples
from surrogym_shared.spec import BoxAction, Coordinate, Design, EnvironmentSpec, ObservationEntry, Reward, Term, Uniform

SPEED, GOAL = 0.2, 1.0  # of a step at full action; from 0 it takes five steps


def line(time_limit: int = 12) -> EnvironmentSpec:
    return EnvironmentSpec(
        coordinates=(Coordinate(name="x", sampling=Uniform(low=-3, high=3)),),
        observation=(ObservationEntry(name="x", term=Term.linear(x=1)),),
        action=BoxAction(low=(-1,), high=(1,)),
        start={"x": Uniform(low=-0.01, high=0.01)},
        time_limit=time_limit,
        reward=Reward(timing="after"),
        design=Design(symmetry="none"),
    )


def move(q: Tensor, u: Tensor) -> Tensor:
    return q + SPEED * u


def pay(q: Tensor, u: Tensor) -> Tensor:
    """The reward of the step from q under u."""
    return -(move(q, u)[:, 0] - GOAL).square()


def exact_line(deviation: float = 0.0) -> ExactModel:
    return ExactModel(definition_from_spec(line()), move, pay, deviation)


def taught(count: int) -> Samples:
    """Steps from anywhere on a line whose steps have small short waves, so that a sample tells of its neighbours
    alone."""
    p = 2 * torch.rand(count, 2, generator=torch.Generator().manual_seed(5), dtype=torch.float64) - 1
    q, u = 3 * p[:, :1], p[:, 1:]
    q_next = move(q, u) + 0.04 * ((7 * q).sin() + (11 * q + 1).cos())
    return Samples(q, u, q_next, -(q_next[:, 0] - GOAL).square(), torch.zeros(count, dtype=torch.bool))
