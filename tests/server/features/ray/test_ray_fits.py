"""Rounds of designs as tasks of a real Ray cluster: the laws, what its deaths lead to, and the GPUs of tasks and hosts.

The cluster says that it has one GPU. Ray counts GPUs without looking for them, so no test needs one."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from support import compute_laws
from support.compute_laws import LAWS_OF_COMPUTE, ComputeCase
from support.real_steps import columns
from surrogym_sampler.original import classic
from surrogym_server.convert import stored_definition
from surrogym_server.engine.design_job import DesignJob, DesignResult
from surrogym_server.environment.samples import Samples
from surrogym_server.errors import PluginFailed, Unavailable
from surrogym_server.settings import Settings

ray = pytest.importorskip("ray")

from surrogym_server.features.ray import fits, pool  # noqa: E402
from surrogym_server.features.ray.host import HostSettings  # noqa: E402

pytestmark = [pytest.mark.timeout(600), pytest.mark.filterwarnings("ignore::FutureWarning:ray")]


@pytest.fixture(scope="module", autouse=True)
def cluster() -> Iterator[None]:
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}
    for module in (compute_laws, sys.modules[__name__]):  # the processes of tasks do not find ``support``
        ray.cloudpickle.register_pickle_by_value(module)
    ray.init("local", num_cpus=2, num_gpus=1, namespace=pool.NAMESPACE, include_dashboard=False, log_to_driver=False)
    yield
    ray.shutdown()


@pytest.fixture
def job(pendulum_samples: Samples) -> DesignJob:
    samples = pendulum_samples
    definition = stored_definition(classic.pendulum())
    return DesignJob(definition, columns(samples), state={}, budget=len(samples), target=0.999)


@pytest.mark.parametrize("law", LAWS_OF_COMPUTE, ids=lambda law: law.__name__)
def test_ray_fitting_tasks_pass_the_compute_interface_tests(law, job: DesignJob, tmp_path: Path):
    asyncio.run(law(ComputeCase(fits.RayFits, job, tmp_path)))


def die(job: DesignJob) -> DesignResult:
    """Note each beginning, and end the process."""
    with open(job.state["notes"], "a") as notes:
        notes.write(f"{os.getpid()}\n")
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


def test_a_ray_fit_job_whose_process_dies_is_retried_and_then_fails(job: DesignJob, tmp_path: Path):
    notes = tmp_path / "notes"
    with pytest.raises(Unavailable, match="the process or machine of a fit died"):
        asyncio.run(fits.RayFits(die).run(replace(job, state={"notes": str(notes)})))
    assert len(set(notes.read_text().split())) == 1 + fits.RETRIES


@pytest.mark.parametrize(("hosts", "expected"), [(1, fits.RayFits), (2, type(None))])
def test_fits_run_as_ray_tasks_only_if_session_hosts_leave_a_free_cpu(hosts: int, expected: type):
    """A task that waits for a CPU that never comes free would wait for ever."""
    assert type(pool.fits_of(Settings(engine="ray", ray_hosts=hosts), die)) is expected


def test_a_fit_on_a_cluster_machine_with_other_package_versions_fails_with_them(
    job: DesignJob, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(
        fits, "versions", lambda: {"Python": "2.7", "surrogym": "0", "torch": "0", "numpy": "0", "ray": "0"}
    )
    with pytest.raises(PluginFailed, match=r"expected Python 2\.7 on every machine of the cluster, got 3\."):
        asyncio.run(fits.RayFits(die).run(job))


def note_gpus(job: DesignJob) -> DesignResult:
    """Note the GPUs that Ray gave this task."""
    Path(job.state["notes"]).write_text(f"{ray.get_gpu_ids()}")
    raise ValueError("noted")


@pytest.mark.parametrize(("asked", "given"), [(0.0, "[]"), (0.5, "[0]")])
def test_a_ray_fit_gets_the_number_of_gpus_of_its_setting(asked: float, given: str, job: DesignJob, tmp_path: Path):
    notes = tmp_path / "notes"
    compute = pool.fits_of(Settings(engine="ray", ray_hosts=1, ray_fit_gpus=asked), note_gpus)
    assert compute is not None
    with pytest.raises(PluginFailed, match="noted"):
        asyncio.run(compute.run(replace(job, state={"notes": str(notes)})))
    assert notes.read_text() == given


@pytest.mark.parametrize(("device", "asked"), [("cpu", 1.5), ("cuda", 0.5)])
def test_fits_run_in_the_front_server_if_the_cluster_lacks_their_gpus(
    device: str, asked: float, caplog: pytest.LogCaptureFixture
):
    settings = Settings.model_validate({"engine": "ray", "ray_hosts": 1, "device": device, "ray_fit_gpus": asked})
    assert pool.fits_of(settings, die) is None
    assert "the cluster has 1 GPUs" in caplog.text


class Standin:
    """A session host that only says which GPUs Ray gave it: CUDA itself is not here."""

    def __init__(self, settings: HostSettings, number: int) -> None:
        self._number = number

    async def about(self) -> tuple[int, list[int]]:
        return self._number, ray.get_gpu_ids()


def test_each_session_host_on_device_cuda_reserves_a_gpu_of_the_cluster(monkeypatch: pytest.MonkeyPatch):
    """One host has the GPU, and the second waits for another one. On the processor none takes any."""
    monkeypatch.setattr(pool, "SessionHost", Standin)
    wanted = HostSettings.of(Settings.model_validate({"engine": "ray", "device": "cuda"}))
    on_cpu = pool._host("cpu", 0, replace(wanted, device="cpu"))
    first = pool._host("gpu", 0, wanted)
    try:
        assert pool._about([on_cpu, first], wanted) == [(0, []), (0, [0])]
        ray.kill(on_cpu)  # so that a CPU is free
        second = pool._host("gpu", 1, wanted)
        monkeypatch.setattr(pool, "STARTING_SECONDS", 1.0)
        with pytest.raises(Unavailable, match="one of the cluster's CPUs and one of its GPUs"):
            pool._about([second], wanted)
        ray.kill(first)
        monkeypatch.undo()
        assert pool._about([second], wanted) == [(1, [0])]
        ray.kill(second)
    finally:
        for name in ("host 0 of cpu", "host 0 of gpu", "host 1 of gpu"):
            with suppress(ValueError):
                ray.kill(ray.get_actor(f"session {name}"))
