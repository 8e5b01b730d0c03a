"""The lab's command line, run in this process, and a Ray cluster for the studies that run their cells there."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from support.nursery import one_thread
from support.saying import speaker
from surrogym.cli import run
from surrogym_lab.commands import build


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    """Once all libraries are loaded."""
    one_thread()


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Of a cluster that this process begins."""
    ray = pytest.importorskip("ray")
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}
    begun = ray.init("local", num_cpus=2, include_dashboard=False, log_to_driver=False)
    yield str(begun.address_info["gcs_address"])
    ray.shutdown()


@pytest.fixture
def lab(capsys, monkeypatch, tmp_path):
    """``lab("efficiency", "--seeds=1")`` gives exit code, output and errors of ``python -m surrogym_lab``."""
    return speaker(lambda arguments: run(build, "python -m surrogym_lab", arguments), capsys, monkeypatch, tmp_path)
