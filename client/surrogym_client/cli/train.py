"""``surrogym train``: learn a policy against a surrogate."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from surrogym_client.cli.groups import Output, Service, add
from surrogym_client.cli.options import (
    ExitWithParent,
    Surrogate,
    Wait,
    awaited_surrogate,
    connect,
    given_here,
    require_known,
    typed,
)

if TYPE_CHECKING:
    from surrogym_client.training import TrainProgress, TrainResult, TrainSettings
    from surrogym_client.training.closed_loop import LoopSettings
    from surrogym_client.training.handover import AuditSettings, Handover
    from surrogym_shared.spec import EnvironmentSpec
    from surrogym_shared.terminal import Update
    from surrogym_shared.wire import SurrogateView

    Record = Callable[[TrainProgress], None]

Variant = Literal["deterministic", "probabilistic", "pathwise"]
Propagation = Literal["mean", "sample"]
Weighting = Literal["inverse_variance", "uniform"]
Log = Literal["tensorboard", "wandb", "mlflow", "none"]

NOTHING_YET = "interrupted before there was a policy; nothing was saved, and the same command begins anew"


@dataclass(frozen=True)
class SearchOptions:
    """How to search, for how long."""

    algorithm: Annotated[
        str,
        typer.Option(
            help="Search by ppo, a2c, sac, td3, ddpg, dqn (Stable-Baselines3), fastppo (the same PPO in NumPy), cmaes, "
            "gradient, or a package's own."
        ),
    ] = "PPO"
    steps: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Virtual steps, those of all rounds of --improve included; seeing where a round's policy goes comes "
            "on top. [default: from the algorithm]",
        ),
    ] = None
    num_envs: Annotated[
        int | None, typer.Option(min=1, help="Lanes of the session. [default: from the specification]")
    ] = None
    chosen: Annotated[
        list[str] | None,
        typer.Option("--set", help="A hyperparameter of the algorithm as NAME=VALUE; may be given several times."),
    ] = None
    seed: Annotated[int, typer.Option(min=0, help="Seed of policy and virtual environment.")] = 0

    def hyperparameters(self) -> dict[str, Any]:
        """What ``--set`` was given: values are JSON, or text where they are none."""
        from surrogym_client.cli.errors import CommandError

        found: dict[str, Any] = {}
        for pair in self.chosen or []:
            name, equals, value = pair.partition("=")
            if not (name and equals):
                raise CommandError(f"--set: expected NAME=VALUE, got {pair!r}")
            try:
                found[name] = json.loads(value)
            except ValueError:
                found[name] = value
        return found


@dataclass(frozen=True)
class SessionOptions:
    """How the state moves in the session that the policy learns in; each is a field of ``OpenSession``."""

    variant: Annotated[
        Variant | None,
        typer.Option(
            help="The state moves by the mean, as particles, or along a drawn function. [default: the mean. If the "
            "design is not ready, the final training draws from the posterior]"
        ),
    ] = None
    particles: Annotated[int | None, typer.Option(min=1, help="Particles of variant probabilistic.")] = None
    propagation: Annotated[
        Propagation | None, typer.Option(help="How a particle moves: by the mean or by a draw. [default: sample]")
    ] = None
    weighting: Annotated[
        Weighting | None, typer.Option(help="Of the particles' rewards. [default: inverse_variance]")
    ] = None
    spread: Annotated[
        float | None, typer.Option(help="First deviation of particles, as a share of the range. [default: 0.01]")
    ] = None
    process_noise: Annotated[
        bool,
        typer.Option(
            "--process-noise",
            help="Let the learned noise move the state. [default: where repeated real steps confirm noise]",
            show_default=False,
        ),
    ] = False
    trust: Annotated[
        float | None,
        typer.Option(
            help="End an episode where an output's predicted deviation is more than TRUST times its deviation in the "
            "samples. [default: none]"
        ),
    ] = None
    penalty: Annotated[
        float | None, typer.Option(min=0, help="Deviations taken off the reward. [default: the specification's]")
    ] = None

    def fields(self) -> dict[str, Any]:
        """The fields that were given a value. Raises ``CommandError`` where they contradict each other."""
        from surrogym_client.cli.errors import CommandError
        from surrogym_shared.wire import OF_PARTICLES

        given = {name: value for name, value in vars(self).items() if value is not None and value is not False}
        for name in OF_PARTICLES:
            if name in given and self.variant != "probabilistic":
                raise CommandError(f"--{name} is variant probabilistic's: give --variant probabilistic with it")
        return given


@dataclass(frozen=True)
class StartOptions:
    """Where episodes and the policy start, and how long a training may go on."""

    start_box: Annotated[
        float | None,
        typer.Option(
            min=0,
            max=1,
            help="Share of episodes that start anywhere in the sampling range. [default: 0.5; 0 with a log alone]",
        ),
    ] = None
    start_from: Annotated[Path | None, typer.Option(help="Policy file to go on from.")] = None
    trust_policy: Annotated[
        bool,
        typer.Option(
            "--trust-policy",
            help="Unpickle the objects of --start-from. This runs any code in the file. Policies of surrogym train "
            "don't need it.",
        ),
    ] = False
    prolong: Annotated[
        bool | None,
        typer.Option(
            "--prolong/--no-prolong",
            help="As many virtual steps again, once, where the imagined return still rises at the end. Not with cmaes "
            "or gradient. [default: where --steps is not given]",
            show_default=False,
        ),
    ] = None


@dataclass(frozen=True)
class LoopOptions:
    """The closed loop: real steps between trainings."""

    improve: Annotated[
        int,
        typer.Option(
            min=0,
            help="More real queries in each round, where the policy goes, until that is known or the design ready. A "
            "sampler has to be running, and the budget has to hold them; an admin's token raises it.",
        ),
    ] = 0
    rounds: Annotated[int, typer.Option(min=1, help="Rounds of --improve, at most.")] = 3
    audit: Annotated[
        bool,
        typer.Option(
            "--audit/--no-audit",
            help="Compare the model with a few real steps on the policy's way, beyond the budget, before the policy is "
            "handed over. A sampler has to be running; without one the card says that there was no audit.",
        ),
    ] = True
    audit_steps: Annotated[int, typer.Option(min=2, max=256, help="Real steps of an audit.")] = 8

    def settings(self) -> LoopSettings | None:
        from surrogym_client.training.closed_loop import LoopSettings

        return LoopSettings(self.improve, self.rounds) if self.improve else None

    def audited(self, seed: int) -> AuditSettings | None:
        from surrogym_client.training.handover import AuditSettings

        return AuditSettings(steps=self.audit_steps, seed=seed) if self.audit else None


@dataclass(frozen=True)
class LogOptions:
    """Where the curves of a training go."""

    log: Annotated[Log, typer.Option(help="Where the curves of the training go.")] = "tensorboard"
    tensorboard: Annotated[
        Path | None, typer.Option(help="Folder for TensorBoard. [default: tensorboard beside the policy]")
    ] = None
    progress_file: Annotated[Path | None, typer.Option(hidden=True, help="Write progress as JSON lines.")] = None


def register(app: typer.Typer) -> None:
    """Add the command."""
    add(app, "train", command)


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
    wait: Wait = 0.0,
    exit_with_parent: ExitWithParent = False,
    service: Service,
    output: Output,
) -> None:
    """Train a policy in the virtual environment. A running sampler takes the few real steps of its audit.

    No other real step is taken, unless --improve asks for more.

    The imagined return that is shown is what the policy earns in the surrogate, not in the original environment.

    Example: surrogym train pendulum --out policy.zip --seed 0
    """
    from surrogym_client.runtime.lifetime import exit_with_parent as watch_parent
    from surrogym_client.surrogates.budget import words_of_rounds
    from surrogym_client.training.words import words_of_result
    from surrogym_shared.terminal import say

    if exit_with_parent:
        watch_parent()
    settings = _settings(search, session, start, log)
    token = service.token_for(context)
    spec, url = _trainable(surrogate, service.server, token, wait, search.algorithm, quiet=output.quiet)
    if loop.improve:
        with connect(service.server, token) as api:
            say(words_of_rounds(api, surrogate, loop.improve, loop.rounds), quiet=output.quiet)
    _import(search.algorithm, quiet=output.quiet)
    card = partial(_write_card, surrogate=surrogate, spec=spec, url=url, seed=search.seed)
    with _keeping(card, typed(context, without=("out", "start_from", "trust_policy", "token"))):
        result, handover = _train(url, token, surrogate, out, settings, loop, log.progress_file, quiet=output.quiet)
    summary = card(result, handover)
    named = service.server if given_here(context, "server") else None
    output.give(summary, lambda: words_of_result(result, handover, closed_loop=loop.improve > 0, server=named))


def _settings(search: SearchOptions, session: SessionOptions, start: StartOptions, log: LogOptions) -> TrainSettings:
    """The settings of the training; everything that needs no server is refused here."""
    from surrogym_client.cli.errors import CommandError
    from surrogym_client.training import TrainSettings

    given = session.fields()
    if start.start_from is not None and not start.start_from.exists():
        raise CommandError(f"{start.start_from}: no such policy file")
    hyperparameters = search.hyperparameters()
    require_known(search.algorithm)
    return TrainSettings(
        algorithm=search.algorithm,
        total_steps=search.steps,
        num_envs=search.num_envs,
        seed=search.seed,
        tracker=None if log.log == "none" else log.log,
        tensorboard=log.tensorboard,
        hyperparameters=hyperparameters,
        session=given,
        **vars(start),
    )


def _import(algorithm: str, *, quiet: bool) -> None:
    """Import what the search works with, once there is something to train on; a person sees what takes the time."""
    from surrogym_client.training.search import SEARCHES
    from surrogym_shared.terminal import on_interrupt, progress

    with on_interrupt(lambda: NOTHING_YET), progress("prepare", quiet=quiet) as update:
        update(None, f"importing what {algorithm} needs")
        SEARCHES.get(algorithm)


@contextmanager
def _keeping(write_card: Callable[[TrainResult], object], asked: str) -> Iterator[None]:
    """Say after Ctrl-C what there is to go on with; a policy that was saved gets its card."""
    from surrogym_client.training.settings import TrainingInterrupted
    from surrogym_client.training.words import words_of_interruption
    from surrogym_shared.terminal import say

    try:
        yield
    except TrainingInterrupted as interruption:
        result = interruption.result
        write_card(result)
        say(words_of_interruption(result, asked))
        raise
    except KeyboardInterrupt:
        say(NOTHING_YET)
        raise


def _trainable(
    surrogate: str, server: str | None, token: str | None, wait: float, algorithm: str, *, quiet: bool
) -> tuple[EnvironmentSpec, str]:
    """Specification and server of a surrogate whose design is done; with ``wait``, the search is imported meanwhile."""
    from surrogym_client.cli.errors import CommandError
    from surrogym_client.surrogates.phases import COMPLETED
    from surrogym_client.surrogates.waiting import (
        share_of_design,
        wait_for_design,
        words_of_design,
    )
    from surrogym_client.training.search import SEARCHES
    from surrogym_shared.terminal import on_interrupt, progress

    with connect(server, token, wait, quiet=quiet) as api:
        view = awaited_surrogate(api, surrogate, wait, quiet=quiet)
        if wait > 0:
            SEARCHES.get(algorithm)

            stays = "interrupted while the design goes on at the server; the same command waits again"
            with on_interrupt(lambda: stays), progress("design", quiet=quiet) as update:
                view = wait_for_design(
                    api, surrogate, wait, lambda view: update(share_of_design(view), words_of_design(view))
                )
        if view.model_version is None:
            learn = "surrogym import LOG --to" if view.budget == 0 else "surrogym sample"
            raise CommandError(
                f"{surrogate!r} has no model yet, its phase is {view.phase}: "
                f"run {learn} {surrogate}, or give --wait SECONDS"
            )
        if view.phase not in COMPLETED and not view.paused:
            typer.echo(f"the design of {surrogate!r} goes on; training starts on model {view.model_version}", err=True)
        return view.spec, api.url


@contextmanager
def _recording(path: Path | None, update: Update) -> Iterator[Record]:
    """Shows progress, and writes it to a file for those who watch from outside."""
    from surrogym_client.training.words import words_of

    started = time.monotonic()
    with path.open("a", encoding="utf-8") if path is not None else nullcontext() as file:

        def record(now: TrainProgress) -> None:
            seconds = round(time.monotonic() - started, 3)
            update(now.steps / now.total_steps, words_of(asdict(now)))
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
    progress_file: Path | None,
    *,
    quiet: bool,
) -> tuple[TrainResult, Handover]:
    from surrogym_client.cli.errors import CommandError
    from surrogym_client.training.audited import AuditedTraining
    from surrogym_client.transport import Api, HttpSurrogate
    from surrogym_shared.terminal import progress

    with (
        HttpSurrogate(url, surrogate, token) as port,
        Api(url, token) as api,
        progress("train", quiet=quiet) as update,
        _recording(progress_file, update) as record,
    ):
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
            )
            return training.train()
        except ValueError as error:
            raise CommandError(str(error)) from error


def _waiting(update: Update) -> Callable[[SurrogateView], None]:
    """Shows a round's real steps while a sampler takes them; the bar stays where the training left it."""
    from surrogym_client.surrogates.waiting import words_of_design

    return lambda view: update(None, f"waiting for a sampler (surrogym sample {view.name}): {words_of_design(view)}")


def _write_card(
    result: TrainResult,
    handover: Handover | None = None,
    *,
    surrogate: str,
    spec: EnvironmentSpec,
    url: str,
    seed: int,
) -> dict[str, Any]:
    """Write the policy's card; gives back the result as JSON."""
    from surrogym_client.policies.card import NotedAddress, PolicyCard, write_card
    from surrogym_client.runtime.versions import versions

    card = PolicyCard(
        algorithm=result.algorithm,
        surrogate=surrogate,
        server=NotedAddress(url),
        spec=spec,
        seed=seed,
        virtual_steps=result.virtual_steps,
        seconds=result.seconds,
        imagined_return=result.imagined_return,
        visited_confidence=result.visited_confidence,
        networks=result.networks,
        untrained=result.untrained,
        **({} if handover is None else vars(handover)),
        settings=result.settings,
        versions=versions(),
    )
    write_card(Path(result.path), card)
    return {
        "policy": str(result.path),
        "lost_episodes": result.lost_episodes,
        **card.model_dump(mode="json", exclude={"spec"}),
    }
