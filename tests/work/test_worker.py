"""The trainer worker against a real server: jobs are run, shown, stopped and never lost."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from support.moody import SPEC, Line
from support.policies import left_alone, network_file
from support.server import ServerProcess
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum
from surrogym_sampler.original.episodes import GymnasiumEpisode, open_episode
from surrogym_shared import wire
from surrogym_trainer.evaluation.baselines import Reference
from surrogym_trainer.policies import load_policy
from surrogym_trainer.work.reporter import JobStopped, Stand
from surrogym_trainer.work.tasks import Gathered, run_episodes
from surrogym_trainer.work.worker import Environment, Worker, WorkerReport, WorkerSettings

NAME = "pendulum"
SHORT = wire.TrainTask(kind="train", algorithm="fastppo", steps=1_000, audit=False)
LONG = SHORT.model_copy(update={"steps": 500_000})


@pytest.fixture
def api(pendulum_server: ServerProcess) -> Iterator[Api]:
    with Api(pendulum_server.url) as opened, left_alone(opened, NAME):
        yield opened


@pytest.fixture
def run_one(api: Api, tmp_path: Path) -> Callable[..., wire.JobDetail]:
    """Queue a job, let a worker run it, and give what became of it."""

    def run(task: wire.Task, environment: Environment | None = None) -> wire.JobDetail:
        id = api.jobs.add(NAME, task).id
        Worker(api, NAME, WorkerSettings("tester", tmp_path, once=True), environment).run()
        return api.jobs.get(NAME, id)

    return run


def until(happened: Callable[[], bool], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.05)


def evaluating(most_episodes: int = 10) -> Environment:
    return Environment(pendulum(), lambda: GymnasiumEpisode(pendulum()), most_episodes)


def test_a_worker_stores_a_trained_policy_with_learning_curve_and_promised_return(api: Api, run_one, tmp_path: Path):
    job = run_one(SHORT)
    assert (job.status, job.error, job.worker) == ("done", None, "tester")
    assert job.version is not None
    policy = api.policies.get(NAME, job.version)
    assert policy.promise is not None
    assert [point.steps for point in policy.curve] == [2_048]  # one rollout
    assert [point.steps for point in job.curve] == [2_048]
    (file,) = tmp_path.glob("pendulum-job*.zip")
    assert api.policies.file(NAME, job.version, "zip") == file.read_bytes()
    load_policy(file)
    assert list(tmp_path.glob("*.waiting.json")) == []


def test_a_running_training_job_reports_its_curve_and_stops_when_cancelled(api: Api, tmp_path: Path):
    id = api.jobs.add(NAME, LONG).id
    reports: list[WorkerReport] = []
    settings = WorkerSettings("tester", tmp_path, lease_seconds=6, once=True)
    thread = threading.Thread(target=lambda: reports.append(Worker(api, NAME, settings).run()))
    thread.start()
    until(lambda: api.jobs.get(NAME, id).imagined_return is not None)
    seen = api.jobs.get(NAME, id)
    assert (seen.status, seen.stage, seen.steps) == ("running", "training", seen.curve[-1].steps)
    assert seen.curve[-1].imagined_return == seen.imagined_return
    assert sorted(point.steps for point in seen.curve) == [point.steps for point in seen.curve]
    api.jobs.cancel(NAME, id)
    thread.join(60)
    ended = api.jobs.get(NAME, id)
    assert (ended.status, ended.error) == ("cancelled", "cancelled by a person")
    assert ended.version is not None  # the best policy so far
    assert reports == [WorkerReport(cancelled=1)]


def test_an_evaluation_job_counts_its_real_steps_and_stores_its_episodes(api: Api, run_one):
    version = api.policies.push(NAME, wire.PushedCard(algorithm="CMAES"), [], "zip", network_file(seed=3)).version
    before = api.surrogate(NAME).ledger.evaluation
    job = run_one(wire.EvaluateTask(kind="evaluate", policy=str(version), episodes=2, compare="zero"), evaluating())
    assert (job.status, job.error, job.version) == ("done", None, version)
    assert api.surrogate(NAME).ledger.evaluation - before == 2 * 2 * 200
    stored = api.policies.get(NAME, version).evaluations
    assert [(one.controller, one.episodes) for one in stored] == [("policy", 2), ("zero", 2)]
    assert job.evaluation == stored[0].id


def test_an_evaluation_job_can_use_a_reference_controller_and_draw_a_video(api: Api, run_one, tmp_path: Path):
    version = api.policies.push(NAME, wire.PushedCard(algorithm="CMAES"), [], "zip", network_file(seed=11)).version
    asked = wire.EvaluateTask(kind="evaluate", policy=str(version), episodes=1, reference=True, video=True)
    made: list[Reference] = []

    def load() -> Reference:
        made.append(Reference(lambda: lambda observation: [-observation[1]]))
        return made[-1]

    able = replace(evaluating(), name="Pendulum-v1", reference=load)
    job = run_one(asked, able)
    assert (job.status, job.error, len(made)) == ("done", None, 1)
    stored = api.policies.get(NAME, version)
    assert [one.controller for one in stored.evaluations] == ["policy", "reference"]
    (video,) = [file for file in stored.files if file.form in ("mp4", "gif")]
    assert video.stored
    job = run_one(asked, replace(able, spec=pendulum().model_copy(update={"environment": ""}), name=""))
    assert job.status == "done"
    assert (job.error or "").startswith("no video: ")


def test_a_failed_job_reports_the_reason_and_the_worker_continues(api: Api, run_one):
    job = run_one(SHORT.model_copy(update={"algorithm": "dqn"}))
    assert job.status == "failed"
    assert "can't be trained in this surrogate" in (job.error or "")
    version = api.policies.push(NAME, wire.PushedCard(), [], "zip", network_file(seed=4)).version

    def broken() -> GymnasiumEpisode:
        raise RuntimeError("no power\nat all")

    task = wire.EvaluateTask(kind="evaluate", policy=str(version), episodes=1)
    job = run_one(task, Environment(pendulum(), broken, 10))
    assert (job.status, job.error) == ("failed", "RuntimeError: no power at all")


def test_a_worker_refuses_an_environment_of_another_surrogate_before_resetting_it(api: Api, run_one):
    version = api.policies.push(NAME, wire.PushedCard(algorithm="CMAES"), [], "zip", network_file(seed=6)).version
    task = wire.EvaluateTask(kind="evaluate", policy=str(version), episodes=1)
    other = Environment(SPEC, partial(open_episode, "a line", None, NeverMoved), 10)
    job = run_one(task, other)
    assert job.status == "failed"
    assert "the policy does not fit the environment, it is for Pendulum-v1" in str(job.error)


class NeverMoved(Line):
    """Would be broken by a step."""

    def step_from(self, coordinates, action):
        raise AssertionError("it was moved")


def test_a_cancelled_evaluation_job_counts_its_real_steps(api: Api, tmp_path: Path):
    version = api.policies.push(NAME, wire.PushedCard(algorithm="CMAES"), [], "zip", network_file(seed=5)).version
    task = wire.EvaluateTask(kind="evaluate", policy=str(version), episodes=2)
    gathered = Gathered()

    class Cancelled:
        """A reporter that is asked to stop after the seventh step."""

        steps = 0

        def at(self, *_: object) -> None:
            self.steps += 1
            if self.steps == 7:
                raise JobStopped

    one_machine = Environment(pendulum(), lambda: OneAtATime(pendulum()), 10)
    with pytest.raises(KeyboardInterrupt):
        run_episodes(api, NAME, task, one_machine, tmp_path, Cancelled(), gathered)
    assert [(steps.steps, steps.note) for steps in gathered.steps] == [(7, "interrupted")]
    assert gathered.evaluations == []


class OneAtATime(GymnasiumEpisode):
    """A machine, of which there is one."""

    parallel = False


def test_a_stopped_worker_keeps_the_best_policy_of_its_training(api: Api, tmp_path: Path):
    id = api.jobs.add(NAME, LONG).id

    def interrupt(stand: Stand) -> None:
        if stand.stage == "training":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Worker(api, NAME, WorkerSettings("tester", tmp_path), show=interrupt).run()
    ended = api.jobs.get(NAME, id)
    assert (ended.status, ended.error) == ("cancelled", "the worker was stopped")
    assert ended.version is not None


@pytest.mark.e2e
def test_ctrl_c_of_a_worker_keeps_the_best_policy_and_reports_it(api: Api, tmp_path: Path):
    id = api.jobs.add(NAME, LONG).id
    command = [sys.executable, "-m", "surrogym", "work", NAME, "--folder", str(tmp_path), "--server", api.url]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    until(lambda: len(api.jobs.get(NAME, id).curve) > 0)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    ended = api.jobs.get(NAME, id)
    assert (ended.status, ended.error) == ("cancelled", "the worker was stopped")
    assert ended.version is not None
    assert "interrupted; 0 jobs done, 0 failed, 1 cancelled" in said
