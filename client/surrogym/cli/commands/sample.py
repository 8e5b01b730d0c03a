"""``surrogym sample``: answer a surrogate's queries beside the original environment."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from surrogym.cli.errors import CommandError
from surrogym.cli.groups import Output, Service
from surrogym.cli.options import (
    NAMES,
    ExitWithParent,
    FallbackProgram,
    SpecFile,
    StepLimit,
    Surrogate,
    Wait,
    awaited_surrogate,
    read_spec,
)
from surrogym.cli.sampling_on_ray import RayOptions, run_samplers, samplers_on_ray
from surrogym_client.runtime.lifetime import exit_with_parent as watch_parent
from surrogym_client.runtime.lifetime import terminations, terminations_as_interrupts
from surrogym_shared.environments import is_name
from surrogym_shared.terminal import on_interrupt, progress, say
from surrogym_shared.words import counted

if TYPE_CHECKING:
    from surrogym_client.transport.api import Api
    from surrogym_sampler.queries.settings import Outcome, SamplerPlan, SamplerReport, SamplerSettings
    from surrogym_sampler.queries.words import Line
    from surrogym_shared.spec import EnvironmentSpec
    from surrogym_shared.wire import Phase, Query, SurrogateView

    Tell = Callable[[Line], None]


Environment = Annotated[
    str | None,
    typer.Option(
        help=f"Environment to take real steps in: {NAMES}. [default: the environment that the surrogate names, if "
        "opening it runs no file of yours]"
    ),
]
Command = Annotated[
    str | None,
    typer.Option(
        "--exec",
        metavar="COMMAND",
        help='Program that takes the real steps, such as "./plant --port 7". Short for --env "exec:COMMAND".',
    ),
]
UntilDone = Annotated[bool, typer.Option("--until-done", help="Stop when the design is ready or has spent its budget.")]
MaxQueries = Annotated[int | None, typer.Option(min=1, help="Maximum number of queries to begin. [default: no limit]")]
TimeLimit = Annotated[
    float | None, typer.Option(min=0, help="Seconds after which no further query begins. [default: no limit]")
]


UNWATCHED = (
    "limits: if the sampler is killed (kill -9), only the program itself can fall back, when its input closes; "
    "surrogym conformance --exec COMMAND checks that it does"
)


@dataclass(frozen=True)
class SnapshotOptions:
    """Options for the snapshots of visited states that a sampler keeps."""

    snapshots: Annotated[
        Path | None,
        typer.Option(
            help="Folder that keeps snapshots for the next sampler; several samplers may share it. [default: they end "
            "with the sampler]"
        ),
    ] = None
    most_snapshots: Annotated[int, typer.Option(min=1, help="Largest number of snapshots to keep.")] = 1_000
    most_bytes: Annotated[int, typer.Option(min=1, help="Largest size of all snapshots to keep, in bytes.")] = 1 << 30


@dataclass(frozen=True)
class CautionOptions:
    """Options for showing queries to a person before they are taken."""

    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print and draw the queries that wait for a sampler, and take none.")
    ] = False
    approve: Annotated[
        bool,
        typer.Option(
            "--approve",
            help="Print and draw each query, and ask before it is taken. A refused one is never asked again.",
        ),
    ] = False

    def require_fit(self, cluster: RayOptions, output: Output) -> None:
        """Raise ``CommandError`` if ``--approve`` is given, but the command can't ask a person on a terminal."""
        if self.approve and (cluster.on_ray is not None or output.quiet or not sys.stdin.isatty()):
            raise CommandError(
                "--approve asks a person before each query: expected a terminal, without --quiet and --on-ray"
            )


def command(
    context: typer.Context,
    surrogate: Surrogate,
    env: Environment = None,
    program: Command = None,
    spec: SpecFile = None,
    fallback: FallbackProgram = None,
    once: Annotated[bool, typer.Option("--once", help="Stop after the first claim that returns queries.")] = False,
    until_done: UntilDone = False,
    max_queries: MaxQueries = None,
    time_limit: TimeLimit = None,
    step_limit: StepLimit = 30.0,
    batch: Annotated[
        int, typer.Option(min=1, max=256, help="Number of queries to claim at once. Rollouts from resets: always one.")
    ] = 4,
    worker: Annotated[str | None, typer.Option(help="Name of this sampler. [default: host and process]")] = None,
    wait: Wait = 0.0,
    exit_with_parent: ExitWithParent = False,
    *,
    keeping: SnapshotOptions,
    caution: CautionOptions,
    cluster: RayOptions,
    service: Service,
    output: Output,
) -> None:
    """Take the real steps that the server asks for.

    For each query, the sampler sets the original environment to a state, takes one real step and reports the sample. If
    the environment can't be set to any state, the sampler resets it, or returns to a snapshot, and takes a sequence of
    actions. Ctrl-C ends the command.

    Example: surrogym sample pendulum --until-done

    Example: surrogym sample cart --env cart:Cart --on-ray 32 --ray-resources CPU=2 --runtime-env env.yaml
    """
    from surrogym_sampler.queries.settings import SamplerPlan, SamplerSettings, worker_name
    from surrogym_sampler.queries.snapshots import Bounds

    cluster.require_fit(worker_limits=once or max_queries is not None)
    caution.require_fit(cluster, output)
    if exit_with_parent:
        watch_parent()
    settings = SamplerSettings(
        name=worker or worker_name(),
        batch=batch,
        once=once,
        until_done=until_done,
        max_queries=max_queries,
        time_limit=time_limit,
        snapshots=keeping.snapshots,
        bounds=Bounds(keeping.most_snapshots, keeping.most_bytes),
    )
    with service.connect(context, wait, quiet=output.quiet) as api:
        view = awaited_surrogate(api, surrogate, wait, quiet=output.quiet)
        if caution.dry_run:
            _show_queries(api, view, output)
            return
        if _without_queries(view, output, until_done=until_done):
            return
        name, replaced = environment_of(_named(env, program), read_spec(spec), view.spec)
        plan = SamplerPlan(
            api.url, service.token_for(context), surrogate, name, replaced, step_limit, settings, fallback
        )
        if cluster.on_ray is None:
            _sample_here(api, plan, output, approved if caution.approve else None)
        else:
            _require_shared(view.spec, settings)
            _warn_of_kill(name, view.spec, output)
            _sample_on_ray(api, plan, cluster, output)


def _show_queries(api: Api, view: SurrogateView, output: Output) -> None:
    """Print and draw the queries of a surrogate that wait for a sampler."""
    from surrogym_sampler.queries.words import words_of_query

    waiting = [query for query in api.queries(view.name) if query.status == "pending"]
    drawn = [line for query in waiting for line in words_of_query(view.spec, query)]
    found = {"queries": [query.model_dump(mode="json") for query in waiting]}
    output.give(found, lambda: "\n".join(drawn) or f"no query of {view.name} waits for a sampler")


def approved(spec: EnvironmentSpec, query: Query) -> bool:
    """Print and draw a query on the terminal, and return whether the person there agrees that it is taken.

    Raises:
        KeyboardInterrupt: the person pressed Ctrl-C, or ended the input.
    """
    from surrogym_sampler.queries.words import words_of_query

    for line in words_of_query(spec, query):
        say(line)
    try:
        return typer.confirm("take it?", default=False, err=True)
    except typer.Abort:
        raise KeyboardInterrupt from None


def _sample_here(
    api: Api, plan: SamplerPlan, output: Output, ask: Callable[[EnvironmentSpec, Query], bool] | None = None
) -> None:
    from surrogym_sampler.original.loading import for_queries
    from surrogym_sampler.queries.words import Line, line_of
    from surrogym_sampler.queries.worker import Sampler

    with (
        closing(for_queries(plan.environment, plan.step_limit, plan.spec, plan.fallback)) as environment,
        _telling(api, plan.surrogate, quiet=output.quiet, plain=ask is not None) as tell,
    ):
        approve = None if ask is None else partial(ask, environment.spec())
        _warn_of_kill(plan.environment, environment.spec(), output)

        def report(query: Query, outcome: Outcome, error: str) -> None:
            if tell is not None:
                tell(Line(line_of(query, outcome, error), bool(error)))

        def ended(phase: Phase) -> None:
            # With --until-done the sampler ends now, and the command prints its result.
            if not plan.settings.until_done:
                say(_words_of_end(plan.surrogate, phase), quiet=output.quiet)

        waits = partial(say, quiet=output.quiet)
        sampler = Sampler(api, plan.surrogate, environment, plan.settings, report, ended, approve, waits)
        for number in terminations():
            signal.signal(number, lambda *_: sampler.stop())
        with on_interrupt(lambda: _words_of_interruption(sampler.summary())), closing(environment):
            result = sampler.run()
        # ``fallback_steps`` is read again, because the fallback controller may act while the environment is closed.
        result = replace(result, fallback_steps=sampler.summary().fallback_steps)
    output.give(asdict(result), lambda: _words(plan.surrogate, result))
    if result.phase == "failed":
        raise typer.Exit(1)


def _warn_of_kill(name: str, spec: EnvironmentSpec, output: Output) -> None:
    """Print a warning for an environment that is a program and has limits: after ``kill -9`` of the sampler, only the
    program itself can keep them. Other environments run in a process that survives the sampler until the machine rests.
    """
    from surrogym_sampler.original.executables import is_executable

    if spec.limits is not None and is_executable(name):
        say(UNWATCHED, quiet=output.quiet)


def _require_shared(asked: EnvironmentSpec, settings: SamplerSettings) -> None:
    """Raise ``CommandError`` if several samplers need snapshots, but have no folder to share them."""
    if asked.snapshots and settings.snapshots is None:
        raise CommandError(
            "several samplers share their snapshots: expected --snapshots with a folder that all of them can reach"
        )


def _sample_on_ray(api: Api, plan: SamplerPlan, cluster: RayOptions, output: Output) -> None:
    time_limit, endless = plan.settings.time_limit, replace(plan.settings, time_limit=None)
    samplers = samplers_on_ray(cluster, replace(plan, settings=endless))
    with (
        _telling(api, plan.surrogate, quiet=output.quiet) as tell,
        terminations_as_interrupts(),
        on_interrupt(lambda: _words_of_interruption(samplers.report())),
    ):
        run_samplers(samplers, time_limit, tell or (lambda _: None), lambda text: say(text, quiet=output.quiet))
    report = samplers.report()
    result = {**asdict(report), "restarts": samplers.restarts, "errors": samplers.errors}
    again = f"; {samplers.restarts} samplers died and were started again" if samplers.restarts else ""
    output.give(result, lambda: f"{_words(plan.surrogate, report)}{again}")
    if report.phase == "failed" or samplers.errors:
        raise typer.Exit(1)


def _named(env: str | None, program: str | None) -> str | None:
    """Return the name of the environment from the option --env or --exec. Raises ``CommandError`` if both are given."""
    from surrogym_sampler.original.executables import name_of

    if env is not None and program is not None:
        raise CommandError(f"expected --env or --exec, got both, {env!r} and {program!r}: give one of the two")
    return env if program is None else name_of(program)


def environment_of(
    env: str | None, given: EnvironmentSpec | None, asked: EnvironmentSpec
) -> tuple[str, EnvironmentSpec | None]:
    """Return the name of the environment to open, and the specification that replaces its own, or None.

    A name from the server (``asked``) is only opened if it is a Gymnasium id, because others would run unknown code.
    """
    from surrogym_sampler.original.loading import is_known, is_own

    if env is None and not is_known(asked.environment):
        raise CommandError(_words_of_consent(asked.environment))
    name = env or asked.environment
    own = is_own(name) and given is None
    return name, None if own else given or asked


def _words_of_consent(name: str) -> str:
    """Return the error message that an environment is not opened because only the server gave its name, with the option
    by which the user can give the name."""
    from surrogym_sampler.original.executables import is_executable
    from surrogym_sampler.original.loading import env_option

    if not is_executable(name) and is_name(name):
        return (
            f"the surrogate's environment {name!r} may run a file of yours, so its name has to come from you: "
            f"expected{env_option(name)}"
        )
    return (
        f"the surrogate's environment {name!r} can't be opened by this name alone: expected --env "
        "package.module:factory, --env pcgym:FILE.json, --env fmu:PLANT.fmu, --env mujoco:FILE.xml, or "
        "--exec COMMAND"
    )


@contextmanager
def _telling(api: Api, surrogate: str, *, quiet: bool, plain: bool = False) -> Iterator[Tell | None]:
    """Context that shows progress: a bar for the design on a terminal, otherwise a line for each query. Yields the
    function that shows a line; None if ``quiet``. With ``plain``, a terminal shows lines too, and no bar."""
    if quiet or plain or not sys.stderr.isatty():
        yield None if quiet else lambda line: say(line.text)
        return
    with progress("design") as update:

        def tell(line: Line) -> None:
            if line.is_error:
                say(line.text)
            # if the server does not answer, only the progress bar is not updated; the sampler retries
            with suppress(SurrogymClientError):
                view = api.surrogate(surrogate)
                update(share_of_design(view), words_of_design(view))

        from surrogym_client.errors import SurrogymClientError
        from surrogym_client.surrogates.waiting import share_of_design, words_of_design

        view = api.surrogate(surrogate)
        update(share_of_design(view), words_of_design(view))
        yield tell


def _without_queries(view: SurrogateView, output: Output, *, until_done: bool) -> bool:
    """Print a remark if the design has no queries until a log is imported. Returns whether the command ends now."""
    from surrogym_client.surrogates.waiting import awaits_log, words_of_no_log
    from surrogym_sampler.queries.settings import SamplerReport

    if not awaits_log(view):
        return False
    if until_done:
        output.give(asdict(SamplerReport(phase=view.phase)), lambda: words_of_no_log(view.name))
    else:
        say(f"{words_of_no_log(view.name)}; this sampler waits for queries, Ctrl-C ends it", quiet=output.quiet)
    return until_done


def _words_of_end(surrogate: str, phase: Phase) -> str:
    """Describe the end of a design while the sampler waits for further queries, such as those of an audit."""
    from surrogym_client.surrogates.waiting import COMPLETED, IN_WORDS

    following = (
        f"; next: surrogym train {surrogate}" if phase in COMPLETED else f": surrogym status {surrogate} says why"
    )
    return f"{IN_WORDS[phase]}{following}; this sampler waits for further queries, Ctrl-C ends it"


def _words_of_interruption(report: SamplerReport) -> str:
    return (
        f"interrupted after {report.answered} queries answered with {report.steps} real steps; all of them are stored, "
        "unfinished queries, if any, went back into the queue, and the same command continues"
        f"{_of_fallback(report.fallback_steps)}"
    )


def _of_fallback(steps: int) -> str:
    are = "is" if steps == 1 else "are"
    return f"; {counted(steps, 'step')} of the fallback, which {are} not in the ledger" if steps else ""


def _words(surrogate: str, report: SamplerReport) -> str:
    from surrogym_client.surrogates.waiting import COMPLETED, IN_WORDS

    others = {name: getattr(report, name) for name in ("failed", "dropped", "refused", "impossible")}
    apart = "".join(f", {count} {outcome}" for outcome, count in others.items() if count)
    said = f"{report.answered} queries answered with {report.steps} real steps{apart} in {report.seconds:.1f} s"
    said += _of_fallback(report.fallback_steps)
    if report.phase in IN_WORDS:
        said += f"; {IN_WORDS[report.phase]}"
    if report.phase == "failed":
        said += (
            f": surrogym status {surrogate} shows why; surrogym change {surrogate} --resume queues again the queries "
            "that were set aside"
        )
    return f"{said}; next: surrogym train {surrogate}" if report.phase in COMPLETED else said
