"""A log that comes in: a model of it alone, real steps only where it has not been, rows refused by index and reason."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import numpy as np
import pytest

from support import pendulum
from surrogym_server.engine.design_job import run_design_job
from surrogym_server.engine.models import ModelCache
from surrogym_server.errors import InvalidInput
from surrogym_server.sampling.design import initial_queries
from surrogym_server.services.definitions import Definitions
from surrogym_server.services.designer import Designer, DesignerSettings
from surrogym_server.services.metrics import ProcessMetrics
from surrogym_server.services.models import load_model
from surrogym_server.services.notices import Notices
from surrogym_server.services.samples import SampleService
from surrogym_server.storage.records import LedgerRecord, LogPart, NewSample, NewSurrogate
from surrogym_server.storage.sql import Storage

NAME = "pendulum"


class Here:
    """Runs jobs in this process."""

    async def run(self, job):
        return run_design_job(job)


@pytest.fixture
def service(storage: Storage, definitions: Definitions) -> SampleService:
    async def make() -> SampleService:  # notices belong to a running event loop
        return SampleService(storage, definitions, Notices())

    return asyncio.run(make())


@pytest.fixture
def fit(storage: Storage, definitions: Definitions):
    """Fits whatever is due."""
    cache = ModelCache(lambda id, version: load_model(storage, definitions, id, version), storage.models.newest)

    def run() -> None:
        async def once() -> None:
            designer = Designer(
                storage, definitions, initial_queries, Here(), cache, Notices(), ProcessMetrics(),
                DesignerSettings("here", threads=1, look_seconds=0.05, fit_seconds=3600),
            )  # fmt: skip
            await designer.fit_all_due()

        asyncio.run(once())

    return run


def logged(count: int, speed: float = 8.0) -> list[NewSample]:
    """Real steps of the pendulum from speeds up to this."""
    rng = np.random.default_rng(0)
    low, high = np.array([-np.pi, -speed, -2.0]), np.array([np.pi, speed, 2.0])
    steps = [pendulum.real_step(list(row[:2]), list(row[2:])) for row in rng.uniform(low, high, (count, 3))]
    return [NewSample(**{name: _tuple(value) for name, value in step.items()}) for step in steps]


def _tuple(value):
    return tuple(value) if isinstance(value, list) else value


def alone(storage: Storage, definitions: Definitions) -> str:
    """A surrogate that asks for no real step."""
    spec = pendulum.spec(budget=0)
    storage.surrogates.create(NewSurrogate("alone", spec, 0, 0.999))
    return "alone"


def test_a_model_is_learned_from_a_log_without_any_queries(
    storage: Storage, definitions: Definitions, service: SampleService, fit
):
    name = alone(storage, definitions)
    service.add(name, "log", logged(30), None, log=LogPart())
    fit()
    record = storage.surrogates.get(name)
    assert (record.phase, record.error) == ("from_log", None)
    assert storage.models.get(name).samples == 30
    assert storage.queries.list(name) == []


def test_a_log_covering_the_whole_range_replaces_the_initial_queries(storage: Storage, service: SampleService, fit):
    service.add(NAME, "log", logged(60), None, log=LogPart())
    assert storage.queries.list(NAME) == [], "all initial queries are covered"
    fit()
    assert storage.surrogates.get(NAME).phase == "sampling", "nobody chose the log to disprove the model"
    assert {query.purpose for query in storage.queries.list(NAME)} == {"adaptive"}
    assert storage.ledger.read(NAME) == LedgerRecord(logged=60)


def test_a_log_of_a_part_of_the_range_leaves_some_initial_queries(storage: Storage, service: SampleService):
    service.add(NAME, "log", logged(60, speed=0.5), None, log=LogPart())
    assert 0 < len(storage.queries.list(NAME, ("pending",))) < pendulum.INITIAL


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"action": (9.0,)}, r"samples\.2: action: expected entry 0 in \[-2, 2\], got 9$"),
        ({"action": (0.0, 0.0)}, r"samples\.2: action: expected shape \(1, 1\)"),
        ({"coordinates": (0.0,)}, r"samples\.2\.coordinates: expected shape \(n, 2\)"),
    ],
)
def test_a_log_with_an_invalid_row_is_refused_with_index_and_reason(
    storage: Storage, service: SampleService, change, reason: str
):
    rows = logged(4)
    rows[2] = replace(rows[2], **change)
    with pytest.raises(InvalidInput, match=reason):
        service.add(NAME, "log", rows, "key")
    assert storage.samples.count(NAME) == 0
