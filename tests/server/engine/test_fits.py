"""The process that fits: apart from this one, replaced when it dies, and gone when it is told so."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from support import jobs
from surrogym_server.engine.design_job import DesignJob, DesignResult
from surrogym_server.engine.fits import NICENESS, Fits
from surrogym_server.errors import ChoiceFailed, PluginFailed, Unavailable

Started = Callable[[Callable[[DesignJob], DesignResult]], Fits]


class Job:
    """Stands for a design job; the functions here read its state alone."""

    def __init__(self, **state: Any) -> None:
        self.state = state


@pytest.fixture
def started() -> Iterator[Started]:
    made: list[Fits] = []

    def start(function: Callable[[DesignJob], DesignResult]) -> Fits:
        made.append(Fits(function))
        return made[-1]

    yield start
    for fits in made:
        fits.close()


def run(fits: Fits, **state: Any) -> DesignResult:
    return asyncio.run(fits.run(cast(DesignJob, Job(**state))))


@pytest.mark.usefixtures("cold")
def test_fit_jobs_run_in_one_other_process(started: Started):
    fits = started(jobs.answer)
    assert run(fits).data_hash not in ("", str(os.getpid()))
    assert run(fits).data_hash == run(fits).data_hash, "one process does them all"


@pytest.mark.skipif(sys.platform != "linux", reason="other systems don't allow a fork")
def test_a_forked_fitting_process_ends_with_its_parent():
    """In a program of its own, because this one has threads."""
    program = """
import asyncio, os, signal, sys
from support import jobs
from surrogym_server.engine.fits import Fits

class Job:
    state = {"answer": True}

fits = Fits(jobs.answer, forks=True)
fits.start()
process = asyncio.run(fits.run(Job())).data_hash
assert process != str(os.getpid())
print(process, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""
    path = os.pathsep.join([str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])])
    ended = subprocess.run(
        [sys.executable, "-c", program], env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True
    )
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    deadline = time.monotonic() + 30
    while _alive(int(ended.stdout)):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_the_fitting_process_has_a_lower_cpu_priority_than_the_server(started: Started):
    process = int(run(started(jobs.answer)).data_hash)
    mine = os.getpriority(os.PRIO_PROCESS, 0)
    assert os.getpriority(os.PRIO_PROCESS, process) == min(mine + NICENESS, 19)


RAISED = {
    "ValueError": "ValueError: no such luck",
    "SystemExit": "SystemExit: 3",
    "KeyboardInterrupt": "KeyboardInterrupt",
    "CancelledError": "CancelledError",
    "TwoArguments": "TwoArguments: x: boom",
    "Unspeakable": "Unspeakable",
    "InvalidInput": "on purpose",
    "ChoiceFailed": "on purpose too",
}


def test_the_error_of_a_fit_job_arrives_as_text_and_the_process_continues(started: Started):
    """Not as the exception: one could end who receives it, and another can't be sent. One process does all."""
    fits = started(jobs.refuse)
    process = run(fits, answer=True).data_hash
    for raised, said in RAISED.items():
        with pytest.raises(PluginFailed) as caught:
            run(fits, raised=raised)
        assert str(caught.value) == said
        assert isinstance(caught.value, ChoiceFailed) == (raised == "ChoiceFailed"), "which of the two failed"
        assert hasattr(caught.value, "__notes__") == (not said.startswith("on purpose")), "the traceback, for the log"
        assert run(fits, answer=True).data_hash == process


def test_a_cancelled_fit_job_is_killed_and_blocks_no_other_job(started: Started, tmp_path: Path):
    fits, mark = started(jobs.hang), tmp_path / "mark"

    async def cancel_while_it_hangs() -> int:
        hanging = asyncio.create_task(fits.run(cast(DesignJob, Job(mark=str(mark)))))
        while not mark.exists() or not mark.read_text():
            await asyncio.sleep(0.01)
        assert (await fits.run(cast(DesignJob, Job(answer=True)))).data_hash != mark.read_text()
        hanging.cancel()
        with pytest.raises(asyncio.CancelledError):
            await hanging
        return int(mark.read_text())

    process = asyncio.run(cancel_while_it_hangs())
    assert not _alive(process)


def test_a_fitting_process_that_dies_is_replaced_and_its_job_repeated(started: Started, tmp_path: Path):
    mark = tmp_path / "died"
    assert run(started(jobs.die_once), mark=str(mark)).verdict == "ready"
    assert mark.exists()


def test_a_fit_job_whose_process_dies_twice_fails(started: Started):
    fits = started(jobs.die)
    with pytest.raises(Unavailable, match="died twice"):
        run(fits)


def test_closing_kills_the_fitting_process_during_a_fit(started: Started, tmp_path: Path):
    fits, mark = started(jobs.hang), tmp_path / "mark"

    async def close_while_it_hangs() -> int:
        job = asyncio.create_task(fits.run(cast(DesignJob, Job(mark=str(mark)))))
        while not mark.exists() or not mark.read_text():
            await asyncio.sleep(0.01)
        job.cancel()
        await asyncio.to_thread(fits.close)
        return int(mark.read_text())

    process = asyncio.run(close_while_it_hangs())
    deadline = time.monotonic() + 30
    while _alive(process):
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.usefixtures("cold")
def test_closing_does_not_wait_for_a_starting_fitting_process(started: Started):
    """It imports for seconds where others keep the machine busy, and a stop of the server would wait for it."""
    beginning = time.monotonic()
    run(started(jobs.answer))
    whole_start = time.monotonic() - beginning
    fits = started(jobs.answer)
    fits.start()
    closing = time.monotonic()
    fits.close()
    assert time.monotonic() - closing < whole_start / 2


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True
