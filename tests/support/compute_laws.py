"""Test functions for implementations of ``Compute``. The laws are in its docstring in ``engine.port``."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from surrogym_server.engine.design_job import DesignJob, DesignResult, run_design_job
from surrogym_server.engine.port import Compute
from surrogym_server.errors import ChoiceFailed, PluginFailed

HANGING_SECONDS = 600.0
MEETING_SECONDS = 120.0
Function = Callable[[DesignJob], DesignResult]


@dataclass(frozen=True)
class ComputeCase:
    """A test case of a ``Compute``.

    ``make`` creates the ``Compute`` from the function that computes a job; child processes import this function by its
    name. ``job`` is the input of one round of a design, with enough samples to fit a model.
    """

    make: Callable[[Function], Compute]
    job: DesignJob
    folder: Path  # an empty folder in which test jobs can create files

    def asked(self, **state: Any) -> DesignJob:
        """Return the case's job with ``state`` as its design state. Test functions read their arguments from there."""
        return replace(self.job, state=state)


Law = Callable[[ComputeCase], Awaitable[None]]


async def a_result_is_that_of_the_job_bit_for_bit(case: ComputeCase) -> None:
    expected, compute = run_design_job(case.job), case.make(run_design_job)
    try:
        result = await compute.run(case.job)
    finally:
        await asyncio.to_thread(compute.close)
    for field in fields(DesignResult):
        if field.name != "seconds":
            ours, theirs = getattr(result, field.name), getattr(expected, field.name)
            assert np.array_equal(ours, theirs) if isinstance(ours, np.ndarray) else ours == theirs, field.name


async def jobs_at_once_do_not_wait_for_each_other(case: ComputeCase) -> None:
    """Check that two jobs run at the same time: each waits for a file that the other writes."""
    first, second = (str(case.folder / name) for name in ("first", "second"))
    compute = case.make(_meet)
    try:
        jobs = case.asked(mine=first, other=second), case.asked(mine=second, other=first)
        await asyncio.gather(*(compute.run(job) for job in jobs))
    finally:
        await asyncio.to_thread(compute.close)


async def what_a_job_raises_comes_back_as_words_and_ends_nothing(case: ComputeCase) -> None:
    compute = case.make(_refuse)
    try:
        for raised, kind in (("choice", ChoiceFailed), ("value", PluginFailed), ("exit", PluginFailed)):
            caught: BaseException | None = None
            try:
                await compute.run(case.asked(raised=raised))
            except BaseException as error:
                caught = error
            assert type(caught) is kind, f"{raised}: {caught!r}"
            assert "no such luck" in str(caught) or raised == "exit"
        assert (await compute.run(case.asked())).verdict == "ready"
    finally:
        await asyncio.to_thread(compute.close)


async def a_job_that_is_cancelled_ends_and_no_other_one(case: ComputeCase) -> None:
    mark = case.folder / "hangs"
    compute = case.make(_hang)
    try:
        hanging = asyncio.create_task(compute.run(case.asked(mark=str(mark))))
        while not mark.exists():
            assert not hanging.done(), hanging
            await asyncio.sleep(0.01)
        beside = asyncio.create_task(compute.run(case.asked()))
        hanging.cancel()
        await asyncio.wait({hanging})
        assert hanging.cancelled()
        assert (await beside).verdict == "ready"
        await _gone(int(mark.read_text()))
    finally:
        await asyncio.to_thread(compute.close)


async def a_job_is_done_elsewhere_and_closing_twice_is_harmless(case: ComputeCase) -> None:
    compute = case.make(_where)
    compute.start()
    result = await compute.run(case.asked())
    await asyncio.to_thread(compute.close)
    await asyncio.to_thread(compute.close)
    assert result.data_hash != str(os.getpid())


LAWS_OF_COMPUTE: tuple[Law, ...] = (
    a_result_is_that_of_the_job_bit_for_bit,
    jobs_at_once_do_not_wait_for_each_other,
    what_a_job_raises_comes_back_as_words_and_ends_nothing,
    a_job_that_is_cancelled_ends_and_no_other_one,
    a_job_is_done_elsewhere_and_closing_twice_is_harmless,
)


async def _gone(process: int) -> None:
    deadline = time.monotonic() + MEETING_SECONDS
    while True:
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            return
        assert time.monotonic() < deadline, "a job that was cancelled goes on"
        await asyncio.sleep(0.01)


def _where(job: DesignJob) -> DesignResult:
    """Return an empty result at once, with the id of the process that ran the job in its field ``data_hash``."""
    del job
    return DesignResult(b"", {}, {"samples": 0}, str(os.getpid()), {}, "ready", 0.0)


def _refuse(job: DesignJob) -> DesignResult:
    match job.state.get("raised"):
        case "choice":
            raise ChoiceFailed("no such luck")
        case "value":
            raise ValueError("no such luck")
        case "exit":
            raise SystemExit(3)
    return _where(job)


def _meet(job: DesignJob) -> DesignResult:
    Path(job.state["mine"]).touch()
    deadline = time.monotonic() + MEETING_SECONDS
    while not Path(job.state["other"]).exists():
        if time.monotonic() > deadline:
            raise TimeoutError(f"expected another job to run at the same time within {MEETING_SECONDS} s, none did")
        time.sleep(0.01)
    return _where(job)


def _hang(job: DesignJob) -> DesignResult:
    if "mark" in job.state:
        draft = Path(f"{job.state['mark']}.draft")
        draft.write_text(str(os.getpid()))
        draft.replace(job.state["mark"])
        time.sleep(HANGING_SECONDS)
    return _where(job)
