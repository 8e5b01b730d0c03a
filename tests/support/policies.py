"""Policies of Pendulum for tests: small networks of random arrays, with promises and real episodes of any return."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum
from surrogym_shared import wire
from surrogym_shared.network import Network


@contextmanager
def left_alone(api: Api, surrogate: str) -> Iterator[None]:
    """End without the jobs and policies that came in the context: other tests share the surrogate."""
    before = {policy.version for policy in api.policies.list(surrogate)}
    try:
        yield
    finally:
        for job in api.jobs.list(surrogate).jobs:
            api.jobs.cancel(surrogate, job.id)
        for policy in api.policies.list(surrogate):
            if policy.version not in before:
                api.policies.delete(surrogate, policy.version)


def network_file(seed: int) -> bytes:
    """What ``Network.save`` writes of random arrays."""
    spec = pendulum()
    vector = np.random.default_rng(seed).normal(size=Network.size(spec, 4))
    with TemporaryDirectory() as folder:
        path = Path(folder) / "policy.zip"
        Network.of(spec, np.zeros(3), np.ones(3), 4, vector).save(path)
        return path.read_bytes()


def store(api: Api, surrogate: str, seed: int, mean: float, **fields: Any) -> int:
    """Store a policy that promised about ``mean`` and earned it in 30 real episodes; gives its version."""
    promise = wire.PolicyPromise(median=mean, low=mean - 20, high=mean + 20)
    card = wire.PushedCard(**{"algorithm": "PPO", "promise": promise, "trusted": True, "reason": "agrees", **fields})
    curve = [wire.CurvePoint(steps=1000 * n, imagined_return=mean - 1000 / (n + 1)) for n in range(20)]
    version = api.policies.push(surrogate, card, curve, "zip", network_file(seed)).version
    returns = mean + np.random.default_rng(seed).normal(0, 10, 30)
    common = {"first_seed": 10_000, "lengths": [200] * 30, "note": "declared starts"}
    episodes = [_trace(rank, seed) for rank in ("paired", "best", "median", "worst")]
    own = wire.AddEvaluation(**common, returns=returns.tolist(), traces=episodes, idempotency_key=f"own{seed}")
    alone = wire.AddEvaluation(
        **common, controller="zero", returns=(returns - 900).tolist(), idempotency_key=f"alone{seed}"
    )
    for evaluation in (own, alone):
        api.policies.evaluate(surrogate, version, evaluation)
    return version


def _trace(rank: Any, seed: int) -> wire.EpisodeTrace:
    path = np.random.default_rng(seed).normal(0, 0.1, (51, 2)).cumsum(0).clip(-3, 3)
    return wire.EpisodeTrace(rank=rank, seed=10_000, coordinates=path.tolist(), action=[[0.5]] * 50, reward=[-1.0] * 50)
