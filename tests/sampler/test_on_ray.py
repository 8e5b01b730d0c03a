"""Samplers in a real Ray cluster of this machine: they share a design, outlive their processes, and end with Ctrl-C."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from support.moody import SPEC
from surrogym.cli.sampling_on_ray import run_samplers
from surrogym_client.transport import Api
from surrogym_sampler.queries import SamplerSettings
from surrogym_sampler.queries.on_ray import RaySamplers, SamplerActor
from surrogym_sampler.queries.settings import SamplerPlan
from surrogym_shared.spec import Design

ray = pytest.importorskip("ray")

PATIENCE = 120.0
LONG = 20  # real steps of half a second
TESTS = Path(__file__).parents[1]
ONE_CPU = {"CPU": 1.0}

pytestmark = [pytest.mark.timeout(600), pytest.mark.filterwarnings("ignore::FutureWarning:ray")]


@pytest.fixture(scope="module")
def cluster() -> Iterator[None]:
    """A cluster with room for two samplers, which this process begins. Its processes can import ``support``."""
    path = os.pathsep.join([str(TESTS), os.environ.get("PYTHONPATH", "")])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_worker_niceness", "0")
        patch.setenv("PYTHONPATH", path)
        ray.init("local", num_cpus=2, include_dashboard=False, log_to_driver=False)
    yield
    ray.shutdown()


@pytest.fixture
def plan(api: Api, line: str) -> SamplerPlan:
    settings = SamplerSettings(name="there", until_done=True, batch=1, lease_seconds=3.0)
    return SamplerPlan(api.url, None, line, "support.moody:Unhurried", None, 30.0, settings)


def test_samplers_on_ray_share_a_design_and_restart_when_killed(cluster: None, api: Api, plan: SamplerPlan):
    """The design takes ten seconds of the other sampler, so it lasts until the killed one is back."""
    name = f"{plan.surrogate}-long"
    api.create_surrogate(name, SPEC.model_copy(update={"design": Design(initial=LONG, budget=LONG)}))
    plan = replace(plan, surrogate=name)
    samplers = RaySamplers(plan, 2, ONE_CPU)
    killed: list[int] = []
    texts: list[str] = []

    def tell(line):
        texts.append(line.text)
        if " answered" in line.text and not killed:
            [killed[:]] = [[int(text.rpartition(" ")[2])] for text in texts if text.startswith("there-0 runs on ")]
            os.kill(killed[0], signal.SIGKILL)

    run_samplers(samplers, PATIENCE, tell, texts.append)
    report, view = samplers.report(), api.surrogate(plan.surrogate)
    assert view.ledger.total == LONG
    assert (report.failed, samplers.errors) == (0, [])
    assert samplers.restarts == 1
    assert sum("was started again" in text for text in texts) == 1


def test_ctrl_c_of_samplers_on_ray_finishes_running_steps_and_returns_leases(
    cluster: None, api: Api, plan: SamplerPlan, capfd: pytest.CaptureFixture[str]
):
    capfd.readouterr()
    samplers = RaySamplers(replace(plan, settings=replace(plan.settings, lease_seconds=600.0)), 1, ONE_CPU)
    said: list[str] = []

    def interrupt(line):
        if " answered" in line.text:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_samplers(samplers, None, interrupt, said.append)
    view = api.surrogate(plan.surrogate)
    assert (view.queries.leased, view.ledger.unresolved) == (0, 0)
    assert samplers.report().steps == view.ledger.total >= 1
    assert capfd.readouterr().out == ""  # it may be read as JSON
    assert said[-1:] == ["waiting for the running steps of 1 samplers; Ctrl-C again ends them at once"]


def test_a_sampler_on_ray_whose_environment_fails_ends_with_its_error(plan: SamplerPlan):
    ended = SamplerActor(replace(plan, environment="support.moody:Nobody")).run()
    assert "expected package.module:factory, got 'support.moody:Nobody'" in str(ended.error)
    assert ended.look.report.steps == 0


def test_the_error_for_a_module_missing_on_a_ray_machine_names_the_option(plan: SamplerPlan):
    ended = SamplerActor(replace(plan, environment="no_such_module:Cart")).run()
    assert "No module named 'no_such_module'; " in str(ended.error)
    assert "--runtime-env FILE, a YAML file with working_dir: ." in str(ended.error)


def test_a_ray_machine_with_another_package_version_takes_no_real_step(plan: SamplerPlan):
    ended = SamplerActor(replace(plan, version="0.0.1")).run()
    assert str(ended.error).startswith("expected surrogym 0.0.1 on every machine of the cluster, got ")


def test_samplers_waiting_for_ray_resources_are_reported_and_end_at_the_time_limit(
    cluster: None, plan: SamplerPlan, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
):
    monkeypatch.setattr("surrogym.cli.sampling_on_ray.ROOM_SECONDS", 0.5)
    samplers, said = RaySamplers(plan, 1, {"CPU": 1.0, "robot": 1.0}), []
    begun = time.monotonic()
    run_samplers(samplers, 1.5, said.append, said.append)
    assert time.monotonic() - begun < PATIENCE
    assert said == ["1 of 1 samplers have not started yet; each takes CPU=1, robot=1, and the cluster has robot=0 free"]
    assert samplers.report().steps == 0
    assert capfd.readouterr().out == ""  # it may be read as JSON


def test_without_a_free_ray_cpu_a_remedy_is_shown(cluster: None, plan: SamplerPlan, monkeypatch: pytest.MonkeyPatch):
    """Session hosts may have taken all CPUs of a small machine."""
    monkeypatch.setattr("surrogym.cli.sampling_on_ray.ROOM_SECONDS", 0.5)
    samplers, said = RaySamplers(plan, 1, {"CPU": 3.0}), []

    def interrupt(text):
        said.append(text)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_samplers(samplers, None, said.append, interrupt)
    [words] = said
    assert words.startswith("1 of 1 samplers have not started yet; each takes CPU=3, and the cluster has CPU=")
    assert "--ray-resources CPU=0 takes none, and a smaller --ray-hosts of the server leaves more" in words
