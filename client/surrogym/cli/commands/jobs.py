"""``surrogym jobs``: list or cancel the trainings and evaluations that people requested from trainer workers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from surrogym.cli.columns import columns
from surrogym.cli.errors import CommandError
from surrogym.cli.groups import Output, Service
from surrogym.cli.options import Surrogate
from surrogym_trainer.work.words import words_of_task

if TYPE_CHECKING:
    from surrogym_shared.wire import JobDetail, JobList, JobView

HEADING = ("job", "status", "task", "done", "imagined return", "worker", "policy", "why")


def command(
    context: typer.Context,
    surrogate: Surrogate,
    job: Annotated[int | None, typer.Argument(min=1, help="Number of a job to show. [default: list all]")] = None,
    cancel: Annotated[
        bool,
        typer.Option("--cancel", help="Cancel the job. A running training keeps the best policy so far."),
    ] = False,
    *,
    service: Service,
    output: Output,
) -> None:
    """List, show or cancel the jobs of a surrogate.

    Jobs are trainings and evaluations that people asked for on the page. surrogym work runs them.

    Example: surrogym jobs pendulum
    """
    if cancel and job is None:
        raise CommandError(f"--cancel: expected the number of a job, as surrogym jobs {surrogate} lists them, got none")
    with service.connect(context) as api:
        if job is None:
            found = api.jobs.list(surrogate)
            output.give(found.model_dump(mode="json"), lambda: _table(surrogate, found))
            return
        if cancel:
            api.jobs.cancel(surrogate, job)
        one = api.jobs.get(surrogate, job)
    output.give(one.model_dump(mode="json"), lambda: _words(one))


def _table(surrogate: str, found: JobList) -> str:
    names = ", ".join(worker.name for worker in found.workers)
    workers = f"workers: {names}" if names else f"no worker is connected; to start one: surrogym work {surrogate}"
    if not found.jobs:
        return f"no jobs yet: the page at / starts them\n{workers}"
    return f"{columns([HEADING, *map(_row, found.jobs)])}\n{workers}"


def _row(job: JobView) -> tuple[str | int, ...]:
    return (
        job.id,
        "cancelling" if job.cancelling and job.status == "running" else job.status,
        words_of_task(job.task),
        _share(job),
        "-" if job.imagined_return is None else f"{job.imagined_return:.4g}",
        job.worker or "-",
        "-" if job.version is None else job.version,
        job.error or "-",
    )


def _share(job: JobView) -> str:
    return f"{job.stage} {job.share:.0%}" if job.status == "running" and job.stage is not None else "-"


def _words(job: JobDetail) -> str:
    rows = [[point.steps, "-" if point.imagined_return is None else point.imagined_return] for point in job.curve]
    curve = "" if not rows else "\n" + columns([["virtual steps", "imagined return"], *rows[-10:]])
    return f"{columns([HEADING, _row(job)])}{curve}"
