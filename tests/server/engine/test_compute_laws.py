"""The processes of this machine keep the laws of what computes rounds of designs."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from support.compute_laws import LAWS_OF_COMPUTE, ComputeCase
from surrogym_server.engine.design_job import DesignJob
from surrogym_server.engine.fits import Fits


@pytest.mark.parametrize("law", LAWS_OF_COMPUTE, ids=lambda law: law.__name__)
def test_local_fitting_processes_pass_the_compute_interface_tests(law, job: DesignJob, tmp_path: Path):
    asyncio.run(law(ComputeCase(Fits, job, tmp_path)))
