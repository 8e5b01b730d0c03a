"""Jobs for the process that fits: importable there, unlike functions of a test module."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from surrogym_server.engine.design_job import DesignJob, DesignResult

HANGING_SECONDS = 600


def result(**changes: Any) -> DesignResult:
    """A result whose data hash is the number of the process that made it."""
    values: dict[str, Any] = {
        "model": b"model",
        "description": {},
        "fidelity": {"samples": 0},
        "data_hash": str(os.getpid()),
        "state": {},
        "verdict": "ready",
        "seconds": 0.0,
        "query_coordinates": np.zeros((0, 2)),
        "query_action": np.zeros((0, 1)),
    }
    return DesignResult(**values | changes)


def answer(job: DesignJob) -> DesignResult:
    return result()


def refuse(job: DesignJob) -> DesignResult:
    raise ValueError("no such luck")


def leave(job: DesignJob) -> DesignResult:
    sys.exit("no licence")


def die(job: DesignJob) -> DesignResult:
    os._exit(1)


def die_once(job: DesignJob) -> DesignResult:
    """``job.state["mark"]`` names a file that says whether it died already."""
    mark = Path(job.state["mark"])
    if mark.exists():
        return result()
    mark.touch()
    os._exit(1)


def hang(job: DesignJob) -> DesignResult:
    Path(job.state["mark"]).write_text(str(os.getpid()))
    time.sleep(HANGING_SECONDS)
    return result()
