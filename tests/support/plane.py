"""A point on a plane that drifts with its action, for rewards of any form."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from surrogym_server.environment.samples import Samples
from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Reward, Term, Uniform

Pay = Callable[[Tensor, Tensor], Tensor]
PLANE = {"x": Uniform(low=-1, high=1), "y": Uniform(low=-1, high=1)}


def plane() -> EnvironmentSpec:
    return EnvironmentSpec(
        coordinates=tuple(Coordinate(name=n, sampling=r) for n, r in PLANE.items()),
        observation=tuple(ObservationEntry(name=n, term=Term.linear(**{n: 1})) for n in PLANE),
        action=BoxAction(low=(-1,), high=(1,)),
        start=PLANE,
        reward=Reward(timing="after"),
    )


def drifting(pay: Pay, count: int, seed: int = 0) -> Samples:
    """A point that drifts with its action; ``pay`` gives the reward of (q', u)."""
    p = 2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 1
    q, u = p[:, :2], p[:, 2:]
    q_next = q + 0.1 * u
    return Samples(q, u, q_next, pay(q_next, u), torch.zeros(count, dtype=torch.bool))
