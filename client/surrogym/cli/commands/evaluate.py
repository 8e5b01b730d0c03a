"""``surrogym evaluate``: measure a policy in the original environment, and film it with ``--video``."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from uuid import uuid4

import typer

from surrogym.cli.beside import Beside
from surrogym.cli.columns import columns
from surrogym.cli.disagreement import Differences, Imagining
from surrogym.cli.errors import CommandError, invalid, sentence
from surrogym.cli.groups import Output, PolicyReading, Service
from surrogym.cli.learning import kept
from surrogym.cli.opening import opener_for_policy
from surrogym.cli.options import NAMES, FallbackProgram, SpecFile, connect, push_or_say, read_spec
from surrogym_client.runtime.lifetime import terminations_as_interrupts
from surrogym_shared.environments import is_elsewhere
from surrogym_shared.terminal import give, progress, say
from surrogym_shared.words import counted

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from surrogym_sampler.original.episode import Episode
    from surrogym_shared.spec import EnvironmentSpec
    from surrogym_shared.terminal import Update
    from surrogym_shared.wire import Controller, LimitCounts
    from surrogym_trainer.evaluation.evaluator import Evaluation, EvaluationSettings, Progress
    from surrogym_trainer.policies.card import PolicyCard
    from surrogym_trainer.policies.evidence import Promise
    from surrogym_trainer.policies.predict import Acting

Environment = Annotated[
    str | None,
    typer.Option(
        help=f"Environment to evaluate in: {NAMES}. [default: the one that the policy was trained for, if its name can "
        "run no file of yours]"
    ),
]
Ledger = Annotated[
    str | None,
    typer.Option(help="Surrogate whose ledger counts the real steps. [default: as noted beside the policy]"),
]


SHOWN = ("first_seed", "wide", "start_scale", "perturb", "explore")  # settings that are part of the result as JSON


@dataclass(frozen=True)
class Episodes:
    """Options of the real episodes: how many, from which starts, in how many instances of the environment."""

    episodes: Annotated[int, typer.Option(min=1, help="Number of real episodes.")] = 100
    first_seed: Annotated[
        int, typer.Option(min=0, help="Reset seed of the first episode. Each further episode takes the next seed.")
    ] = 10_000
    wide: Annotated[bool, typer.Option("--wide", help="Start episodes anywhere in the sampling range.")] = False
    start_scale: Annotated[
        float, typer.Option(min=0, help="Factor by which to widen the declared starts about their middle.")
    ] = 1.0
    perturb: Annotated[
        float,
        typer.Option(
            min=0,
            help="Standard deviation of the random factors that multiply the masses of a MuJoCo model, or masses, "
            "lengths, forces and limits of a built-in classic task; 0 leaves them as they are. For a changed plant of "
            "your own, give its class as --env.",
        ),
    ] = 0.0
    explore: Annotated[
        float,
        typer.Option(
            min=0,
            max=1,
            help="Change the actions at random, for --learn-all: a continuous one by normal noise of EXPLORE times "
            "half its range, a discrete one with probability EXPLORE. The promise is then not judged.",
        ),
    ] = 0.0
    parallel: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of instances of the environment that are open at once. [default: 1, or one for each episode "
            "if the environment declares that it runs in parallel, as Gymnasium's do]",
        ),
    ] = None

    def settings(self) -> EvaluationSettings:
        """Return the settings of the evaluation.

        Raises:
            CommandError: two options contradict each other.
        """
        from surrogym_trainer.evaluation.evaluator import EvaluationSettings

        if self.wide and self.start_scale != 1:
            raise CommandError("expected --wide or --start-scale, got both; give one of the two")
        return EvaluationSettings(**vars(self))


@dataclass(frozen=True)
class Keeping:
    """Options for storing the results of an evaluation: a video beside the policy, and the episodes on the server."""

    video: Annotated[
        bool,
        typer.Option(
            "--video",
            help="Draw the best, the median and the worst episode into a video beside the policy, which the server "
            "stores too. The environment must be one that can be drawn. This takes no real step.",
        ),
    ] = False
    push: Annotated[
        bool, typer.Option("--push/--no-push", help="Store the policy and its episodes on the server as well.")
    ] = True


def command(
    context: typer.Context,
    policy: Annotated[
        Path, typer.Argument(help="Policy file from surrogym train or Stable-Baselines3, or an ONNX file.")
    ],
    env: Environment = None,
    spec: SpecFile = None,
    fallback: FallbackProgram = None,
    *,
    episodes: Episodes,
    reading: PolicyReading,
    differences: Differences,
    surrogate: Ledger = None,
    beside: Beside,
    keeping: Keeping,
    service: Service,
    output: Output,
) -> None:
    """Run real episodes with a policy, and report its returns.

    The command says beforehand how many real steps the episodes may take. They are reported to the server. It stores
    the policy and the episodes; if it does not answer, they wait beside the policy until surrogym policy push. If the
    mean return lies outside the promised interval, the command compares the steps with the model and shows the states
    at which the two disagree. With --learn, the model learns from these steps; with --learn-all, from every step.

    Example: surrogym evaluate policy.zip --env Pendulum-v1 --episodes 100

    Example: surrogym evaluate policy.zip --env Pendulum-v1 --episodes 10 --learn 16
    """
    from surrogym_trainer.evaluation.evaluator import for_set_points
    from surrogym_trainer.evaluation.reporting import is_promised
    from surrogym_trainer.policies.files import card_of_policy

    card, settings, token = card_of_policy(policy), episodes.settings(), service.token_for(context)
    differences.check(settings)
    beside.check(settings)
    opener = opener_for_policy(env, read_spec(spec), card, fallback, quiet=output.quiet)
    ledger = ledger_of(surrogate, service.server, card, policy, quiet=output.quiet)
    if learning := differences.learning(ledger, service.server, token, quiet=output.quiet):
        opener = learning.checked(opener)
    enter = partial(enter_steps, ledger, service.server, token, quiet=output.quiet)
    controllers = beside.controllers(policy, card, reading, opener)
    total = settings.episodes * len(controllers)
    announce = partial(_announce, episodes=total, environment=_named(env, card), quiet=output.quiet)
    run = partial(_run, opener=opener, settings=settings, enter=enter, quiet=output.quiet)
    reports = [
        (controller, for_set_points(found, card.spec, card.set_points))
        for controller, found in _reports(controllers, card.spec, run, announce, enter, settings, policy)
    ]
    result = reports[0][1]
    promise = card.promise if is_promised(settings, result, card.spec) else None
    if card.set_points and card.spec is None:
        promise = None
    expected = promise if _judges(len(result.returns)) else None
    elsewhere = _elsewhere(env, card, promise)
    with kept(learning, policy, result, quiet=output.quiet) as steps:
        if stored := keeping.push and ledger is not None:
            _keep(policy, reports, settings, _named(env, card), card.spec, quiet=output.quiet)
        filmed = film(policy, env, card, opener, result, settings, quiet=output.quiet) if keeping.video else None
        version = push_or_say(service.server, token, policy, ledger, quiet=output.quiet) if stored else None
        if env and not elsewhere and version and ledger:
            elsewhere = _elsewhere_by_server(service.server, token, ledger, version, env, promise)
        imagining = Imagining(partial(reading.load, policy, card), card, token)
        found = differences.between(
            ledger, service.server, token, result, settings, expected, steps, imagining, quiet=output.quiet
        )
    summary = {
        "policy": str(policy),
        "environment": _named(env, card),
        **{name: getattr(settings, name) for name in SHOWN},
        **_summary(reports, beside.reference),
    }
    summary |= {"promise_kept": None if elsewhere else _kept(expected, result)}
    summary |= {"version": version, "disagreements": found and found.as_json()}
    summary |= {} if filmed is None else {"video": str(filmed)}
    more = [*_aimed(card), *_planned_limits(card, result)]
    more += [] if result.limits is None else [result.limits.words()]
    if result.limits is not None and promise is not None and promise.fallback is not None and not elsewhere:
        more.append(result.limits.expected(promise.fallback.low, promise.fallback.high))
    more += [*elsewhere, *(found.in_words(card.spec) if found else [])]
    more += [*_why_not_judged(card, settings, result), *_unseeded(reports), *_repeated(result)]
    give(summary, lambda: "\n".join([_words(reports, None if elsewhere else promise), *more]), as_json=output.as_json)
    if steps is not None:
        steps.require_stored()
    if any(len(one.returns) < settings.episodes for _, one in reports):
        raise typer.Exit(1)  # too many episodes left a limit, so that the others were not begun


def _aimed(card: PolicyCard) -> list[str]:
    """Return a remark about the set points that the returns are for; empty if they are those of the specification."""
    from surrogym_trainer.policies.card import words_of_set_points

    if not (points := words_of_set_points(card.set_points)):
        return []
    if card.spec is None:
        return [
            f"returns are those that the environment pays, and the promise for the set point {points} is not judged: "
            "the policy's card has no specification by which to compute them"
        ]
    return [f"returns are for the set point {points}, by the declared reward of the policy's card"]


def _planned_limits(card: PolicyCard, result: Evaluation) -> list[str]:
    """Return how real episodes kept each limit that was given to a planner."""
    from surrogym_shared.limits import distances, limit_of

    if card.spec is None:
        return []
    lines = []
    for text in card.limits:
        try:
            keep = [limit_of(card.spec, text)]
        except ValueError as error:  # the card was changed
            lines.append(str(error))
            continue
        least = [float(distances(card.spec, keep, trace.coordinates).min()) for trace in result.traces]
        left, nearest = sum(one < 0 for one in least), min(least)
        lines.append(f"limit {text}: {left} of {counted(len(least), 'episode')} left it; least distance {nearest:.4g}")
    return lines


def _named(env: str | None, card: PolicyCard) -> str:
    """Return the name of the environment in which the episodes ran; empty if it is not known."""
    return env or (card.spec.environment if card.spec else "")


def _elsewhere(env: str | None, card: PolicyCard, promise: Promise | None) -> list[str]:
    """Return a remark if the episodes ran in another environment than the one that the policy was trained for, because
    they can't test the promised return then. Empty if it is the same environment, or if one of the two is unknown."""
    own = card.spec.environment if card.spec else ""
    return [_apart(env, own, promise)] if env is not None and is_elsewhere(env, own) else []


def _elsewhere_by_server(
    server: str | None, token: str | None, surrogate: str, version: int, env: str, promise: Promise | None
) -> list[str]:
    """Return the remark of :func:`_elsewhere` for a specification that names no environment, such as that of a log.
    The server then takes the environment of the surrogate's first evaluation for its own. The remark is empty if that
    is ``env``, or if the server can't be asked."""
    from surrogym_client.errors import SurrogymClientError

    try:
        with connect(server, token) as api:
            evaluations = api.policies.get(surrogate, version).evaluations
    except SurrogymClientError:
        return []
    latest = next((one for one in reversed(evaluations) if one.environment == env), None)
    if latest is None or latest.own:
        return []
    return [_apart(env, "the environment of the surrogate's first evaluation", promise)]


def _apart(env: str, own: str, promise: Promise | None) -> str:
    ran = f"these episodes ran in {env}"
    if promise is None:
        return f"{ran}, and the policy is for {own}: the server shows them apart"
    promised = f"the promise of {promise.low:.4g} to {promise.high:.4g} is for {own}"
    return f"{ran}, and {promised}: it is not judged, and the server shows them apart"


def _why_not_judged(card: PolicyCard, settings: EvaluationSettings, result: Evaluation) -> list[str]:
    """Return a remark why the episodes can't test the promised return: actions were changed at random, episodes had
    another time limit, or constants changed within an episode. Empty if they can, or if no return was promised."""
    from surrogym_trainer.evaluation.reporting import has_other_limit

    if settings.explore:
        return [f"actions were changed at random by {settings.explore:.2g}, so the promise is not judged"]
    if card.promise is None or not settings.declared:
        return []
    if card.spec is not None and has_other_limit(result, card.spec):
        return [
            f"the promise is not judged: it is for episodes of at most {card.spec.time_limit} steps, and these had at "
            f"most {result.limit}"
        ]
    if not result.varied:
        return []
    changed = ", ".join(result.varied)
    return [f"the promise is not judged: it is for episodes without a change of {changed}, which changed here"]


def _unseeded(reports: Sequence[tuple[Controller, Evaluation]]) -> list[str]:
    """Return a remark if the environment ignores the seed of a reset; empty if the same seed repeats the same start."""
    if all(result.seeded for _, result in reports):
        return []
    others = ", so these controllers did not run the same starts" if len(reports) > 1 else ""
    return [f"the environment ignores its seed: each evaluation has other starts{others}"]


def _repeated(result: Evaluation) -> list[str]:
    """Return a remark if all episodes are equal in every state, action and reward, so that one episode is enough. Empty
    if they differ, or if they are too few to tell."""
    from surrogym_trainer.evaluation.evaluator import FEW_EQUAL

    if len(result.returns) < FEW_EQUAL or not result.equal:
        return []
    return [
        f"all {len(result.returns)} episodes are equal in every number: nothing in them was random, so each shows the "
        f"same return, with {result.lengths[0]} real steps"
    ]


def _judges(episodes: int) -> bool:
    """Whether this number of episodes is enough to tell if the mean return reached the promised interval."""
    from surrogym_shared.wire import FEWEST_TO_JUDGE

    return episodes >= FEWEST_TO_JUDGE


def _summary(reports: Sequence[tuple[Controller, Evaluation]], reference: str | None) -> dict[str, Any]:
    """Return the policy's episodes as JSON, with those of the controllers of ``--compare`` and ``--reference``."""
    summary = reports[0][1].summary()
    for actions, other in reports[1:]:
        if actions == "reference":
            summary["reference"] = {"controller": reference, **other.summary()}
        else:
            summary["without"] = {"actions": actions, **other.summary()}
    return summary


def _reports(
    controllers: Mapping[Controller, Callable[[], Acting]],
    trained_for: EnvironmentSpec | None,
    run: Callable[..., Evaluation],
    announce: Callable[[EnvironmentSpec], None],
    enter: Callable[..., None],
    settings: EvaluationSettings,
    policy: Path,
) -> list[tuple[Controller, Evaluation]]:
    """Run the episodes of each controller, report their real steps, and return each controller with its result.

    Args:
        controllers: functions that load the controllers, by their kind.
        trained_for: specification that the policy was trained for.
        run: runs the episodes of one controller.
        announce: prints the number of real steps of all controllers, given the environment's specification.
        enter: reports real steps and episodes, with a note and counts of limits, to the server.
        settings: settings of the evaluation.
        policy: file of the policy.
    """
    from surrogym_trainer.evaluation.reporting import counts_of_limits

    reports: list[tuple[Controller, Evaluation]] = []
    for controller, load in controllers.items():
        actions = {"policy": "", "reference": "the reference controller"}.get(controller, f"{controller} actions")
        first = (trained_for, announce) if controller == "policy" else (None, None)
        result = run(load, *first, what=actions or str(policy))
        episodes = len(result.returns)  # fewer than asked for, if limits were left too often
        note = f"{counted(episodes, 'episode')} from seed {settings.first_seed}"
        enter(result.steps, episodes, f"{note}, {actions}" if actions else note, counts_of_limits(result.limits))
        reports.append((controller, result))
    return reports


def _keep(
    policy: Path,
    reports: Sequence[tuple[Controller, Evaluation]],
    settings: EvaluationSettings,
    environment: str,
    spec: EnvironmentSpec | None,
    *,
    quiet: bool,
) -> None:
    """Write the episodes to files beside the policy, from which they are sent to the server.

    Episodes that the server can't store, such as those with an infinite return, are left out, and a remark says so.
    """
    from pydantic import ValidationError

    from surrogym_trainer.evaluation.reporting import as_reported, paired_start
    from surrogym_trainer.policies.pushing import keep

    paired = paired_start(reports[0][1], min(len(result.returns) for _, result in reports))
    try:
        noted = [
            as_reported(
                result,
                settings,
                uuid4().hex,
                environment=environment,
                trained_for=spec,
                controller=controller,
                paired=paired,
            )
            for controller, result in reports
        ]
    except ValidationError as error:
        say(f"the server can't store the episodes: {invalid(error)}", quiet=quiet)
        return
    for one in noted:
        keep(policy, one)


def _announce(spec: EnvironmentSpec, *, episodes: int, environment: str, quiet: bool) -> None:
    """Print how many real episodes the evaluation takes in all, and at most how many real steps."""
    from surrogym_sampler.original.protocol import LONGEST_EPISODE

    most, count = episodes * (spec.time_limit or LONGEST_EPISODE), counted(episodes, "real episode")
    say(f"the evaluation takes {count} in {environment}: at most {most} real steps", quiet=quiet)


def _run(
    load: Callable[[], Acting],
    trained_for: EnvironmentSpec | None,
    announce: Callable[[EnvironmentSpec], None] | None,
    what: str,
    opener: Callable[[], Episode],
    settings: EvaluationSettings,
    enter: Callable[..., None],
    *,
    quiet: bool,
) -> Evaluation:
    """Run the episodes of one controller. If they fail or are interrupted, report the real steps taken so far."""
    from surrogym_sampler.original.errors import EvaluationFailed
    from surrogym_trainer.evaluation.evaluator import EvaluationInterrupted, evaluate
    from surrogym_trainer.evaluation.reporting import counts_of_limits

    def cut(ending: EvaluationFailed | EvaluationInterrupted, note: str) -> None:
        # With limits, the episodes so far are counted as well, because they may have left one.
        enter(ending.steps, ending.limits.episodes if ending.limits else 0, note, counts_of_limits(ending.limits))

    try:
        with terminations_as_interrupts(), progress("evaluate", quiet=quiet) as update:
            update(0.0, f"reading {what}")
            tell = _telling(update, settings.episodes)
            remark = partial(say, quiet=quiet)
            return evaluate(load(), opener, settings, tell, remark, trained_for, announce)
    except EvaluationFailed as failure:
        cut(failure, "failed")
        raise
    except EvaluationInterrupted as interruption:
        say(
            f"interrupted after {interruption.steps} real steps; no result was kept; the same command starts from the "
            "beginning"
        )
        cut(interruption, "interrupted")
        raise


def _telling(update: Update, episodes: int) -> Progress:
    return lambda share, terminated: update(share, f"{counted(episodes, 'real episode')}, {terminated} terminated")


def ledger_of(surrogate: str | None, server: str | None, card: PolicyCard, policy: Path, *, quiet: bool) -> str | None:
    """Return the name of the surrogate to which the real steps are reported; None if no server may be contacted.

    An address that only the policy's card names is never contacted, unless it is this machine's default address.
    """
    from surrogym_client.transport.connection import DEFAULT_URL
    from surrogym_trainer.policies.card import card_path

    if surrogate or server or card.server is None or str(card.server).rstrip("/") == DEFAULT_URL:
        return surrogate or card.surrogate
    say(
        f"the real steps are not reported to {str(card.server)!r}, which {card_path(policy)} names: give --server to "
        f"enter them into the ledger of {card.surrogate!r}",
        quiet=quiet,
    )
    return None


def enter_steps(
    surrogate: str | None,
    server: str | None,
    token: str | None,
    steps: int,
    episodes: int,
    note: str,
    limits: LimitCounts | None = None,
    *,
    quiet: bool,
) -> None:
    """Report real steps to the server, as steps of a surrogate. If the server does not answer, only print a remark."""
    from surrogym_client.errors import SurrogymClientError

    if surrogate is None or steps == 0:
        return
    try:
        with connect(server, token) as api:
            api.report_steps(surrogate, steps, episodes=episodes, note=note, limits=limits)
    except SurrogymClientError as error:
        say(f"not entered into the ledger of {surrogate!r}: {sentence(error)}", quiet=quiet)


def _kept(promise: Promise | None, result: Evaluation) -> bool | None:
    """Whether the policy kept its promise: its mean return is at least the lower end of the promised interval (the 5 %
    quantile). None without a promise."""
    return None if promise is None else bool(result.returns.mean() >= promise.low)


def _words(reports: Sequence[tuple[Controller, Evaluation]], promise: Promise | None) -> str:
    from surrogym_shared.wire import FEWEST_TO_JUDGE

    names = ("mean", "iqm", "min", "max", "std", "mean_length", "success_rate", "episodes", "steps")
    several = len(reports) > 1
    rows = [
        ([controller] if several else []) + [result.summary()[name] for name in names] for controller, result in reports
    ]
    table = columns([[*(["actions of"] if several else []), *names], *rows])
    if promise is None:
        return table
    episodes = len(reports[0][1].returns)
    if not _judges(episodes):
        few = f"{counted(episodes, 'episode')} {'is' if episodes == 1 else 'are'} too few"
        return f"{table}\n{few} to judge the promise: take {FEWEST_TO_JUDGE} or more"
    kept = "kept: the mean return is at least" if _kept(promise, reports[0][1]) else "broken: the mean return is below"
    return f"{table}\nthe promise of {promise.low:.4g} to {promise.high:.4g} was {kept} its lower end"


def film(
    policy: Path,
    env: str | None,
    card: PolicyCard,
    opener: Callable[[], Episode],
    result: Evaluation,
    settings: EvaluationSettings,
    *,
    quiet: bool,
) -> Path | None:
    """Write a video of the best, median and worst episode beside the policy, and return its path.

    An older video is replaced. If no video can be made, the reason is printed, and the result is None, because a video
    must not spoil an evaluation.
    """
    from surrogym_client.environments.pictures import NotRenderable
    from surrogym_trainer.evaluation.reporting import words_of
    from surrogym_trainer.evaluation.videos import FORMS, record

    try:
        spec = _spec(env, card, opener)
        with progress("video", quiet=quiet) as update:
            update(None, "drawing the best, the median and the worst episode")
            video = record(spec, env or spec.environment, result, words_of(settings))
    except NotRenderable as error:
        say(f"no video: {error}", quiet=quiet)
        return None
    except Exception as error:  # a user's environment may raise any exception
        say(f"no video: {type(error).__name__}: {error}", quiet=quiet)
        return None
    for form in FORMS:
        policy.with_suffix(f".{form}").unlink(missing_ok=True)
    path = policy.with_suffix(f".{video.form}")
    path.write_bytes(video.content)
    say(f"video written to {path} ({len(video.content) / 1000:.0f} kB)", quiet=quiet)
    return path


def _spec(env: str | None, card: PolicyCard, opener: Callable[[], Episode]) -> EnvironmentSpec:
    """Return the specification of the environment to draw. The environment is opened to get it, unless it is a user's
    own environment, which may be a machine, and the policy's card contains a specification."""
    from surrogym_sampler.original.loading import is_own

    if env is not None and is_own(env) and card.spec is not None:
        return card.spec
    episode = opener()
    try:
        return episode.spec
    finally:
        episode.close()
