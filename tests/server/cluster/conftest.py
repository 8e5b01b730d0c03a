"""A surrogate with a model, in whatever database a test has."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from surrogym_client.original import classic
from surrogym_server.convert import stored_definition
from surrogym_server.engine.design_job import DesignJob, run_design_job
from surrogym_server.environment.samples import Samples
from surrogym_server.storage.port import Storage
from surrogym_server.storage.records import NewModel, NewSurrogate

NAME = "pendulum"


@pytest.fixture(scope="session")
def model(pendulum_samples: Samples) -> NewModel:
    samples = pendulum_samples
    arrays = (samples.q, samples.u, samples.q_next, samples.reward, samples.terminated)
    definition = stored_definition(classic.pendulum())
    job = DesignJob(definition, *(a.numpy() for a in arrays), state={}, budget=len(samples), target=0.999)
    done = run_design_job(job)
    return NewModel(len(samples), done.data_hash, done.fidelity, done.description, 0.0, done.model)


@pytest.fixture(scope="session")
def fill(model: NewModel) -> Callable[[Storage], int]:
    """Store the surrogate and its model; returns its id."""

    def store(storage: Storage) -> int:
        spec = classic.pendulum().model_dump(mode="json")
        record, _ = storage.surrogates.create(NewSurrogate(NAME, spec, 20, 0.999))
        storage.models.add(NAME, model)
        return record.id

    return store
