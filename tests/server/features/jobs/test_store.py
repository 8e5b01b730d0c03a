"""Jobs: each to one worker at a time, never lost with it, and never repeated where it may move a machine."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from surrogym_server.errors import IdempotencyConflict, LeaseExpired, Overloaded, UnknownJob
from surrogym_server.features.jobs.records import MAX_OPEN, MAX_RUNS, SILENT, JobProgress, JobResult, LeasedJob, NewJob
from surrogym_server.features.jobs.store import Jobs
from surrogym_server.storage.sql import Storage

Make = Callable[..., str]
Until = Callable[[Callable[[], bool]], None]
LONG, SHORT, DAY = 60.0, 0.02, 86_400.0
TRAIN = NewJob("train", {"kind": "train"})
EVALUATE = NewJob("evaluate", {"kind": "evaluate"}, episodes=10)
DONE = JobResult("done", version=3)


@pytest.fixture
def jobs(storage: Storage) -> Jobs:
    return storage.part(Jobs)


def claimed(jobs: Jobs, name: str, seconds: float = LONG, worker: str = "worker") -> LeasedJob:
    job = jobs.claim(name, worker, 1_000, seconds)
    assert job is not None
    return job


def fall_silent(jobs: Jobs, name: str, until: Until) -> LeasedJob:
    """Claim a job whose lease then ends."""
    job = claimed(jobs, name, SHORT)
    until(lambda: jobs.sweep_expired() == 1)
    return job


def test_each_job_is_handed_to_one_worker_and_the_oldest_first(storage: Storage, jobs: Jobs, make: Make) -> None:
    name = make()
    ids = [jobs.add(name, TRAIN) for _ in range(2)]
    assert [claimed(jobs, name).id, claimed(jobs, name).id] == ids
    assert jobs.claim(name, "another", 1_000, LONG) is None
    newest, oldest = jobs.list(name)
    assert (newest.id, newest.status, newest.worker, newest.attempts) == (ids[1], "running", "worker", 1)
    assert oldest.begun is not None
    assert [event.body for event in storage.events.list(name) if event.kind == "job"][-1]["worker"] == "worker"


def test_a_worker_gets_no_evaluation_with_more_episodes_than_it_allows(jobs: Jobs, make: Make) -> None:
    name = make()
    evaluation, training = jobs.add(name, EVALUATE), jobs.add(name, TRAIN)
    first, none = jobs.claim(name, "a", 9, LONG), jobs.claim(name, "a", 9, LONG)
    assert (first and first.id, none) == (training, None)
    second = jobs.claim(name, "b", 10, LONG)
    assert second is not None
    assert (second.id, second.task) == (evaluation, EVALUATE.task)


def test_a_job_with_reference_controller_waits_for_a_worker_that_has_one(jobs: Jobs, make: Make) -> None:
    name = make()
    asked = NewJob("evaluate", {**EVALUATE.task, "reference": True}, EVALUATE.episodes)
    first, training = jobs.add(name, asked), jobs.add(name, TRAIN)
    without = jobs.claim(name, "a", 10, LONG)
    assert without is not None
    assert without.id == training
    assert jobs.claim(name, "a", 10, LONG) is None
    found = jobs.claim(name, "b", 10, LONG, reference=True)
    assert found is not None
    assert found.id == first


def test_a_progress_report_renews_the_lease_of_a_job(jobs: Jobs, make: Make) -> None:
    name = make()
    jobs.add(name, TRAIN)
    job = claimed(jobs, name)
    for steps in (1, 2):
        progress = JobProgress({"steps": steps}, [{"steps": n} for n in range(steps)])
        assert not jobs.report(name, job.id, job.token, LONG, progress)
    assert not jobs.report(name, job.id, job.token, LONG, None)
    found = jobs.get(name, job.id)
    assert (found.state, found.curve) == ({"steps": 2}, [{"steps": 0}, {"steps": 1}])
    assert jobs.list(name)[0].curve == []


def test_a_job_accepts_only_its_first_result(jobs: Jobs, make: Make) -> None:
    name = make()
    jobs.add(name, TRAIN)
    job = claimed(jobs, name)
    ended = jobs.finish(name, job.id, job.token, DONE)
    assert (ended.status, ended.version) == ("done", 3)
    assert ended.finished_at is not None
    assert jobs.finish(name, job.id, job.token, JobResult("failed", "again")) == ended
    with pytest.raises(LeaseExpired, match="claim again"):
        jobs.report(name, job.id, job.token, LONG, None)
    with pytest.raises(LeaseExpired):
        jobs.finish(name, job.id, "invented", DONE)


def test_the_training_job_of_a_dead_worker_goes_to_the_next_worker(jobs: Jobs, make: Make, until: Until) -> None:
    name = make()
    jobs.add(name, TRAIN)
    dead = fall_silent(jobs, name, until)
    jobs.report(name, dead.id, dead.token, SHORT, JobProgress({"steps": 1}, [{"steps": 1}]))
    given: list[LeasedJob] = []
    until(lambda: (job := jobs.claim(name, "next", 0, LONG)) is not None and not given.append(job))
    assert (given[0].id, given[0].attempt) == (dead.id, 2)
    found = jobs.get(name, dead.id)
    assert (found.state, found.curve, found.error, found.worker) == ({}, [], None, "next")
    for late in (
        lambda: jobs.report(name, dead.id, dead.token, LONG, None),
        lambda: jobs.finish(name, dead.id, dead.token, DONE),
    ):
        with pytest.raises(LeaseExpired):
            late()


def test_a_training_job_fails_after_all_its_workers_went_silent(jobs: Jobs, make: Make, until: Until) -> None:
    name = make()
    id = jobs.add(name, TRAIN)
    for attempt in range(1, MAX_RUNS + 1):
        fall_silent(jobs, name, until)
        found = jobs.get(name, id)
        assert (found.status, found.error) == ("failed" if attempt == MAX_RUNS else "queued", SILENT)
    assert jobs.claim(name, "a", 0, LONG) is None


def test_an_evaluation_job_of_a_silent_worker_is_not_repeated(jobs: Jobs, make: Make, until: Until) -> None:
    """Nobody knows which of its real steps were taken."""
    name = make()
    jobs.add(name, EVALUATE)
    fall_silent(jobs, name, until)
    assert jobs.list(name)[0].status == "failed"
    assert jobs.claim(name, "a", 1_000, LONG) is None


@pytest.mark.parametrize("new", [TRAIN, EVALUATE])
def test_a_worker_can_finish_its_job_after_a_long_server_outage(
    jobs: Jobs, make: Make, until: Until, new: NewJob
) -> None:
    name = make()
    jobs.add(name, new)
    job = fall_silent(jobs, name, until)
    assert not jobs.report(name, job.id, job.token, SHORT, None)
    assert jobs.get(name, job.id).status == "running"
    until(lambda: jobs.sweep_expired() == 1)
    ended = jobs.finish(name, job.id, job.token, DONE)
    assert (ended.status, ended.error, ended.version) == ("done", None, 3)


def test_cancelling_ends_a_queued_job_and_asks_a_running_one_to_stop(jobs: Jobs, make: Make) -> None:
    name = make()
    running, waiting = (jobs.add(name, TRAIN) for _ in range(2))
    job = claimed(jobs, name)
    assert jobs.cancel(name, waiting).status == "cancelled"
    asked = jobs.cancel(name, running)
    assert (asked.status, asked.cancelling) == ("running", True)
    assert jobs.report(name, running, job.token, LONG, None)
    ended = jobs.finish(name, running, job.token, JobResult("cancelled", version=1))
    assert (ended.status, ended.version) == ("cancelled", 1)
    assert jobs.cancel(name, running) == ended


def test_a_cancelled_job_whose_worker_goes_silent_ends_as_cancelled(jobs: Jobs, make: Make, until: Until) -> None:
    name = make()
    id = jobs.add(name, TRAIN)
    job = claimed(jobs, name, 0.2)
    jobs.cancel(name, id)
    until(lambda: jobs.sweep_expired() == 1)
    assert jobs.get(name, id).status == "cancelled"
    assert jobs.finish(name, id, job.token, JobResult("cancelled", version=2)).version == 2


def test_a_job_cancelled_after_its_worker_went_silent_accepts_no_result(jobs: Jobs, make: Make, until: Until) -> None:
    name = make()
    jobs.add(name, TRAIN)
    job = fall_silent(jobs, name, until)
    jobs.cancel(name, job.id)
    with pytest.raises(LeaseExpired):
        jobs.finish(name, job.id, job.token, DONE)


def test_the_lease_of_a_dead_worker_expires_although_the_clock_was_set_back(
    jobs: Jobs, make: Make, until: Until, set_clock_back: Callable[[float], None]
) -> None:
    name = make()
    jobs.add(name, TRAIN)
    claimed(jobs, name, SHORT)
    set_clock_back(DAY)
    until(lambda: jobs.sweep_expired() == 1)
    assert claimed(jobs, name).attempt == 2


def test_a_job_added_twice_with_one_idempotency_key_is_queued_once(jobs: Jobs, make: Make) -> None:
    name = make()
    id = jobs.add(name, TRAIN, key="a")
    assert jobs.add(name, TRAIN, key="a") == id
    with pytest.raises(IdempotencyConflict):
        jobs.add(name, EVALUATE, key="a")
    assert len(jobs.list(name)) == 1


def test_jobs_beyond_the_limit_of_a_surrogate_are_refused(
    jobs: Jobs, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("surrogym_server.features.jobs.store.MAX_JOBS", 2)
    name = make()
    ids = [jobs.add(name, TRAIN) for _ in range(MAX_OPEN)]
    with pytest.raises(Overloaded, match="cancel one"):
        jobs.add(name, TRAIN)
    for id in ids[:5]:
        jobs.cancel(name, id)
    last = jobs.add(name, TRAIN)
    assert [job.id for job in jobs.list(name)] == [last, *reversed(ids[3:])]
    with pytest.raises(UnknownJob):
        jobs.get(name, ids[0])


def test_a_job_cannot_be_reached_through_another_surrogate(storage: Storage, jobs: Jobs, make: Make) -> None:
    id = jobs.add(make(name="one"), TRAIN)
    with pytest.raises(UnknownJob, match="which is not there"):
        jobs.cancel(make(name="two"), id)
    storage.surrogates.delete("one")
    assert jobs.add("two", TRAIN) != id
