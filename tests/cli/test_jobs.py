"""``surrogym jobs``: lists, shows and cancels what people asked workers for."""

from __future__ import annotations

import pytest

from support.policies import left_alone
from surrogym_client.transport import Api
from surrogym_shared import wire


@pytest.fixture
def api(pendulum_server):
    with Api(pendulum_server.url) as opened, left_alone(opened, "pendulum"):
        yield opened


def test_the_jobs_command_lists_shows_and_cancels_a_job(on_server, api):
    id = api.jobs.add("pendulum", wire.TrainTask(kind="train", algorithm="ppo", steps=5_000)).id
    job = api.jobs.claim("pendulum", "trainer-1")
    point = wire.JobPoint(steps=1_024, imagined_return=-800.5)
    state = wire.JobState(stage="training", share=0.2, steps=1_024, imagined_return=-800.5, curve=[point])
    api.jobs.report("pendulum", id, job.lease_token, state=state)
    listed = on_server("jobs", "pendulum").out
    assert "train by ppo, seed 0, 5000 virtual steps" in listed
    assert "training 20%" in listed
    assert "trainer-1" in listed.partition("workers: ")[2]
    assert "-800.5" in on_server("jobs", "pendulum", str(id)).out
    assert on_server("jobs", "pendulum", str(id), "--cancel", "--json").json["cancelling"]
    api.jobs.finish("pendulum", id, job.lease_token, "cancelled")
    assert on_server("jobs", "pendulum", "--json").json["jobs"][0]["status"] == "cancelled"


def test_the_jobs_command_reports_a_missing_worker_and_an_unknown_job(on_server, api, name):
    assert on_server("register", "Pendulum-v1", "--name", name).code == 0
    assert f"no worker is connected; to start one: surrogym work {name}" in on_server("jobs", name).out
    ended = on_server("jobs", name, "--cancel")
    assert (ended.code, ended.out) == (1, "")
    assert "expected the number of a job" in ended.err
    assert "which is not there" in on_server("jobs", name, "7").err
