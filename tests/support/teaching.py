"""Answer a surrogate's queries from the original environment, in this process, until its design is done."""

from __future__ import annotations

import time

import numpy as np

from surrogym_client.surrogates.waiting import COMPLETED
from surrogym_client.transport import Api
from surrogym_sampler.original.gymnasium import GymnasiumEnvironment
from surrogym_shared import wire
from surrogym_shared.spec import EnvironmentSpec


def teach(
    api: Api, name: str, spec: EnvironmentSpec, queries: int, initial: int | None = None, seconds: float = 120.0
) -> wire.SurrogateView:
    """Register a surrogate and answer ``queries``, of which ``initial`` come before the first fit (None: all)."""
    design = spec.design.model_copy(update={"initial": queries if initial is None else initial, "budget": queries})
    api.create_surrogate(name, spec.model_copy(update={"design": design}))
    original, deadline = GymnasiumEnvironment(spec), time.monotonic() + seconds
    while time.monotonic() < deadline:
        claimed = api.claim(name, "teacher", max_queries=queries, wait_seconds=1.0)
        if claimed.phase in COMPLETED:
            return api.surrogate(name)
        if claimed.phase == "failed":
            raise AssertionError(f"the design of {name} failed: {api.surrogate(name).error}")
        if claimed.queries:
            steps = [query for query in claimed.queries if isinstance(query, wire.StepQuery)]
            api.add_samples(name, "teacher", [answer(original, query) for query in steps])
    raise AssertionError(f"the design of {name} had not ended after {seconds} s: {api.surrogate(name)}")


def answer(original: GymnasiumEnvironment, query: wire.StepQuery) -> wire.NewSample:
    """One real step, as the sample that answers a claimed query."""
    step = original.step_from(np.array(query.coordinates), np.array(query.action))
    return wire.NewSample(
        query_id=query.id,
        lease_token=query.lease_token,
        coordinates=np.asarray(step.coordinates).tolist(),
        action=np.asarray(step.action).tolist(),
        next_coordinates=np.asarray(step.next_coordinates).tolist(),
        reward=step.reward,
        terminated=step.terminated,
    )
