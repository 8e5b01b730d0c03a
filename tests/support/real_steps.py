"""Real steps of Gymnasium's own environments as samples of the core, in this process."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from surrogym_sampler.original import RealStep
from surrogym_sampler.original.gymnasium import GymnasiumEnvironment
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.samples import Samples
from surrogym_server.sampling.latin_hypercube import random_points
from surrogym_shared.nouns import Query, RealSteps
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.states import SamplePurpose


def arrays(queries: Sequence[Query]) -> tuple[Tensor, Tensor]:
    """Coordinates (n, C) and actions (n, F) of queries for single steps."""
    q, u = ([getattr(query, name) for query in queries] for name in ("coordinates", "action"))
    return torch.tensor(q, dtype=torch.float64), torch.tensor(u, dtype=torch.float64)


def answer(spec: EnvironmentSpec, q: Tensor, u: Tensor) -> Samples:
    """One real step from each of q (n, C) under u (n, F)."""
    original = GymnasiumEnvironment(spec)
    steps = [original.step_from(*point) for point in zip(q.numpy(), u.numpy(), strict=True)]
    original.close()
    return samples_of(steps)


def samples_of(steps: Sequence[RealStep]) -> Samples:
    return Samples(
        q=torch.tensor(np.array([s.coordinates for s in steps])),
        u=torch.tensor(np.array([s.action for s in steps])),
        q_next=torch.tensor(np.array([s.next_coordinates for s in steps])),
        reward=torch.tensor([s.reward for s in steps], dtype=torch.float64),
        terminated=torch.tensor([s.terminated for s in steps]),
    )


def roll(spec: EnvironmentSpec, actions: Tensor | Sequence[Sequence[float]], seed: int) -> Samples:
    """The real steps of one action sequence (T, F) from a reset, up to the end of the episode."""
    original = GymnasiumEnvironment(spec)
    original.begin(seed)
    steps = []
    for action in np.asarray(actions, dtype=np.float64):
        steps.append(original.act(action))
        if steps[-1].terminated:
            break
    original.close()
    return samples_of(steps)


def columns(samples: Samples, purpose: SamplePurpose = "manual") -> RealSteps:
    """Samples of the core as columns of a job."""
    arrays = (getattr(samples, name).numpy() for name in ("q", "u", "q_next", "reward", "terminated"))
    return RealSteps(*arrays, (purpose,) * len(samples))


def random_steps(spec: EnvironmentSpec, count: int, seed: int) -> Samples:
    """Real steps from anywhere in the sampling range."""
    return answer(spec, *random_points(definition_from_spec(spec), count, np.random.default_rng(seed)))


def join(*parts: Samples) -> Samples:
    return Samples(*(torch.cat([getattr(part, name) for part in parts]) for name in Samples.__dataclass_fields__))
