"""Jobs that name a stored policy."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from support.policies import left_alone, network_file
from support.server import ServerProcess
from surrogym_client.errors import UnknownPolicy
from surrogym_client.transport import Api
from surrogym_shared import wire

pytest.importorskip("surrogym_server.features.policies", reason="jobs can name policies where the server keeps some")

EVALUATE = wire.EvaluateTask(kind="evaluate", episodes=5, compare="zero")
TRAIN = wire.TrainTask(kind="train", algorithm="fastppo", steps=1_000)


@pytest.fixture
def api(server_process: ServerProcess) -> Iterator[Api]:
    with Api(server_process.url) as opened:
        yield opened


@pytest.fixture
def known(api: Api, taught: str) -> Iterator[str]:
    """A surrogate with a model."""
    with left_alone(api, taught):
        yield taught


def test_an_evaluation_job_goes_only_to_a_worker_that_allows_its_episodes(api: Api, known: str):
    with pytest.raises(UnknownPolicy):
        api.jobs.add(known, EVALUATE.model_copy(update={"policy": "production"}))
    version = api.policies.push(known, wire.PushedCard(), [], "zip", network_file(seed=1)).version
    added = api.jobs.add(known, EVALUATE)
    assert added.task == EVALUATE.model_copy(update={"policy": str(version)})
    assert api.jobs.claim(known, "careful", most_episodes=9) is None  # the comparison takes as many
    job = api.jobs.claim(known, "bold", most_episodes=10)
    assert job is not None
    api.jobs.finish(known, job.id, job.lease_token, "failed", error="the motor did not answer")


def test_a_training_job_cannot_finish_with_an_unknown_policy_or_evaluation(api: Api, known: str):
    version = api.policies.push(known, wire.PushedCard(), [], "zip", network_file(seed=2)).version
    api.jobs.add(known, TRAIN)
    job = api.jobs.claim(known, "trainer-1")
    assert job is not None
    with pytest.raises(UnknownPolicy, match="which does not exist"):
        api.jobs.finish(known, job.id, job.lease_token, "done", version=version + 1)
    with pytest.raises(UnknownPolicy, match="evaluation"):
        api.jobs.finish(known, job.id, job.lease_token, "done", version=version, evaluation=2**40)
    ended = api.jobs.finish(known, job.id, job.lease_token, "done", version=version)
    assert (ended.status, ended.version) == ("done", version)
