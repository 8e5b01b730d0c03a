"""``surrogym audit``: compare a few real steps, in states that a policy visits, with the model."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from surrogym.cli.errors import CommandError
from surrogym.cli.groups import Output, PolicyReading, Service
from surrogym.cli.opening import opener_for_policy
from surrogym.cli.options import FallbackProgram, SpecFile, first_model, push_or_say, read_spec
from surrogym_shared.environments import is_elsewhere
from surrogym_shared.terminal import progress, say
from surrogym_shared.words import counted

if TYPE_CHECKING:
    from surrogym_sampler.original.episode import Episode
    from surrogym_shared.port import SurrogatePort
    from surrogym_shared.spec import EnvironmentSpec
    from surrogym_shared.wire import SurrogateView
    from surrogym_trainer.evaluation.evaluator import EvaluationSettings
    from surrogym_trainer.policies.card import PolicyCard
    from surrogym_trainer.policies.predict import Acting, Predict
    from surrogym_trainer.training.handover import Handover, Subject


def command(
    context: typer.Context,
    policy: Annotated[Path, typer.Argument(help="Policy file from surrogym train.")],
    surrogate: Annotated[
        str | None, typer.Option(help="Surrogate that the policy was trained on. [default: as noted beside the policy]")
    ] = None,
    steps: Annotated[
        int,
        typer.Option(
            min=2,
            max=256,
            help="Number of real steps to begin with; as many again follow, up to 40 in all, while they leave the "
            "promise undecided. An environment that can only be reset takes at least as many, in rollouts. They don't "
            "count towards the budget.",
        ),
    ] = 8,
    env: Annotated[
        str | None,
        typer.Option(
            help="Original environment in which to take whole episodes of the policy, in place of a sampler's single "
            "steps. This tests all that the policy does where the environment can only be reset."
        ),
    ] = None,
    spec: SpecFile = None,
    fallback: FallbackProgram = None,
    episodes: Annotated[int, typer.Option(min=1, max=100, help="Number of whole episodes, with --env.")] = 3,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of starts, of sampled functions, and of the places to audit.")
    ] = 0,
    *,
    reading: PolicyReading,
    service: Service,
    output: Output,
) -> None:
    """Test a policy's promised return with a few real steps.

    Most real steps are taken at states that the policy visits; all are compared with the model. This needs a running
    sampler. With --env, the real steps are whole episodes, whose returns are compared with the promised return too;
    the command says beforehand how many steps they may take. The promised return, the audit and the verdict (trusted or
    not) go into the card beside the policy, unless --env is not the policy's own environment. With --surrogate, the
    card names that surrogate from then on.

    Example: surrogym audit policy.zip --steps 16

    Example: surrogym audit policy.zip --env rig:Rig --episodes 3
    """
    from surrogym_client.surrogates.waiting import words_of_audit
    from surrogym_client.transport import HttpSurrogate
    from surrogym_trainer.evaluation.evaluator import EvaluationSettings
    from surrogym_trainer.policies.card import read_card, write_card
    from surrogym_trainer.policies.integrals import with_integrals
    from surrogym_trainer.training.cards import session_of
    from surrogym_trainer.training.handover import AuditSettings, Subject, hand_over
    from surrogym_trainer.training.words import words_of_handover

    card = read_card(policy)
    name = surrogate or card.surrogate
    if name is None:
        raise CommandError(f"expected --surrogate NAME, because no card beside {policy} names a surrogate")
    predict, asked = reading.load(policy, card), AuditSettings(steps=steps, seed=seed)
    with service.connect(context) as api:
        view = first_model(api, name, quiet=output.quiet)
    with (
        service.connect(context) as api,
        HttpSurrogate(api.url, name, service.token_for(context)) as http,
        progress("audit", quiet=output.quiet) as update,
    ):
        if card.surrogate not in (None, name):
            card = _of_another(card)
        port = with_integrals(http, card.integral, card.set_points)
        _require_fit(predict, port.spec(), f"{policy} does not fit {name!r}")
        session = session_of(card, view)
        floor = _floor(port, seed, session) if card.untrained is None else card.untrained
        subject = Subject(api, name, port, predict, session, floor, seed, saying=partial(update, None))
        if env is None:
            found = hand_over(subject, asked, lambda view: update(None, words_of_audit(view)))
        else:
            opener = opener_for_policy(env, read_spec(spec), card, fallback, quiet=output.quiet)
            found = by_episodes(subject, env, opener, EvaluationSettings(episodes, seed), quiet=output.quiet)
    if found.audit is None:
        raise CommandError(_not_made(view, found.reason))
    noted = card.model_copy(update={"surrogate": name, "spec": card.spec or view.spec, **vars(found)})
    if is_elsewhere(env, view.spec.environment):
        result = _result(policy, noted, found, None)
        remark = f"this audit ran in {env}, and the policy is for {view.spec.environment}: its card is unchanged"
        output.give(result, lambda: f"{words_of_handover(found)}\n{remark}")
        return
    write_card(policy, noted)
    version = push_or_say(service.server, service.token_for(context), policy, name, quiet=output.quiet)
    output.give(_result(policy, noted, found, version), lambda: words_of_handover(found))


def _result(policy: Path, noted: PolicyCard, found: Handover, version: int | None) -> dict[str, Any]:
    """Return the result of an audit as JSON: the entries of the card that it gives, and the version of the policy on
    the server."""
    return {"policy": str(policy), **noted.model_dump(mode="json", include=set(vars(found))), "version": version}


def by_episodes(
    subject: Subject, env: str, opener: Callable[[], Episode], settings: EvaluationSettings, *, quiet: bool
) -> Handover:
    """Audit a policy by whole episodes in an environment. The largest number of real steps is printed before the first
    episode. The steps taken are reported to the server, even after an error."""
    from surrogym_sampler.original.errors import EvaluationFailed
    from surrogym_sampler.original.protocol import LONGEST_EPISODE
    from surrogym_trainer.evaluation.evaluator import EvaluationInterrupted, evaluate
    from surrogym_trainer.evaluation.reporting import counts_of_limits
    from surrogym_trainer.policies.integrals import IntegralPort
    from surrogym_trainer.training.handover import judge_episodes

    acting: Acting = subject.predict
    spec = subject.port.spec()
    if isinstance(subject.port, IntegralPort):
        acting, spec = subject.port.acting(subject.predict), subject.port.port.spec()
    if subject.api.surrogate(subject.name).fidelity is None:
        raise CommandError(f"{subject.name!r} has no model yet: wait until a sampler has answered its first queries")
    most = settings.episodes * (spec.time_limit or LONGEST_EPISODE)
    count = counted(settings.episodes, "whole episode")
    say(f"the audit takes {count} in {env}: at most {most} real steps", quiet=quiet)
    note, taken, episodes, kept = f"audit, {count} from seed {settings.first_seed}", 0, 0, None
    try:
        result = evaluate(acting, opener, settings, trained_for=spec)
        taken, episodes, kept = result.steps, len(result.returns), counts_of_limits(result.limits)
    except (EvaluationFailed, EvaluationInterrupted) as error:
        taken = error.steps
        raise
    finally:
        if taken:
            subject.api.report_steps(subject.name, taken, episodes=episodes, note=note, limits=kept)
    return judge_episodes(subject, result)


def _not_made(view: SurrogateView, reason: str) -> str:
    """Return the error message that no audit of a surrogate was made, with the reason and the next command."""
    from surrogym_sampler.original.loading import sample_command
    from surrogym_trainer.training.handover import NO_SAMPLER

    start = f"; start {sample_command(view.name, view.environment)} in another terminal"
    return f"no audit was made, and the card is unchanged: {reason}{start if reason.endswith(NO_SAMPLER) else ''}"


def _require_fit(predict: Predict, spec: EnvironmentSpec, misfit: str) -> None:
    """Raise ``CommandError`` if a policy network has other observations or actions than the surrogate. The message
    begins with ``misfit``."""
    from surrogym_shared.network import Network

    if isinstance(predict, Network):
        try:
            predict.require_fit(len(spec.observation), spec.action)
        except ValueError as error:
            raise CommandError(f"{misfit}: {error}") from error


def _of_another(card: PolicyCard) -> PolicyCard:
    """Return a policy's card for an audit on another surrogate than the one of its training: without the fields that
    hold only for the surrogate of its training, such as the imagined return. It keeps its set points and integrals."""
    empty = {"server": None, "spec": None, "imagined_return": None, "untrained": None, "visited_confidence": ()}
    kept = {"session": {"set_points": card.set_points}, "integral": card.integral}
    return card.model_copy(update={**empty, "settings": kept})


def _floor(port: SurrogatePort, seed: int, session: dict[str, object]) -> float:
    """Return the mean imagined return without a policy: with an action of zero, or with random actions. The promised
    return is compared with it if the card does not contain the return of an untrained policy."""
    from surrogym_trainer.evaluation.baselines import baseline, default_baseline
    from surrogym_trainer.evaluation.imagined import imagined_returns
    from surrogym_trainer.training.settings import CHECK_EPISODES

    spec = port.spec()
    predict = baseline(spec, default_baseline(spec), seed)
    return float(imagined_returns(port, predict, CHECK_EPISODES, seed, **session).mean())
