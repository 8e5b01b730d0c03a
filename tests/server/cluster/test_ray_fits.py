"""Rounds of designs as tasks of a real Ray cluster: the laws, and what its deaths lead to."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from surrogym_client.original import classic
from surrogym_server.convert import stored_definition
from surrogym_server.engine.design_job import DesignJob, DesignResult
from surrogym_server.environment.samples import Samples
from surrogym_server.errors import PluginFailed, Unavailable
from surrogym_server.settings import Settings
from surrogym_server.testing import LAWS_OF_COMPUTE, ComputeCase

ray = pytest.importorskip("ray")

from surrogym_server.cluster import fits, pool  # noqa: E402

pytestmark = [pytest.mark.timeout(600), pytest.mark.filterwarnings("ignore::FutureWarning:ray")]


@pytest.fixture(scope="module", autouse=True)
def cluster() -> Iterator[None]:
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    ray.init("local", num_cpus=2, namespace=pool.NAMESPACE, include_dashboard=False, log_to_driver=False)
    yield
    ray.shutdown()


@pytest.fixture
def job(pendulum_samples: Samples) -> DesignJob:
    samples = pendulum_samples
    arrays = (samples.q, samples.u, samples.q_next, samples.reward, samples.terminated)
    definition = stored_definition(classic.pendulum())
    return DesignJob(definition, *(a.numpy() for a in arrays), state={}, budget=len(samples), target=0.999)


@pytest.mark.parametrize("law", LAWS_OF_COMPUTE, ids=lambda law: law.__name__)
def test_tasks_of_a_cluster_keep_the_laws(law, job: DesignJob, tmp_path: Path):
    asyncio.run(law(ComputeCase(fits.RayFits, job, tmp_path)))


def die(job: DesignJob) -> DesignResult:
    """Note each beginning, and end the process."""
    with open(job.state["notes"], "a") as notes:
        notes.write(f"{os.getpid()}\n")
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


def test_a_job_whose_process_dies_is_tried_again_and_then_unavailable(job: DesignJob, tmp_path: Path):
    notes = tmp_path / "notes"
    with pytest.raises(Unavailable, match="the process or machine of a fit died"):
        asyncio.run(fits.RayFits(die).run(replace(job, state={"notes": str(notes)})))
    assert len(set(notes.read_text().split())) == 1 + fits.RETRIES


@pytest.mark.parametrize(("hosts", "expected"), [(1, fits.RayFits), (2, type(None))])
def test_fits_are_tasks_where_session_hosts_leave_a_cpu(hosts: int, expected: type):
    """A task that waits for a CPU that never comes free would wait for ever."""
    assert type(pool.fits_of(Settings(engine="ray", ray_hosts=hosts), die)) is expected


def test_a_machine_of_other_versions_is_named(job: DesignJob, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(
        fits, "versions", lambda: {"Python": "2.7", "surrogym": "0", "torch": "0", "numpy": "0", "ray": "0"}
    )
    with pytest.raises(PluginFailed, match=r"expected Python 2\.7 on every machine of the cluster, got 3\."):
        asyncio.run(fits.RayFits(die).run(job))
