"""Jobs: each to one worker at a time, never lost with it, and never repeated where it may move a machine."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from surrogym_server.errors import IdempotencyConflict, LeaseExpired, Overloaded, UnknownJob
from surrogym_server.storage.jobs import MAX_OPEN, MAX_RUNS, SILENT, JobProgress, JobResult, LeasedJob, NewJob
from surrogym_server.storage.port import Storage

Make = Callable[..., str]
Until = Callable[[Callable[[], bool]], None]
LONG, SHORT, DAY = 60.0, 0.02, 86_400.0
TRAIN = NewJob("train", {"kind": "train"})
EVALUATE = NewJob("evaluate", {"kind": "evaluate"}, episodes=10)
DONE = JobResult("done", version=3)


def claimed(storage: Storage, name: str, seconds: float = LONG, worker: str = "worker") -> LeasedJob:
    job = storage.jobs.claim(name, worker, 1_000, seconds)
    assert job is not None
    return job


def fall_silent(storage: Storage, name: str, until: Until) -> LeasedJob:
    """Claim a job whose lease then ends."""
    job = claimed(storage, name, SHORT)
    until(lambda: storage.jobs.sweep_expired() == 1)
    return job


def test_jobs_go_out_oldest_first_and_to_one_worker(storage: Storage, make: Make) -> None:
    name = make()
    ids = [storage.jobs.add(name, TRAIN) for _ in range(2)]
    assert [claimed(storage, name).id, claimed(storage, name).id] == ids
    assert storage.jobs.claim(name, "another", 1_000, LONG) is None
    newest, oldest = storage.jobs.list(name)
    assert (newest.id, newest.status, newest.worker, newest.attempts) == (ids[1], "running", "worker", 1)
    assert oldest.begun is not None
    assert [event.body for event in storage.events.list(name) if event.kind == "job"][-1]["worker"] == "worker"


def test_a_worker_gets_no_more_real_episodes_than_it_takes(storage: Storage, make: Make) -> None:
    name = make()
    evaluation, training = storage.jobs.add(name, EVALUATE), storage.jobs.add(name, TRAIN)
    first, none = storage.jobs.claim(name, "a", 9, LONG), storage.jobs.claim(name, "a", 9, LONG)
    assert (first and first.id, none) == (training, None)
    second = storage.jobs.claim(name, "b", 10, LONG)
    assert second is not None
    assert (second.id, second.task) == (evaluation, EVALUATE.task)


def test_a_job_with_a_reference_controller_waits_for_its_worker(storage: Storage, make: Make) -> None:
    name = make()
    asked = NewJob("evaluate", {**EVALUATE.task, "reference": True}, EVALUATE.episodes)
    first, training = storage.jobs.add(name, asked), storage.jobs.add(name, TRAIN)
    without = storage.jobs.claim(name, "a", 10, LONG)
    assert without is not None
    assert without.id == training
    assert storage.jobs.claim(name, "a", 10, LONG) is None
    found = storage.jobs.claim(name, "b", 10, LONG, reference=True)
    assert found is not None
    assert found.id == first


def test_a_report_keeps_the_lease_and_replaces_the_progress(storage: Storage, make: Make) -> None:
    name = make()
    storage.jobs.add(name, TRAIN)
    job = claimed(storage, name)
    for steps in (1, 2):
        progress = JobProgress({"steps": steps}, [{"steps": n} for n in range(steps)])
        assert not storage.jobs.report(name, job.id, job.token, LONG, progress)
    assert not storage.jobs.report(name, job.id, job.token, LONG, None)
    found = storage.jobs.get(name, job.id)
    assert (found.state, found.curve) == ({"steps": 2}, [{"steps": 0}, {"steps": 1}])
    assert storage.jobs.list(name)[0].curve == []


def test_a_result_ends_a_job_once(storage: Storage, make: Make) -> None:
    name = make()
    storage.jobs.add(name, TRAIN)
    job = claimed(storage, name)
    ended = storage.jobs.finish(name, job.id, job.token, DONE)
    assert (ended.status, ended.version) == ("done", 3)
    assert ended.finished_at is not None
    assert storage.jobs.finish(name, job.id, job.token, JobResult("failed", "again")) == ended
    with pytest.raises(LeaseExpired, match="claim again"):
        storage.jobs.report(name, job.id, job.token, LONG, None)
    with pytest.raises(LeaseExpired):
        storage.jobs.finish(name, job.id, "invented", DONE)


def test_the_training_of_a_dead_worker_goes_to_the_next(storage: Storage, make: Make, until: Until) -> None:
    name = make()
    storage.jobs.add(name, TRAIN)
    dead = fall_silent(storage, name, until)
    storage.jobs.report(name, dead.id, dead.token, SHORT, JobProgress({"steps": 1}, [{"steps": 1}]))
    jobs: list[LeasedJob] = []
    until(lambda: (job := storage.jobs.claim(name, "next", 0, LONG)) is not None and not jobs.append(job))
    assert (jobs[0].id, jobs[0].attempt) == (dead.id, 2)
    found = storage.jobs.get(name, dead.id)
    assert (found.state, found.curve, found.error, found.worker) == ({}, [], None, "next")
    for late in (
        lambda: storage.jobs.report(name, dead.id, dead.token, LONG, None),
        lambda: storage.jobs.finish(name, dead.id, dead.token, DONE),
    ):
        with pytest.raises(LeaseExpired):
            late()


def test_a_training_whose_workers_all_fall_silent_fails(storage: Storage, make: Make, until: Until) -> None:
    name = make()
    id = storage.jobs.add(name, TRAIN)
    for attempt in range(1, MAX_RUNS + 1):
        fall_silent(storage, name, until)
        found = storage.jobs.get(name, id)
        assert (found.status, found.error) == ("failed" if attempt == MAX_RUNS else "queued", SILENT)
    assert storage.jobs.claim(name, "a", 0, LONG) is None


def test_an_evaluation_is_never_run_again_by_itself(storage: Storage, make: Make, until: Until) -> None:
    """Nobody knows which of its real steps were taken."""
    name = make()
    storage.jobs.add(name, EVALUATE)
    fall_silent(storage, name, until)
    assert storage.jobs.list(name)[0].status == "failed"
    assert storage.jobs.claim(name, "a", 1_000, LONG) is None


@pytest.mark.parametrize("new", [TRAIN, EVALUATE])
def test_a_worker_continues_after_a_long_absence_of_its_server(
    storage: Storage, make: Make, until: Until, new: NewJob
) -> None:
    name = make()
    storage.jobs.add(name, new)
    job = fall_silent(storage, name, until)
    assert not storage.jobs.report(name, job.id, job.token, SHORT, None)
    assert storage.jobs.get(name, job.id).status == "running"
    until(lambda: storage.jobs.sweep_expired() == 1)
    ended = storage.jobs.finish(name, job.id, job.token, DONE)
    assert (ended.status, ended.error, ended.version) == ("done", None, 3)


def test_cancelling_asks_a_worker_to_stop_and_ends_what_waits(storage: Storage, make: Make) -> None:
    name = make()
    running, waiting = (storage.jobs.add(name, TRAIN) for _ in range(2))
    job = claimed(storage, name)
    assert storage.jobs.cancel(name, waiting).status == "cancelled"
    asked = storage.jobs.cancel(name, running)
    assert (asked.status, asked.cancelling) == ("running", True)
    assert storage.jobs.report(name, running, job.token, LONG, None)
    ended = storage.jobs.finish(name, running, job.token, JobResult("cancelled", version=1))
    assert (ended.status, ended.version) == ("cancelled", 1)
    assert storage.jobs.cancel(name, running) == ended


def test_a_silent_worker_that_was_to_stop_leaves_its_job_cancelled(storage: Storage, make: Make, until: Until) -> None:
    name = make()
    id = storage.jobs.add(name, TRAIN)
    job = claimed(storage, name, 0.2)
    storage.jobs.cancel(name, id)
    until(lambda: storage.jobs.sweep_expired() == 1)
    assert storage.jobs.get(name, id).status == "cancelled"
    assert storage.jobs.finish(name, id, job.token, JobResult("cancelled", version=2)).version == 2


def test_a_job_that_was_cancelled_while_it_waited_again_takes_no_result(
    storage: Storage, make: Make, until: Until
) -> None:
    name = make()
    storage.jobs.add(name, TRAIN)
    job = fall_silent(storage, name, until)
    storage.jobs.cancel(name, job.id)
    with pytest.raises(LeaseExpired):
        storage.jobs.finish(name, job.id, job.token, DONE)


def test_the_lease_of_a_dead_worker_ends_though_the_clock_was_set_back(
    storage: Storage, make: Make, until: Until, set_clock_back: Callable[[float], None]
) -> None:
    name = make()
    storage.jobs.add(name, TRAIN)
    claimed(storage, name, SHORT)
    set_clock_back(DAY)
    until(lambda: storage.jobs.sweep_expired() == 1)
    assert claimed(storage, name).attempt == 2


def test_the_same_key_queues_once(storage: Storage, make: Make) -> None:
    name = make()
    id = storage.jobs.add(name, TRAIN, key="a")
    assert storage.jobs.add(name, TRAIN, key="a") == id
    with pytest.raises(IdempotencyConflict):
        storage.jobs.add(name, EVALUATE, key="a")
    assert len(storage.jobs.list(name)) == 1


def test_the_number_of_jobs_is_bounded(storage: Storage, make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("surrogym_server.storage.sql.jobs.MAX_JOBS", 2)
    name = make()
    ids = [storage.jobs.add(name, TRAIN) for _ in range(MAX_OPEN)]
    with pytest.raises(Overloaded, match="cancel one"):
        storage.jobs.add(name, TRAIN)
    for id in ids[:5]:
        storage.jobs.cancel(name, id)
    last = storage.jobs.add(name, TRAIN)
    assert [job.id for job in storage.jobs.list(name)] == [last, *reversed(ids[3:])]
    with pytest.raises(UnknownJob):
        storage.jobs.get(name, ids[0])


def test_a_job_belongs_to_its_surrogate(storage: Storage, make: Make) -> None:
    id = storage.jobs.add(make(name="one"), TRAIN)
    with pytest.raises(UnknownJob, match="which is not there"):
        storage.jobs.cancel(make(name="two"), id)
    storage.surrogates.delete("one")
    assert storage.jobs.add("two", TRAIN) != id
