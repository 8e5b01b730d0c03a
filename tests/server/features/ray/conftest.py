"""A surrogate with a model, in whatever database a test has; and an engine of a real Ray cluster on PostgreSQL."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator

import pytest

from support.engine_laws import EngineCase
from support.postgresql import Postgresql
from support.real_steps import columns
from surrogym_sampler.original import classic
from surrogym_server.convert import stored_definition
from surrogym_server.engine.design_job import DesignJob, run_design_job
from surrogym_server.engine.port import SessionEngine
from surrogym_server.environment.samples import Samples
from surrogym_server.features.ray import pool
from surrogym_server.settings import Settings
from surrogym_server.storage.records import NewModel, NewSurrogate
from surrogym_server.storage.sql import Storage, open_storage

NAME, HOSTS = "pendulum", 2
LEASE = 6.0  # a busy machine may keep a host from renewing for some seconds


@pytest.fixture(scope="session")
def model(pendulum_samples: Samples) -> NewModel:
    samples = pendulum_samples
    definition = stored_definition(classic.pendulum())
    job = DesignJob(definition, columns(samples), state={}, budget=len(samples), target=0.999)
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


@pytest.fixture(scope="module")
def database(postgresql: Postgresql, fill: Callable[[Storage], int]) -> str:
    """A PostgreSQL database with one surrogate that has a model."""
    url = postgresql.new_database()
    storage = open_storage(url)
    fill(storage)
    storage.close()
    return url


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Of a Ray cluster that this process begins."""
    ray = pytest.importorskip("ray")
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}
    begun = ray.init(
        "local", num_cpus=HOSTS + 1, namespace=pool.NAMESPACE, include_dashboard=False, log_to_driver=False
    )
    yield str(begun.address_info["gcs_address"])
    ray.shutdown()


@pytest.fixture(scope="module")
def storage(database: str) -> Iterator[Storage]:
    opened = open_storage(database)
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def settings(database: str, address: str) -> Settings:
    fast = {"ray_lease_seconds": LEASE, "ray_checkpoint_seconds": 0.1}
    return Settings.model_validate({"database": database, "engine": "ray", "ray_address": address, **fast})


@pytest.fixture(scope="module")
def engine(settings: Settings, storage: Storage) -> SessionEngine:
    return pool.connect(settings, storage)


@pytest.fixture
def case(engine: SessionEngine, storage: Storage) -> EngineCase:
    return EngineCase(engine, NAME, storage.surrogates.get(NAME).id, stored_definition(classic.pendulum()))
