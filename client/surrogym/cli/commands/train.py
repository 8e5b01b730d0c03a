"""``surrogym train``: learn a policy against a surrogate."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from surrogym.cli.errors import CommandError
from surrogym.cli.groups import Output, Service
from surrogym.cli.options import (
    LONGEST_SECONDS,
    ExitWithParent,
    Surrogate,
    TrainWait,
    awaited_surrogate,
    connect,
    given_here,
    push_or_say,
    require_known,
    typed,
    waiting,
    working,
)
from surrogym.cli.train_options import LogOptions, LoopOptions, SearchOptions, SessionOptions, StartOptions
from surrogym_client.runtime.lifetime import exit_with_parent as watch_parent
from surrogym_client.runtime.lifetime import terminations_as_interrupts
from surrogym_shared.terminal import progress, say
from surrogym_shared.words import counted

if TYPE_CHECKING:
    from surrogym_client.transport import Api
    from surrogym_shared.spec import EnvironmentSpec
    from surrogym_shared.terminal import Update
    from surrogym_shared.wire import CurvePoint, SurrogateView
    from surrogym_trainer.policies.card import PolicyCard
    from surrogym_trainer.training import TrainProgress, TrainResult, TrainSettings
    from surrogym_trainer.training.handover import Handover

    Record = Callable[[TrainProgress], None]

NOTHING_YET = "interrupted before there was a policy; nothing was saved; the same command starts from the beginning"


def command(
    context: typer.Context,
    surrogate: Surrogate,
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write the policy to.")] = Path("policy.zip"),
    *,
    search: SearchOptions,
    session: SessionOptions,
    start: StartOptions,
    loop: LoopOptions,
    log: LogOptions,
    wait: TrainWait = None,
    exit_with_parent: ExitWithParent = False,
    service: Service,
    output: Output,
) -> None:
    """Train a policy in the virtual environment.

    A running sampler takes the few real steps of the audit. If it fails or leaves the model in doubt, the sampler takes
    up to eight more from the budget, and the training continues. No other real step is taken, unless --improve is
    given. The command prints the imagined return: what the policy earns in the virtual environment, not in the original
    environment.

    Example: surrogym train pendulum --out policy.zip --seed 0
    """
    from surrogym_client.surrogates.waiting import words_of_rounds
    from surrogym_sampler.original.fitting import check_shape
    from surrogym_sampler.original.loading import env_option, sample_command
    from surrogym_trainer.policies.card import require_place
    from surrogym_trainer.training.cards import card_of
    from surrogym_trainer.training.search import with_algorithm
    from surrogym_trainer.training.words import words_of_no_sampler, words_of_result

    if exit_with_parent:
        watch_parent()
    require_place(out)  # before the design is awaited, which may take hours
    settings, learned = _settings(search, session, start, log), start.learned()
    token = service.token_for(context)
    with terminations_as_interrupts():
        spec, url = _trainable(surrogate, service.server, token, wait, settings, quiet=output.quiet)
    if learned is not None:
        check_shape(learned, spec, "the surrogate")
    settings = with_algorithm(settings, spec)
    if loop.improve:
        with connect(service.server, token) as api:
            say(words_of_rounds(api, surrogate, loop.improve, loop.rounds), quiet=output.quiet)
    _import(settings, quiet=output.quiet)
    curve: list[CurvePoint] = []
    made = partial(card_of, surrogate=surrogate, spec=spec, url=url, seed=search.seed, curve=curve)
    card = partial(_write_card, made)
    with _keeping(card, typed(context, without=("out", "start_from", "trust_policy", "token"))):
        recording = partial(_recording, log.progress_file, curve)
        result, handover = _train(url, token, surrogate, out, settings, loop, recording, quiet=output.quiet)
    summary = card(result, handover)
    if log.push:
        summary["version"] = push_or_say(url, token, result.path, surrogate, quiet=output.quiet)
    named = service.server if given_here(context, "server") else None
    shown = partial(
        words_of_result,
        asked=search.steps,
        closed_loop=bool(loop.improve),
        fits_planner=spec.fits_planner,
        server=named,
        env_option=env_option(spec.environment),
    )
    audit = words_of_no_sampler(result, handover, sample_command(surrogate, spec.environment))
    output.give(summary, lambda: f"{shown(result, handover)}{audit}")


def _settings(search: SearchOptions, session: SessionOptions, start: StartOptions, log: LogOptions) -> TrainSettings:
    """Return the settings of the training from the options. Raises errors that can be found without a server."""
    from surrogym_trainer.training import TrainSettings

    given = session.fields()
    hyperparameters = search.hyperparameters()
    algorithm = None if search.algorithm is None else require_known(search.algorithm)
    return TrainSettings(
        algorithm=algorithm,
        total_steps=search.steps,
        num_envs=search.num_envs,
        seed=search.seed,
        tracker=log.tracker(algorithm),
        tensorboard=log.tensorboard,
        hyperparameters=hyperparameters,
        session=given,
        integral=tuple(search.integral or ()),
        **vars(start),
    )


def _import(settings: TrainSettings, *, quiet: bool) -> None:
    """Import the packages of the policy search, which may take seconds, and show the progress on the terminal."""
    from surrogym_trainer.training.search import SEARCHES, name_of

    with working("prepare", NOTHING_YET, quiet=quiet) as update:
        update(None, f"importing what {name_of(settings)} needs")
        SEARCHES.get(name_of(settings))


@contextmanager
def _keeping(write_card: Callable[[TrainResult], object], asked: str) -> Iterator[None]:
    """Context that, after Ctrl-C or SIGTERM, writes the card of a saved policy, and prints what was saved and how to
    continue.

    Args:
        write_card: writes the card of the policy.
        asked: arguments of the command, for the advice.
    """
    from surrogym_trainer.training.settings import TrainingInterrupted
    from surrogym_trainer.training.words import words_of_interruption

    try:
        with terminations_as_interrupts():
            yield
    except TrainingInterrupted as interruption:
        result = interruption.result
        write_card(result)
        say(words_of_interruption(result, asked))
        raise
    except KeyboardInterrupt:
        say(NOTHING_YET)
        raise


def _words_of_sessions(view: SurrogateView) -> str:
    """Return a warning about open sessions of the surrogate, which may belong to another running training."""
    are = "is" if view.sessions == 1 else "are"
    return (
        f"warning: {counted(view.sessions, 'session')} of {view.name!r} {are} open, perhaps of another training. "
        "Trainings at the same time share the budget of real steps, and each one's steps change the model of the others"
    )


def _trainable(
    surrogate: str, server: str | None, token: str | None, wait: float | None, settings: TrainSettings, *, quiet: bool
) -> tuple[EnvironmentSpec, str]:
    """Return the specification of a surrogate that has a model, and the server's URL.

    If ``wait`` is above 0, wait at most that many seconds for the server, the surrogate and the end of its design, and
    import the packages of the policy search in the meantime. If it is None, wait for the end of a design as long as a
    sampler or a fit is at work.

    Raises:
        CommandError: the surrogate has no model yet, its reward lacks a set point or an integral of the settings, or
            a limit of the settings can't be kept.
    """
    from surrogym_client.surrogates.waiting import (
        COMPLETED,
        share_of_design,
        wait_for_design,
        wait_for_start,
        words_of_design,
        words_of_uncertainty,
    )
    from surrogym_shared.integrals import Integrals, errors_of
    from surrogym_shared.limits import limit_of
    from surrogym_shared.set_points import with_set_points
    from surrogym_trainer.training.search import SEARCHES, name_of

    with connect(server, token, wait or 0.0, quiet=quiet) as api:
        view = awaited_surrogate(api, surrogate, wait or 0.0, quiet=quiet)
        try:
            with_set_points(view.spec, settings.set_points)
            Integrals.of(view.spec, errors_of(view.spec, settings.integral, settings.set_points))
            for limit in settings.hyperparameters.get("limits") or ():
                limit_of(view.spec, str(limit))
        except ValueError as error:
            raise CommandError(str(error)) from error
        if wait is None and view.budget and view.model_version is None:
            with waiting("for a sampler", quiet=quiet):
                view = wait_for_start(api, surrogate)
        if wait or (wait is None and _is_at_work(view)):
            SEARCHES.get(name_of(settings))
            stays = "interrupted; the design continues on the server; the same command waits again"
            with working("design", stays, quiet=quiet) as update, suppress(_NobodyWorks):

                def look(now: SurrogateView) -> None:
                    nonlocal view
                    view = now
                    update(share_of_design(now), words_of_design(now))
                    if wait is None and now.phase not in COMPLETED and not _is_at_work(now):
                        raise _NobodyWorks

                view = wait_for_design(api, surrogate, wait or LONGEST_SECONDS, look)
        if view.model_version is None:
            raise CommandError(_words_without_model(view))
        if view.sessions:
            say(_words_of_sessions(view), quiet=quiet)
        if view.phase in ("over_budget", "unsure"):
            say(words_of_uncertainty(view), quiet=quiet)
        if view.phase == "unsure" and view.spec.needs_trials and view.budget_left:
            _import(settings, quiet=quiet)
            if words := _words_without_trials(view, settings):
                say(words, quiet=quiet)
        if view.phase not in COMPLETED and not view.paused:
            typer.echo(
                f"the design of {surrogate!r} continues; training starts with model {view.model_version}"
                f"{_words_of_too_early(api, view)}",
                err=True,
            )
        return view.spec, api.url


class _NobodyWorks(Exception):
    """Neither a sampler nor a fit is at work for an unfinished design."""


def _is_at_work(view: SurrogateView) -> bool:
    """Whether a sampler or a fit is at work for the design."""
    from surrogym_client.surrogates.waiting import ENDED, is_fitting

    return view.phase not in ENDED and not view.paused and (bool(view.samplers) or is_fitting(view))


def _words_without_trials(view: SurrogateView, settings: TrainSettings) -> str:
    """Return why no policy can try the original environment, with advice: the training's settings, or no sampler is
    running. Return an empty string if a policy can."""
    from surrogym_sampler.original.loading import sample_command
    from surrogym_trainer.training.search import name_of
    from surrogym_trainer.training.trials import allows_trials

    none = f"so no trials take the other {view.budget_left} real steps of the budget"
    if not allows_trials(view.spec, settings):
        return f"samplers can't run policies of {name_of(settings)}, {none}: for trials, train without --algorithm"
    if view.samplers:
        return ""
    start = sample_command(view.name, view.environment)
    return f"no sampler is running, {none}: for trials, start {start} in another terminal first"


def _words_of_too_early(api: Api, view: SurrogateView) -> str:
    """Return a hint that a training before the end of the design takes no trials, where only trials learn what good
    policies need; empty for other environments, and while the design only waits for a trial."""
    from surrogym_trainer.training.trials import is_waiting_for_trials

    if not view.spec.needs_trials or is_waiting_for_trials(api, view.name):
        return ""
    return " and takes no trials, which begin after the design: --wait 600 waits for its end"


def _words_without_model(view: SurrogateView) -> str:
    """Return the error message for a surrogate without a model, with advice: to wait, or how to get samples."""
    from surrogym_sampler.original.loading import sample_command

    missing = f"{view.name!r} has no model yet, its phase is {view.phase}"
    if _is_at_work(view):
        return f"{missing}: leave --wait out, and the training begins after the design"
    learn = f"surrogym import LOG --to {view.name}" if view.budget == 0 else sample_command(view.name, view.environment)
    return f"{missing}: run {learn}, or give --wait SECONDS"


@contextmanager
def _recording(path: Path | None, curve: list[CurvePoint], update: Update) -> Iterator[Record]:
    """Context that records a training's progress. Yields a function that shows the present progress, adds it as a point
    to ``curve``, and appends it as a line to the file ``path``, which other processes can watch."""
    from surrogym_shared.wire import CurvePoint
    from surrogym_trainer.training.settings import ProgressEstimate
    from surrogym_trainer.training.words import words_of

    started, estimate = time.monotonic(), ProgressEstimate()
    with path.open("a", encoding="utf-8") if path is not None else nullcontext() as file:

        def record(now: TrainProgress) -> None:
            seconds = round(time.monotonic() - started, 3)
            left = estimate.words_of_time_left(now.steps, now.total_steps, seconds)
            share = estimate.share(now.steps, now.total_steps) if now.total_steps else None
            update(share, f"{left}{words_of(asdict(now))}")
            if now.total_steps:
                curve.append(CurvePoint(steps=now.steps, imagined_return=now.imagined_return, seconds=seconds))
            if file is not None:
                file.write(json.dumps({**asdict(now), "seconds": seconds}) + "\n")
                file.flush()

        yield record


def _train(
    url: str,
    token: str | None,
    surrogate: str,
    out: Path,
    settings: TrainSettings,
    loop: LoopOptions,
    recording: Callable[[Update], AbstractContextManager[Record]],
    *,
    quiet: bool,
) -> tuple[TrainResult, Handover]:
    from surrogym_client.transport import Api, HttpSurrogate
    from surrogym_trainer.training.audited import AuditedTraining

    with (
        HttpSurrogate(url, surrogate, token) as port,
        Api(url, token) as api,
        progress("train", quiet=quiet) as update,
        recording(update) as record,
    ):
        update(None, "begins; the first process on a machine compiles for a minute")
        try:
            training = AuditedTraining(
                api,
                surrogate,
                port,
                out,
                settings,
                rounds=loop.settings(),
                audit=loop.audited(settings.seed),
                progress=record,
                waiting=_waiting(update),
                saying=partial(update, None),
            )
            return training.train()
        except ValueError as error:
            raise CommandError(str(error)) from error


def _waiting(update: Update) -> Callable[[SurrogateView], None]:
    """Return a function that shows what the training waits for while a sampler takes a round's real steps."""
    from surrogym_client.surrogates.waiting import words_of_waiting
    from surrogym_sampler.original.loading import sample_command

    return lambda view: update(None, words_of_waiting(view, sample_command(view.name, view.environment)))


def _write_card(
    made: Callable[[TrainResult, Handover | None], PolicyCard], result: TrainResult, handover: Handover | None = None
) -> dict[str, Any]:
    """Write the card that ``made`` makes beside its policy, and return the result as values that JSON can represent."""
    from surrogym_trainer.policies.card import write_card

    card = made(result, handover)
    write_card(Path(result.path), card)
    return {
        "policy": str(result.path),
        "lost_episodes": result.lost_episodes,
        **card.model_dump(mode="json", exclude={"spec", "curve"}),
    }
