"""The designer: fits what is due, stores all of it at once, and a fit that fails or is cut short loses nothing."""

from __future__ import annotations

import asyncio
import re
import sqlite3
from collections.abc import Callable
from concurrent.futures import CancelledError
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from support import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.engine.design_job import DesignJob, DesignResult, run_design_job
from surrogym_server.engine.models import ModelCache
from surrogym_server.errors import ChoiceFailed, InvalidInput, NoModel, NumericalFailure, Unavailable
from surrogym_server.sampling.design import initial_queries
from surrogym_server.services.definitions import Definitions
from surrogym_server.services.designer import ATTEMPTS, Designer, DesignerSettings
from surrogym_server.services.metrics import ProcessMetrics
from surrogym_server.services.models import load_model
from surrogym_server.services.notices import Notices
from surrogym_server.storage.records import NewSample, NewSurrogate, SurrogateRecord
from surrogym_server.storage.sql import Storage
from surrogym_shared.nouns import Query
from surrogym_shared.spec import EnvironmentSpec

NAME = "pendulum"


class Runner:
    """Does jobs here, or what a test puts in their place; remembers them."""

    def __init__(self, function: Callable[[DesignJob], DesignResult] = run_design_job) -> None:
        self.function = function
        self.jobs: list[DesignJob] = []
        self.hang = False
        self.hang_at_budget = 0
        self.ended = 0

    async def run(self, job: DesignJob) -> DesignResult:
        self.jobs.append(job)
        if self.hang or job.budget == self.hang_at_budget:
            try:
                await asyncio.sleep(3600)
            finally:
                self.ended += 1
        return self.function(job)


def refuse(error: Exception) -> Callable[[DesignJob], DesignResult]:
    def function(_: DesignJob) -> DesignResult:
        raise error

    return function


@pytest.fixture
def runner() -> Runner:
    return Runner()


@pytest.fixture
def cache(storage: Storage, definitions: Definitions) -> ModelCache:
    return ModelCache(
        lambda surrogate, version: load_model(storage, definitions, surrogate, version), storage.models.newest
    )


@pytest.fixture
def designer(storage: Storage, definitions: Definitions, cache: ModelCache, runner: Runner):
    """Makes a designer of the running event loop."""

    def make(fit_seconds: float = 3600, fit_workers: int = 1) -> Designer:
        return Designer(
            storage,
            definitions,
            initial_queries,
            runner,
            cache,
            Notices(),
            ProcessMetrics(),
            DesignerSettings("here", 1, look_seconds=0.05, fit_seconds=fit_seconds, fit_workers=fit_workers),
        )

    return make


def designer_of(designer: Callable[[], Designer]) -> Callable[[int], None]:
    """Lets one designer look for what is due so many times."""
    made: list[Designer] = []

    async def run(times: int) -> None:
        made.append(made[-1] if made else designer())
        for _ in range(times):
            await made[-1].fit_all_due()

    return lambda times: asyncio.run(run(times))


def fit_all(designer: Callable[[], Designer]) -> None:
    async def run() -> None:
        await designer().fit_all_due()

    asyncio.run(run())


def test_no_fit_starts_while_initial_queries_are_open(storage: Storage, designer, runner: Runner):
    fit_all(designer)
    assert runner.jobs == []
    assert storage.surrogates.get(NAME).phase == "collecting"


def test_a_fit_stores_a_model_and_the_next_queries(answered: Storage, designer, cache: ModelCache):
    fit_all(designer)
    record = answered.surrogates.get(NAME)
    assert (record.phase, record.round, record.state["round"]) == ("sampling", 1, 1)
    adaptive = answered.queries.list(NAME, ("pending",))
    assert 1 <= len(adaptive) <= pendulum.BUDGET - pendulum.INITIAL
    assert {query.purpose for query in adaptive} == {"adaptive"}
    assert cache.latest(answered.surrogates.get(NAME).id) == 1
    assert answered.models.get(NAME).samples == pendulum.INITIAL


def test_a_fit_job_contains_samples_budget_and_visited_states(answered: Storage, designer, runner: Runner):
    answered.occupancy.put(NAME, "visited", np.ones((3, 2)))
    answered.designs.improve(NAME, 2, checkpoint="visited")
    fit_all(designer)
    job = runner.jobs[0]
    assert (len(job.samples), job.extra_queries, job.budget) == (pendulum.INITIAL, 2, pendulum.BUDGET)
    np.testing.assert_array_equal(job.occupancy, np.ones((3, 2)))
    assert (job.previous, job.samples.purpose) == (None, ("initial",) * pendulum.INITIAL)


def test_a_fit_job_contains_the_previous_model(answered: Storage, designer, runner: Runner):
    fit_all(designer)
    assert pendulum.answer_open(answered, NAME) > 0
    fit_all(designer)
    assert runner.jobs[-1].previous == answered.models.blob(NAME, 1)


def test_a_budget_lowered_after_an_improve_request_limits_its_extra_queries(
    answered: Storage, designer, runner: Runner
):
    """What was promised within the old budget is not asked beyond the new one."""
    answered.designs.improve(NAME, 2)
    answered.surrogates.change(NAME, budget=pendulum.INITIAL + 1)
    fit_all(designer)
    assert runner.jobs[0].extra_queries == 1
    assert len(answered.queries.list(NAME)) <= pendulum.INITIAL + 1


def test_stored_visited_states_are_ignored_unless_improve_names_them(answered: Storage, designer, runner: Runner):
    answered.occupancy.put(NAME, "visited", np.ones((3, 2)))
    fit_all(designer)
    assert runner.jobs[0].occupancy is None


def test_a_failed_fit_stores_its_error_and_is_retried_only_after_a_change(answered: Storage, designer, runner: Runner):
    runner.function = refuse(NumericalFailure("no jitter repairs it"))
    for _ in range(3):
        fit_all(designer)
    record = answered.surrogates.get(NAME)
    assert (record.phase, record.error) == ("failed", "the fit failed: no jitter repairs it")
    assert len(runner.jobs) == 1, "the same samples would fail again"
    runner.function = run_design_job
    answered.surrogates.change(NAME, paused=True)
    answered.surrogates.change(NAME, paused=False)
    fit_all(designer)
    assert (answered.surrogates.get(NAME).phase, answered.surrogates.get(NAME).error) == ("sampling", None)


def test_an_unexpected_fit_error_fails_only_that_surrogates_design(answered: Storage, designer, runner: Runner):
    runner.function = refuse(ZeroDivisionError("surprise"))
    fit_all(designer)
    assert answered.surrogates.get(NAME).error == "the fit failed: ZeroDivisionError: surprise"


def test_the_error_of_a_failing_acquisition_names_the_acquisition(answered: Storage, designer, runner: Runner):
    said = "the choice of the next queries failed: acquisition focused: ValueError: x not in tuple"
    runner.function = refuse(ChoiceFailed(said))
    fit_all(designer)
    assert answered.surrogates.get(NAME).error == said


def test_a_fit_whose_process_was_killed_is_repeated(answered: Storage, designer, runner: Runner):
    made = designer_of(designer)
    runner.function = refuse(Unavailable("the process that fits died twice"))
    made(ATTEMPTS - 1)
    record = answered.surrogates.get(NAME)
    assert (record.phase, record.error) == ("collecting", None)
    runner.function = run_design_job
    made(1)
    assert answered.surrogates.get(NAME).phase == "sampling"
    assert len(runner.jobs) == ATTEMPTS


def test_a_fit_whose_process_is_always_killed_fails_after_some_attempts(answered: Storage, designer, runner: Runner):
    made = designer_of(designer)
    runner.function = refuse(Unavailable("the process that fits died twice"))
    made(ATTEMPTS + 3)
    record = answered.surrogates.get(NAME)
    assert (record.phase, record.error) == ("failed", "the fit failed: the process that fits died twice")
    assert len(runner.jobs) == ATTEMPTS
    answered.surrogates.change(NAME, paused=False)
    made(1)
    assert (answered.surrogates.get(NAME).phase, len(runner.jobs)) == ("collecting", ATTEMPTS + 1), "it counts anew"


def test_a_fit_that_cannot_be_stored_is_repeated(answered: Storage, designer, runner, monkeypatch):
    def away(*_: object) -> int:
        raise Unavailable("the database can't be used now")

    made = designer_of(designer)
    with monkeypatch.context() as patched:
        patched.setattr(answered.designs, "commit", away)
        made(1)
    assert answered.surrogates.get(NAME).error is None
    made(1)
    assert answered.surrogates.get(NAME).phase == "sampling"


def test_a_fit_interrupted_by_a_shutdown_stays_due(answered: Storage, designer, runner: Runner):
    runner.hang = True

    async def run() -> None:
        task = asyncio.create_task(designer().run())
        while not runner.jobs:
            await asyncio.sleep(0.01)
        assert answered.surrogates.get(NAME).phase == "fitting"
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(run())
    assert answered.designs.due() == [NAME]
    assert answered.surrogates.get(NAME).phase != "failed"


def test_deleting_a_surrogate_during_its_fit_raises_no_error(answered: Storage, designer, runner: Runner):
    def delete(job: DesignJob) -> DesignResult:
        answered.surrogates.delete(NAME)
        return run_design_job(job)

    runner.function = delete
    fit_all(designer)
    assert answered.surrogates.summaries() == []


@pytest.fixture
def watchful(monkeypatch: pytest.MonkeyPatch) -> None:
    """A designer that looks after its fits all the time, and to which each is a long one."""
    monkeypatch.setattr("surrogym_server.services.designer.RENEWALS_PER_LEASE", 3000)
    monkeypatch.setattr("surrogym_server.services.designer.PAUSE_SECONDS", 0.01)
    monkeypatch.setattr("surrogym_server.services.designer.LONG_SECONDS", 0.1)
    monkeypatch.setattr("surrogym_server.services.designer.PASSED_SECONDS", 0.1)


def test_a_fit_beyond_the_time_limit_is_stopped_with_an_error_naming_the_option(
    answered: Storage, designer, runner: Runner
):
    runner.hang = True

    async def run() -> None:
        async with asyncio.timeout(60):
            await designer(fit_seconds=0.2).fit_all_due()

    asyncio.run(run())
    record = answered.surrogates.get(NAME)
    assert (record.phase, runner.ended) == ("failed", 1)
    assert record.error == (
        "the fit failed: a fit of the model family 'gaussian_process' took longer than 0.2 s, and was stopped: "
        "surrogym serve --fit-seconds sets a longer limit"
    )


@pytest.mark.usefixtures("watchful")
def test_deleting_a_surrogate_stops_its_running_fit(answered: Storage, designer, runner: Runner):
    runner.hang = True

    async def run() -> None:
        async with asyncio.timeout(60):
            fitting = asyncio.create_task(designer().fit_all_due())
            while not runner.jobs:
                await asyncio.sleep(0.01)
            answered.surrogates.delete(NAME)
            await fitting

    asyncio.run(run())
    assert runner.ended == 1


@pytest.mark.usefixtures("watchful")
def test_a_long_fit_is_logged_and_does_not_delay_other_fits(answered: Storage, designer, runner: Runner, caplog):
    teach_another(answered, budget=29)
    runner.hang_at_budget = pendulum.BUDGET

    async def run() -> None:
        task = asyncio.create_task(designer().run())
        async with asyncio.timeout(60):
            while answered.surrogates.get("another").phase != "sampling" or "has been running" not in caplog.text:
                await asyncio.sleep(0.01)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    asyncio.run(run())
    assert runner.ended == 1
    assert answered.designs.due() == [NAME]
    assert re.search(rf"the fit of {NAME} has been running for \d+ s, and is stopped after 3600 s", caplog.text)


@pytest.mark.parametrize("workers", [1, 2])
def test_the_number_of_concurrent_fits_is_the_number_of_fit_workers(
    answered: Storage, designer, runner: Runner, workers: int
):
    teach_another(answered, budget=29)
    runner.hang = True

    async def run() -> None:
        task = asyncio.create_task(designer(fit_workers=workers).run())
        async with asyncio.timeout(60):
            while len(runner.jobs) < workers:
                await asyncio.sleep(0.01)
        await asyncio.sleep(0.2)  # several looks
        assert len(runner.jobs) == workers
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    asyncio.run(run())
    assert runner.ended == workers


def test_a_surrogate_due_during_another_fit_is_fitted_concurrently(answered: Storage, designer, runner: Runner):
    runner.hang_at_budget = pendulum.BUDGET

    async def run() -> None:
        task = asyncio.create_task(designer(fit_workers=2).run())
        async with asyncio.timeout(60):
            while not runner.jobs:
                await asyncio.sleep(0.01)
            await asyncio.to_thread(teach_another, answered, budget=29)
            while answered.surrogates.get("another").phase != "sampling":
                await asyncio.sleep(0.01)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    asyncio.run(run())
    assert runner.ended == 1, "the first one runs all the time"


def teach_another(storage: Storage, budget: int) -> None:
    """A second surrogate whose fit is due."""
    spec = pendulum.spec()
    queries = initial_queries(definition_from_spec(EnvironmentSpec.model_validate(spec)), budget)
    storage.surrogates.create(NewSurrogate("another", spec, budget, 0.999, queries))
    for query in storage.queries.claim("another", "tester", 100, 60):
        step = pendulum.real_step(list(query.coordinates), list(query.action))
        storage.samples.add("another", "tester", [NewSample(**step, query_id=query.id, lease_token=query.token)])


def test_a_surrogate_without_budget_gets_initial_queries_once_it_has_one(answered: Storage, designer):
    spec = pendulum.spec()
    answered.surrogates.create(NewSurrogate("late", spec, 0, 0.999))
    fit_all(designer)
    assert answered.surrogates.summary("late").queries.pending == 0
    answered.designs.improve("late", 3, raise_budget=True)
    fit_all(designer)
    assert answered.surrogates.summary("late").queries.pending == 3


@pytest.mark.parametrize("error", [CancelledError(), RuntimeError("line 1\n  line 2")])
def test_an_error_in_one_fit_does_not_prevent_the_next_fit(
    answered: Storage, designer, runner: Runner, error: Exception
):
    teach_another(answered, budget=29)

    def function(job: DesignJob) -> DesignResult:
        if job.budget == 29:
            return run_design_job(job)
        raise error

    runner.function = function
    fit_all(designer)
    said = " ".join(str(error).split())
    assert answered.surrogates.get(NAME).error == f"the fit failed: {type(error).__name__}{': ' if said else ''}{said}"
    assert answered.surrogates.get("another").phase == "sampling"


def test_a_surrogate_with_a_damaged_row_does_not_prevent_other_fits(answered: Storage, designer, tmp_path: Path):
    answered.surrogates.create(NewSurrogate("broken", {}, 30, 0.999))
    with closing(sqlite3.connect(tmp_path / "surrogym.db")) as file:
        file.execute("UPDATE surrogates SET state = '{' WHERE name = 'broken'")
        file.commit()
    fit_all(designer)
    assert answered.surrogates.get(NAME).phase == "sampling"


def test_a_damaged_stored_model_is_logged_and_fitted_again(
    answered: Storage, designer, cache: ModelCache, definitions: Definitions, tmp_path: Path, caplog
):
    fit_all(designer)
    surrogate = answered.surrogates.get(NAME).id
    with closing(sqlite3.connect(tmp_path / "surrogym.db")) as file:
        [blob] = file.execute("SELECT blob FROM models").fetchone()
        file.execute("UPDATE models SET blob = ?", [blob[:-1] + bytes([blob[-1] ^ 1])])
        file.execute("UPDATE queries SET status = 'answered'")  # so that nothing else keeps a fit from being due
        file.commit()
    restarted = ModelCache(lambda *key: load_model(answered, definitions, *key), answered.models.newest)
    with pytest.raises(NoModel):
        restarted.latest(surrogate)
    assert "model 1 of pendulum is set aside" in caplog.text
    fit_all(designer)
    assert restarted.latest(surrogate) == 2


def test_the_designer_starts_a_due_fit_by_itself(answered: Storage, designer):
    async def run() -> None:
        task = asyncio.create_task(designer().run())
        async with asyncio.timeout(60):
            while answered.surrogates.get(NAME).phase != "sampling":
                await asyncio.sleep(0.01)
        task.cancel()

    asyncio.run(run())


def test_an_improve_request_uses_the_latest_visited_states_unless_a_checkpoint_is_named(answered: Storage, designer):
    async def run() -> None:
        def improve(name: str, queries: int, checkpoint: str | None, key: str | None) -> SurrogateRecord:
            return made.improve(name, queries, checkpoint, key, raise_budget=True).record

        made = designer()
        assert improve(NAME, 1, None, None).checkpoint is None
        for checkpoint in ("first", "second"):
            answered.occupancy.put(NAME, checkpoint, np.ones((1, 2)))
        assert improve(NAME, 1, None, None).checkpoint == "second"
        assert improve(NAME, 1, "first", None).checkpoint == "first"
        with pytest.raises(InvalidInput, match="'third'"):
            improve(NAME, 1, "third", None)

    asyncio.run(run())


@pytest.mark.parametrize(
    ("verdict", "queries", "phase"),
    [
        ("continue", 1, "sampling"),
        ("ready", 0, "ready"),
        ("ready", 2, "sampling"),
        ("over_budget", 0, "over_budget"),
        ("continue", 0, "sampling"),
        ("unsure", 0, "unsure"),
    ],
)
def test_the_phase_of_a_surrogate_after_a_fit_follows_from_verdict_and_queries(
    answered: Storage, designer, runner: Runner, verdict: str, queries: int, phase: str
):
    fit_all(designer)
    result = run_design_job(runner.jobs[0])
    changed = replace(result, verdict=verdict, queries=(Query.step((0.0, 0.0), (0.0,)),) * queries)
    assert changed.phase == phase


def test_the_designer_continues_if_a_surrogate_is_deleted_between_two_reads(
    answered: Storage, designer, runner, monkeypatch
):
    monkeypatch.setattr(answered.designs, "hopeless", lambda: ["gone"])
    fit_all(designer)
    assert len(runner.jobs) == 1
