"""Jobs for the process that fits: importable there, unlike functions of a test module."""

from __future__ import annotations

import os
import time
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any

from surrogym_server.engine.design_job import DesignJob, DesignResult
from surrogym_server.errors import ChoiceFailed, InvalidInput

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
    }
    return DesignResult(**values | changes)


def answer(job: DesignJob) -> DesignResult:
    return result()


class TwoArguments(Exception):
    """One that can be pickled and not unpickled."""

    def __init__(self, output: str, why: str) -> None:
        super().__init__(f"{output}: {why}")


class Unspeakable(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no words")


RAISED: dict[str, BaseException] = {
    "ValueError": ValueError("no such\n   luck"),
    "SystemExit": SystemExit(3),
    "KeyboardInterrupt": KeyboardInterrupt(),
    "CancelledError": CancelledError(),
    "TwoArguments": TwoArguments("x", "boom"),
    "Unspeakable": Unspeakable(),
    "InvalidInput": InvalidInput("on purpose"),
    "ChoiceFailed": ChoiceFailed("on purpose too"),
}


def refuse(job: DesignJob) -> DesignResult:
    """``job.state["raised"]`` names what it raises, where it is not asked to ``answer``."""
    if "answer" in job.state:
        return result()
    raise RAISED[job.state["raised"]]


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
    """Unless it is asked to ``answer``."""
    if "answer" in job.state:
        return result()
    Path(job.state["mark"]).write_text(str(os.getpid()))
    time.sleep(HANGING_SECONDS)
    return result()
