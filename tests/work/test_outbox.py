"""Results that the server does not have yet: kept in files, sent later, never twice, and never obeyed blindly."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest

from support.policies import left_alone
from support.server import ServerProcess
from surrogym_client.errors import ServerUnreachable
from surrogym_client.transport import Api, Retries
from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_shared import wire
from surrogym_shared.network import Network
from surrogym_shared.spec import EnvironmentSpec
from surrogym_trainer.policies.card import PolicyCard, write_card
from surrogym_trainer.work.outbox import Outbox, Waiting

NAME = "pendulum"
TASK = wire.TrainTask(kind="train")


@pytest.fixture
def api(pendulum_server: ServerProcess) -> Iterator[Api]:
    with Api(pendulum_server.url) as opened, left_alone(opened, NAME):
        yield opened


@pytest.fixture
def away() -> Api:
    return Api("http://127.0.0.1:9", retries=Retries(seconds=0))


@pytest.fixture
def told() -> list[str]:
    return []


@pytest.fixture
def outbox(tmp_path: Path, told: list[str]) -> Outbox:
    return Outbox(tmp_path, told.append)


def claimed(api: Api) -> wire.LeasedJob:
    api.jobs.add(NAME, TASK)
    job = api.jobs.claim(NAME, "tester")
    assert job is not None
    return job


def policy(folder: Path, spec: EnvironmentSpec) -> str:
    size = len(spec.observation)
    vector = np.random.default_rng().normal(size=Network.size(spec, 4))
    Network.of(spec, np.zeros(size), np.ones(size), 4, vector).save(folder / "mine.zip")
    write_card(folder / "mine.zip", PolicyCard(algorithm="CMAES", surrogate=NAME, spec=spec))
    return "mine.zip"


def test_results_are_sent_later_if_the_server_was_unreachable(
    api: Api, away: Api, outbox: Outbox, tmp_path: Path, told: list[str]
):
    job = claimed(api)
    steps = wire.ReportSteps(steps=7, idempotency_key=uuid4().hex)
    result = Waiting(surrogate=NAME, job=job.id, lease_token=job.lease_token, status="done", steps=(steps,))
    outbox.put(result.model_copy(update={"policy": policy(tmp_path, pendulum())}))
    before = api.surrogate(NAME).ledger.evaluation
    with pytest.raises(ServerUnreachable):
        outbox.send(away)
    (path,) = tmp_path.glob("*.waiting.json")
    content = path.read_bytes()
    outbox.send(api)
    ended = api.jobs.get(NAME, job.id)
    assert (ended.status, ended.error) == ("done", None)
    assert ended.version is not None
    assert api.policies.file(NAME, ended.version, "zip") == (tmp_path / "mine.zip").read_bytes()
    assert told == [f"job {job.id} done; see {NAME}@{ended.version}"]
    path.write_bytes(content)  # as if the worker had died before it removed the file
    outbox.send(api)
    assert api.surrogate(NAME).ledger.evaluation - before == 7
    assert api.policies.get(NAME).version == ended.version
    assert not path.exists()


def test_a_policy_refused_by_the_server_ends_its_job_and_is_kept(api: Api, outbox: Outbox, tmp_path: Path):
    job = claimed(api)
    name = policy(tmp_path, cartpole())
    outbox.put(Waiting(surrogate=NAME, job=job.id, lease_token=job.lease_token, status="done", policy=name))
    outbox.send(api)
    ended = api.jobs.get(NAME, job.id)
    assert ended.status == "failed"
    assert "the result was not stored: expected a policy for 'pendulum'" in (ended.error or "")
    assert (tmp_path / name).exists()


def test_an_unsent_policy_whose_file_was_deleted_ends_its_job(api: Api, outbox: Outbox):
    job = claimed(api)
    outbox.put(Waiting(surrogate=NAME, job=job.id, lease_token=job.lease_token, status="cancelled", policy="gone.zip"))
    outbox.send(api)
    ended = api.jobs.get(NAME, job.id)
    assert (ended.status, ended.version) == ("cancelled", None)
    assert "no such policy file" in (ended.error or "")


def test_the_unsent_result_of_a_job_taken_by_another_worker_is_dropped(
    api: Api, outbox: Outbox, tmp_path: Path, told: list[str]
):
    job = claimed(api)
    outbox.put(Waiting(surrogate=NAME, job=job.id, lease_token="the token of another", status="done"))
    outbox.send(api)
    assert told == [f"job {job.id}: the server gave it to another worker meanwhile"]
    assert list(tmp_path.iterdir()) == []
    api.jobs.finish(NAME, job.id, job.lease_token, "done")


@pytest.mark.parametrize(
    "changes", [{"policy": "../secret.zip"}, {"policy": "/etc/passwd"}, {"status": "queued"}, {"a": 1}]
)
def test_an_invalid_outbox_file_is_set_aside(
    api: Api, outbox: Outbox, tmp_path: Path, told: list[str], changes: dict[str, object]
):
    good = Waiting(surrogate=NAME, job=1, lease_token="a", status="done").model_dump(mode="json")
    (tmp_path / "x.waiting.json").write_text(json.dumps(good | changes))
    outbox.send(api)
    assert "is not the result of a job" in told[0]
    assert [path.name for path in tmp_path.iterdir()] == ["x.refused.json"]
