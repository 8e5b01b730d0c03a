"""Jobs over HTTP: bounded, without code, seen by people, and run by one worker at a time."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from support.server import ServerProcess
from surrogym_client.errors import InvalidInput, LeaseExpired, NoModel, Overloaded, UnknownJob, UnknownPolicy
from surrogym_client.transport import Api, Retries
from surrogym_sampler.original.classic import pendulum
from surrogym_server.features.jobs import routes
from surrogym_shared import wire

TRAIN = wire.TrainTask(kind="train", algorithm="fastppo", steps=1_000)
STATE = wire.JobState(stage="training", share=0.5, steps=512, total_steps=1024, curve=[wire.JobPoint(steps=512)])


@pytest.fixture
def api(server_process: ServerProcess) -> Iterator[Api]:
    with Api(server_process.url) as opened:
        yield opened


@pytest.fixture
def known(api: Api, taught: str) -> Iterator[str]:
    """A surrogate with a model; jobs that are queued at the end are cancelled."""
    yield taught
    for job in api.jobs.list(taught).jobs:
        api.jobs.cancel(taught, job.id)


@pytest.mark.parametrize(
    ("example", "model"),
    [
        (routes.ADD, wire.AddJob),
        (routes.CLAIM, wire.ClaimJob),
        (routes.REPORT, wire.ReportJob),
        (routes.FINISH, wire.FinishJob),
    ],
)
def test_every_openapi_example_of_a_job_passes_validation(example: dict[str, Any], model: type[wire.Request]):
    model.model_validate(example)


def test_a_job_is_listed_from_queued_to_finished(api: Api, known: str):
    added = api.jobs.add(known, TRAIN)
    assert (added.status, added.task) == ("queued", TRAIN)
    job = api.jobs.claim(known, "trainer-1", most_episodes=7)
    assert job is not None
    assert (job.id, job.task, job.attempt) == (added.id, TRAIN, 1)
    assert not api.jobs.report(known, job.id, job.lease_token, state=STATE)
    seen = api.jobs.get(known, job.id)
    assert (seen.status, seen.stage, seen.steps, seen.curve) == ("running", "training", 512, STATE.curve)
    shown = api.jobs.list(known)
    assert [(worker.name, worker.most_episodes) for worker in shown.workers if worker.name == "trainer-1"] == [
        ("trainer-1", 7)
    ]
    assert api.jobs.cancel(known, job.id).cancelling
    assert api.jobs.report(known, job.id, job.lease_token)
    with pytest.raises(UnknownPolicy):
        api.jobs.finish(known, job.id, job.lease_token, "cancelled", version=2**30)
    ended = api.jobs.finish(known, job.id, job.lease_token, "cancelled", error="stopped by a person")
    assert (ended.status, ended.error, ended.version) == ("cancelled", "stopped by a person", None)
    with pytest.raises(LeaseExpired):
        api.jobs.report(known, job.id, job.lease_token)
    with pytest.raises(UnknownJob):
        api.jobs.get(known, 2**40)


def test_a_waiting_worker_gets_a_new_job_at_once(api: Api, known: str):
    found: list[Any] = []
    waiting = threading.Thread(target=lambda: found.append(api.jobs.claim(known, "waiting", wait_seconds=30)))
    waiting.start()
    with Api(api.url) as another:
        id = another.jobs.add(known, TRAIN, idempotency_key=f"{known}-waits").id
    waiting.join(20)
    assert [job.id for job in found] == [id]
    api.jobs.finish(known, id, found[0].lease_token, "done")


def test_a_training_job_for_a_surrogate_without_model_is_refused(api: Api, name: str):
    api.create_surrogate(name, pendulum())
    with pytest.raises(NoModel):
        api.jobs.add(name, TRAIN)
    api.delete_surrogate(name)


def test_more_unfinished_jobs_than_the_limit_are_refused(api: Api, known: str):
    while sum(job.status in ("queued", "running") for job in api.jobs.list(known).jobs) < 20:
        api.jobs.add(known, TRAIN)
    with (
        Api(api.url, retries=Retries(seconds=0)) as impatient,
        pytest.raises(Overloaded, match="running jobs"),
    ):
        impatient.jobs.add(known, TRAIN)


@pytest.mark.parametrize(
    ("task", "said"),
    [
        ({"kind": "train", "algorithm": "os:system"}, "algorithm"),
        ({"kind": "train", "steps": 10**9}, "steps"),
        ({"kind": "train", "steps": 5, "preset": "quick"}, "expected steps or the preset quick"),
        ({"kind": "train", "hyperparameters": {}}, "hyperparameters"),
        ({"kind": "evaluate", "env": "os:system"}, "env"),
        ({"kind": "evaluate", "episodes": 10**6}, "episodes"),
        ({"kind": "evaluate", "episodes": 600, "compare": "zero"}, "got 1200"),
        ({"kind": "evaluate", "policy": "../../etc"}, "policy"),
        ({"kind": "shell"}, "kind"),
    ],
)
def test_a_job_with_out_of_range_settings_is_refused_and_not_stored(
    client: httpx.Client, known: str, task: dict[str, Any], said: str
):
    before = client.get(f"/v1/surrogates/{known}/jobs").json()["jobs"]
    reply = client.post(f"/v1/surrogates/{known}/jobs", json={"task": task})
    assert reply.status_code == 422
    assert said in reply.json()["detail"]
    assert client.get(f"/v1/surrogates/{known}/jobs").json()["jobs"] == before


def test_a_job_progress_report_with_out_of_range_values_is_refused(api: Api, client: httpx.Client, known: str):
    id = api.jobs.add(known, TRAIN).id
    job = api.jobs.claim(known, "trainer-1")
    assert job is not None
    points = [{"steps": 1}] * 201
    for state in ({"stage": "training", "curve": points}, {"stage": "hacking"}, {"stage": "training", "share": 2}):
        body = {"lease_token": job.lease_token, "state": state}
        assert client.post(f"/v1/surrogates/{known}/jobs/{id}:report", json=body).status_code == 422
    with pytest.raises(InvalidInput):
        api.jobs.get("no/such", id)
    api.jobs.finish(known, id, job.lease_token, "done")
