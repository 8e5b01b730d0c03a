"""``surrogym work``: run the trainings and evaluations that people start on the page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from surrogym.cli.beside import reference_of, spec_of_reference
from surrogym.cli.errors import CommandError
from surrogym.cli.groups import Output, PolicyReading, Service
from surrogym.cli.opening import opener_of
from surrogym.cli.options import (
    NAMES,
    ExitWithParent,
    FallbackProgram,
    SpecFile,
    Surrogate,
    Wait,
    awaited_surrogate,
    read_spec,
)
from surrogym_client.runtime.lifetime import exit_with_parent as watch_parent
from surrogym_client.runtime.lifetime import terminations_as_interrupts
from surrogym_shared.terminal import on_interrupt, progress, say

if TYPE_CHECKING:
    from surrogym_shared.spec import EnvironmentSpec
    from surrogym_shared.terminal import Update
    from surrogym_trainer.work.reporter import Stand
    from surrogym_trainer.work.worker import Environment, WorkerReport


Reference = Annotated[
    str | None,
    typer.Option(
        help="Reference controller that evaluations may be compared with: a policy file, or package.module:name, as "
        "for surrogym evaluate. The module's code is run."
    ),
]


def command(
    context: typer.Context,
    surrogate: Surrogate,
    env: Annotated[
        str | None,
        typer.Option(
            help=f"Environment to evaluate in: {NAMES}. [default: the environment that the surrogate names, if "
            "opening it runs no file of yours; otherwise the worker only trains]"
        ),
    ] = None,
    spec: SpecFile = None,
    fallback: FallbackProgram = None,
    most_episodes: Annotated[
        int,
        typer.Option(min=0, max=1_000, help="Most real episodes of one evaluation. 0: the worker only trains."),
    ] = 100,
    reference: Reference = None,
    folder: Annotated[Path, typer.Option(help="Folder for policies, and for results that wait for the server.")] = Path(
        "work"
    ),
    once: Annotated[bool, typer.Option("--once", help="Stop after the first job.")] = False,
    worker: Annotated[str | None, typer.Option(help="Name of this worker. [default: host and process]")] = None,
    wait: Wait = 0.0,
    exit_with_parent: ExitWithParent = False,
    *,
    service: Service,
    output: Output,
) -> None:
    """Run the trainings and evaluations that people start.

    People start jobs on the page. The worker waits for those of one surrogate, and runs them as surrogym train and
    surrogym evaluate do. It reports how far it is, and stores the policy on the server. Evaluations take real steps in
    the environment that is given here; a job can't choose another one. Ctrl-C ends the command, and keeps the best
    policy so far.

    Example: surrogym work pendulum --env Pendulum-v1
    """
    from surrogym_sampler.queries.settings import worker_name
    from surrogym_trainer.work.worker import Worker, WorkerSettings

    if exit_with_parent:
        watch_parent()
    settings = WorkerSettings(name=worker or worker_name(), folder=folder, once=once)
    with service.connect(context, wait, quiet=output.quiet) as api:
        asked = awaited_surrogate(api, surrogate, wait, quiet=output.quiet).spec
        environment = _environment(surrogate, env, read_spec(spec), fallback, asked, most_episodes, quiet=output.quiet)
        environment = _with_reference(environment, reference)
        with progress("work", quiet=output.quiet) as update:
            tell = partial(say, quiet=output.quiet)
            token = service.token_for(context)
            run = Worker(api, surrogate, settings, environment, token, tell, _showing(update))
            update(None, f"waiting for jobs of {surrogate}")
            with terminations_as_interrupts(), on_interrupt(lambda: f"interrupted; {_words(run.report())}"):
                report = run.run()
    output.give(asdict(report), lambda: _words(report))


def _environment(
    surrogate: str,
    env: str | None,
    given: EnvironmentSpec | None,
    fallback: str | None,
    asked: EnvironmentSpec,
    most_episodes: int,
    *,
    quiet: bool,
) -> Environment | None:
    """Return the environment for evaluations, after a check that it fits the surrogate; None if the worker only
    trains."""
    from surrogym_sampler.original.loading import is_known
    from surrogym_sampler.queries.query_limits import check_environment
    from surrogym_trainer.policies.card import PolicyCard
    from surrogym_trainer.work.tasks import Environment

    if most_episodes == 0 or (env is None and not is_known(asked.environment)):
        say("this worker only trains; to evaluate as well: --env package.module:factory", quiet=quiet)
        return None
    opener = opener_of(env, given, PolicyCard(spec=asked), fallback, quiet=quiet)
    episode = opener()
    try:
        check_environment(surrogate, asked, episode.spec)
        return Environment(episode.spec, opener, most_episodes, env or asked.environment)
    finally:
        episode.close()


def _with_reference(environment: Environment | None, reference: str | None) -> Environment | None:
    """Return the environment with a function that loads the reference controller, after a check that it can be loaded.

    Raises:
        CommandError, OriginalError, UnusablePolicy: there is no such controller, or no environment for it.
    """
    from surrogym_sampler.original.fitting import check_policy

    if reference is None:
        return environment
    if environment is None:
        raise CommandError(
            "--reference: expected a worker that evaluates, got one that only trains: give --env and a --most-episodes "
            "above 0, or leave --reference out"
        )
    if (trained_for := spec_of_reference(reference)) is not None:
        check_policy(trained_for, environment.spec)
    load = partial(reference_of, reference, PolicyReading())
    load()
    return replace(environment, reference=load)


def _showing(update: Update) -> Callable[[Stand], None]:
    from surrogym_trainer.training.words import words_of

    def show(stand: Stand) -> None:
        now = stand.now
        update(stand.share, stand.stage if now is None or stand.stage != "training" else words_of(vars(now)))

    return show


def _words(report: WorkerReport) -> str:
    return f"{report.done} jobs done, {report.failed} failed, {report.cancelled} cancelled"
