"""A model of the Pendulum, fitted once from real steps, and sessions of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from support import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.engine.design_job import DesignJob, DesignResult, run_design_job
from surrogym_server.engine.session import Reservoir, Session
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.models.files import from_bytes
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.virtual import VirtualSettings, create
from surrogym_shared.nouns import RealStep, RealSteps
from surrogym_shared.spec import EnvironmentSpec

Fitted = Callable[[int], GaussianProcessModel]


@pytest.fixture(scope="session")
def definition() -> EnvironmentDefinition:
    return definition_from_spec(EnvironmentSpec.model_validate(pendulum.spec()))


@pytest.fixture(scope="session")
def fitted(definition: EnvironmentDefinition) -> Fitted:
    """A model of n samples; each is fitted once."""
    made: dict[int, GaussianProcessModel] = {}

    def fit(samples: int) -> GaussianProcessModel:
        if samples not in made:
            made[samples] = from_bytes(definition, _design(definition, samples).model)
        return made[samples]

    return fit


@pytest.fixture
def job(definition: EnvironmentDefinition) -> DesignJob:
    """A round of a real design, with what it needs to choose queries."""
    return replace(_job(definition, 8), budget=10)


def _design(definition: EnvironmentDefinition, samples: int) -> DesignResult:
    return run_design_job(_job(definition, samples))


def _job(definition: EnvironmentDefinition, samples: int) -> DesignJob:
    rng = np.random.default_rng(samples)
    q = rng.uniform([-3, -7], [3, 7], (samples, 2))
    u = rng.uniform(-2, 2, (samples, 1))
    steps = [pendulum.real_step(list(at), list(action)) for at, action in zip(q, u, strict=True)]
    threads = torch.get_num_threads()
    return DesignJob(
        definition=definition,
        samples=RealSteps.of([RealStep(**step) for step in steps], "manual"),
        state={},
        budget=samples,
        target=0.999,
        threads=threads,
    )


@pytest.fixture
def opened(definition: EnvironmentDefinition) -> Callable[..., Session]:
    """A session of N = 4 lanes under version 1."""

    def open_one(id: str = "s", occupancy: bool = False, **settings: object) -> Session:
        values: dict[str, object] = {"num_envs": 4, "time_limit": 3, "autoreset_mode": "same_step", **settings}
        lanes = VirtualSettings(**values)  # type: ignore[arg-type]
        state, versions = create(definition, lanes, 3), np.ones(lanes.num_envs, dtype=np.int64)
        visited = Reservoir(3) if occupancy else None
        return Session(id, "pendulum", definition, lanes, 3, "latest", state, versions, visited=visited)

    return open_one
