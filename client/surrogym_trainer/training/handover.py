"""The handover of a policy: its promise, its audit, and the decision whether the promise is trusted."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surrogym_client.environments.lanes import Lanes, session_request
from surrogym_client.errors import BeyondBudget
from surrogym_client.surrogates.waiting import COMPLETED, NobodyAnswers, wait_for_answers, wait_for_design
from surrogym_client.transport.api import Api
from surrogym_sampler.original.actions import decode_actions
from surrogym_sampler.original.protocol import LONGEST_EPISODE
from surrogym_shared.network import Network
from surrogym_shared.periods import irregular
from surrogym_shared.port import SurrogatePort
from surrogym_shared.spec import LONGEST_ROLLOUT, EnvironmentSpec
from surrogym_shared.starts import not_declared
from surrogym_shared.states import LEAST_AUDITED
from surrogym_shared.wire import QueryView, SampleView, SurrogateView
from surrogym_shared.wire.queries import MAX_POLICY
from surrogym_shared.words import counted
from surrogym_shared.wrapping import Step, undeclared_turns
from surrogym_trainer.evaluation.audit import (
    AUDIT_STEPS,
    MOST_STEPS,
    MOST_UNTESTED,
    SLACK,
    Compared,
    Consequence,
    earned,
    gaps,
    judge,
    missed,
    places,
    unanswered,
    untested,
    wider,
)
from surrogym_trainer.evaluation.baselines import baseline
from surrogym_trainer.evaluation.comparing import DRAWS, changes_of, compared, steady, steps_of
from surrogym_trainer.evaluation.evaluator import Evaluation, for_set_points
from surrogym_trainer.evaluation.imagined import WHOLE
from surrogym_trainer.evaluation.out_of_distribution import Outside, outside_of, range_left, untestable
from surrogym_trainer.evaluation.promise import UNNOTICED, promise_of
from surrogym_trainer.evaluation.systematic import Inputs
from surrogym_trainer.policies.evidence import Audit, Promise
from surrogym_trainer.policies.predict import Predict
from surrogym_trainer.training.trials import encoded

MOST_AUDITS = 3  # largest number of audits in one training
ROLLOUTS = 1, 2, 4, 8  # numbers of rollouts that an audit chooses from if the environment can't be set to states
WAY_LANES = 16  # an audit takes real steps at states from this number of virtual episodes of the policy
# at most this number of steps of each virtual episode is compared with the log from which the model was learned
MOST_OF_A_WAY = 200
# If the model is ready, one of this many steps of an audit is in a gap between the samples, not on the policy's way.
ELSEWHERE = 4
# the states of an audit in gaps between the samples are chosen from this number of points of the sampling range
ANYWHERE = 1_024
# a promised interval of the return is not trusted if its lower half is wider than this share of the policy's gain over
# an untrained policy
WIDE = 0.5
NO_SAMPLER = "no sampler is connected"
PROMISING = "computes the promise by whole virtual episodes"
COMPARING = "computes by virtual episodes how the errors that the audit found change the return"

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Handover:
    """A policy's promise, with the evidence for it.

    Attributes:
        promise: promise of the latest model; None if the policy visits states where the log has no data.
        audit: audit of the policy; None if there was none.
        trusted: whether the promise is trusted.
        reason: why it is trusted or not, in one sentence.
        model: hash of the samples from which the promise's model was learned.
    """

    promise: Promise | None
    audit: Audit | None
    trusted: bool
    reason: str
    model: str = ""


@dataclass(frozen=True)
class AuditSettings:
    """The settings of an audit: number of real steps, patience and seed."""

    steps: int = AUDIT_STEPS
    patience_seconds: float = 3_600.0  # longest time in seconds to wait for the sampler's answers
    seed: int = 0


@dataclass(frozen=True)
class Subject:
    """A policy to hand over, with the session options and the seed that it was trained with."""

    api: Api
    name: str  # name of the surrogate
    port: SurrogatePort
    predict: Predict
    # fields of OpenSession, the options of a session, that the policy was trained with
    session: dict[str, Any] = field(default_factory=dict)
    floor: float | None = None  # imagined return of an untrained policy
    seed: int = 0
    plans: bool = False  # whether the policy is the planner of the latest model, which samplers can make
    # called with a few words before virtual episodes, which may take minutes
    saying: Callable[[str], None] = lambda _: None

    def promise(self) -> Promise:
        """Compute the policy's promise in the latest model."""
        return promise_of(self.port, self.counting(PROMISING), self.seed, self.session, self.floor)

    def counting(self, words: str, episodes: int = 1) -> Predict:
        """Say ``words``, and return a policy that counts its steps. With each per cent of so many episodes, one after
        the other, it says ``words`` again with the share. A network acts at the server, where nothing is counted, and
        takes seconds; a planner takes minutes."""
        self.saying(words)
        if isinstance(self.predict, Network):
            return self.predict
        limit, calls = episodes * (self.port.spec().time_limit or LONGEST_EPISODE), itertools.count(1)

        def act(observations: NDArray[np.floating[Any]]) -> NDArray[Any]:
            now = next(calls)
            if 100 * now // limit > 100 * (now - 1) // limit:
                self.saying(f"{words}: {min(100 * now // limit, 100)} %")
            return self.predict(observations)

        return act


def hand_over(
    subject: Subject, audit: AuditSettings | None, progress: Callable[[SurrogateView], None] | None = None
) -> Handover:
    """Compute the promise of a policy, audit it if a sampler is connected, and decide whether to trust it.

    Args:
        subject: the policy.
        audit: settings of the audit; None takes no audit.
        progress: called each time the surrogate is polled, while a sampler works.

    Raises:
        DesignUnfinished: the audit's queries were not answered in time.
        SurrogymClientError: the server refused a request.
    """
    return replace(_handed_over(subject, audit, progress), model=subject.api.model(subject.name).data_hash)


def _handed_over(
    subject: Subject, audit: AuditSettings | None, progress: Callable[[SurrogateView], None] | None
) -> Handover:
    before = subject.promise()
    if audit is None or (why := _not_possible(subject)) is not None:
        return _unaudited(subject, before, "none was requested" if audit is None else str(why))
    try:
        found = take(subject, audit, before, progress)
    except NobodyAnswers:
        return _unaudited(subject, before, NO_SAMPLER)
    except BeyondBudget as refusal:  # a policy that was trained for minutes is not lost
        return _unaudited(subject, before, str(refusal))
    if found is None:
        return _unaudited(subject, before, "none of its queries was answered")
    trusted, reason = _verdict(found, subject.floor)
    return Handover(found.after, found, trusted, reason)


def _left_the_log(subject: Subject) -> Outside | None:
    """Return how many of the policy's steps are far from all steps of the log, and where; None if the model was not
    learned from a log alone."""
    view, spec = subject.api.surrogate(subject.name), subject.port.spec()
    if view.phase != "from_log":
        return None
    logged = [sample for sample in subject.api.samples(subject.name) if sample.purpose == "logged"]
    q, u = np.array([sample.coordinates for sample in logged]), np.array([sample.action for sample in logged])
    way_q, way_u = way_of(subject, WAY_LANES, min(spec.time_limit or MOST_OF_A_WAY, MOST_OF_A_WAY))
    return outside_of(spec, q, u, way_q, way_u)


def take(
    subject: Subject, settings: AuditSettings, before: Promise, progress: Callable[[SurrogateView], None] | None
) -> Audit | None:
    """Take the real steps of an audit, fit the model to them, and judge the model.

    If no test has failed, but the errors may have a part that all steps share and that moves the return out of the
    promised interval, more steps are taken, up to ``MOST_STEPS``. Returns None if there was no step to take. If the
    original environment failed at every step, the audit has failed.

    Args:
        subject: the policy.
        settings: settings of the audit.
        before: promise before the audit.
        progress: called each time the surrogate is polled.
    """
    api, name, spec = subject.api, subject.name, subject.port.spec()
    view = api.surrogate(name)
    q, u = way_of(subject, WAY_LANES, spec.time_limit or LONGEST_EPISODE)
    matters = UNNOTICED * earned(before, subject.floor) * WAY_LANES / len(q)
    wanted, elsewhere = _asked(subject, settings, q, u, claims=view.phase == "ready")
    while True:
        answers, failed, broken_off = _answers(subject, settings, wanted, progress)
        samples = [sample for sample in answers if spec.known(sample.coordinates)]
        if not samples:
            error = f"; the last error was: {failed[-1].error}" if failed else ""
            faults = (f"{unanswered(len(failed), len(wanted))}{error}",)
            none = Audit(steps=0, unanswered=len(failed), passed=False, faults=faults, before=before, after=before)
            return none if failed else None
        samples.sort(key=lambda sample: sample.query_id in elsewhere)
        off_way = sum(sample.query_id in elsewhere for sample in samples)
        beside = replace(compared(api, spec, view, samples, matters), elsewhere=off_way)
        found = _consequence(subject, beside, before, view, Inputs.over(spec, q, u))
        doubt = found is not None and found.undecided and judge(beside, before, before, subject.floor, found).passed
        more = min(settings.steps, MOST_STEPS - len(samples)) if doubt else 0
        if not (added := _asked_more(subject, replace(settings, steps=more, seed=len(wanted)), q, u)):
            break
        wanted |= added
    wait_for_design(api, name, settings.patience_seconds, progress, after_round=view.round)
    far = untested(spec, q, beside.states) if spec.query == "rollout" else 0.0
    rollouts = len(wanted) if spec.query == "rollout" else 0
    missing = sum(query.id not in elsewhere for query in failed)
    beside = replace(beside, unanswered=missing, rollouts=rollouts, broken_off=broken_off)
    about: dict[str, Any] = {"unanswered": len(failed), "untestable": untestable(spec, q)}
    about |= {"range_left": range_left(spec, q), "untested": far}
    firsts = {sample.query_id: sample.coordinates for sample in sorted(answers, key=lambda sample: -sample.id)}
    audit = judge(beside, before, subject.promise(), subject.floor, found).model_copy(update=about)
    others = [s for s in api.samples(name) if s.trajectory is not None and s.query_id not in wanted]
    seconds = [sample.seconds for sample in answers if sample.seconds is not None]
    return _with_machine(audit, spec, _Machine(list(firsts.values()), others, answers, seconds))


@dataclass(frozen=True)
class _Machine:
    """What an audit saw of the machine itself.

    Attributes:
        starts: the states (C,) to which its resets led.
        before: earlier steps of rollouts.
        steps: its own steps.
        seconds: the seconds from one step of a rollout to the next, as far as they were measured.
    """

    starts: Sequence[ArrayLike]
    before: Sequence[Step]
    steps: Sequence[Step]
    seconds: Sequence[float]


def _with_machine(audit: Audit, spec: EnvironmentSpec, seen: _Machine) -> Audit:
    """Add faults to an audit if the machine is not as declared, because the promise is one for the declared machine: if
    a reset led to another start, a coordinate that is no angle wraps, or an interval is not the sampling period.
    Environments that can be set to states, or return to saved ones, are not judged by this."""
    if spec.access != "reset":
        return audit
    faults = (
        not_declared(spec, seen.starts),
        undeclared_turns(spec, [*seen.before, *seen.steps], len(seen.steps)),
        irregular(spec, seen.seconds, len(seen.seconds)),
    )
    if not any(faults):
        return audit
    found = (*filter(None, faults), *audit.faults)
    return audit.model_copy(update={"passed": False, "faults": found, "undeclared": True})


def judge_episodes(subject: Subject, result: Evaluation) -> Handover:
    """Judge a policy's promise by whole real episodes: by their steps, and by their returns.

    If the environment can't be set to states, the single steps of an audit don't reach the goal, nor all states on the
    way to it. Whole episodes test these too. The model does not learn from the steps.

    Raises:
        SurrogymClientError: the server refused a request, or has no model yet.
    """
    api, spec = subject.api, subject.port.spec()
    view, before = api.surrogate(subject.name), subject.promise()
    result = for_set_points(result, spec, subject.session.get("set_points") or {})
    steps = steady(spec, [step for step in steps_of(result.traces) if spec.known(step.coordinates)])
    q, u = np.array([step.coordinates for step in steps]), np.array([step.action for step in steps])
    beside = compared(api, spec, view, steps, UNNOTICED * earned(before, subject.floor) / float(result.lengths.mean()))
    found = _consequence(subject, beside, before, view, Inputs.over(spec, q, u))
    audit = missed(judge(beside, before, before, subject.floor, found), result.returns, subject.floor)
    if faults := _limit_faults(result, before):
        audit = audit.model_copy(update={"passed": False, "faults": (*faults, *audit.faults)})
    about = {"steps": result.steps, "episodes": len(result.returns), "range_left": range_left(spec, q)}
    starts = [trace.coordinates[0] for trace in result.traces]
    others = [sample for sample in api.samples(subject.name) if sample.trajectory is not None]
    seen = _Machine(starts, others, steps, [one for trace in result.traces for one in trace.seconds])
    audit = _with_machine(audit.model_copy(update=about), spec, seen)
    trusted, reason = _verdict(audit, subject.floor)
    return Handover(audit.after, audit, trusted, reason)


def _limit_faults(result: Evaluation, promise: Promise) -> tuple[str, ...]:
    """Return what whole episodes show against the limits: too many left them, or the fallback acted more often than
    promised."""
    kept, share = result.limits, promise.fallback
    if kept is None:
        return ()
    more = () if share is None or kept.found(share.low, share.high) != "more often" else (share.low, share.high)
    return (*([kept.words()] if kept.broken or more else []), *([kept.expected(*more)] if more else []))


def _answers(
    subject: Subject,
    settings: AuditSettings,
    wanted: set[int],
    progress: Callable[[SurrogateView], None] | None,
) -> tuple[list[SampleView], list[QueryView], int]:
    """Wait for the answers to the queries ``wanted``. Returns their samples, the queries that have none, and the number
    of rollouts that stopped after their first steps although their episode had not ended."""
    api, name = subject.api, subject.name
    try:
        wait_for_answers(api, name, wanted, settings.patience_seconds, progress)
    except BaseException:
        api.withdraw_audit(name, sorted(wanted))
        raise
    queries = {query.id: query for query in api.queries(name) if query.id in wanted}
    samples = [sample for sample in api.samples(name) if sample.query_id in wanted]
    last = {sample.query_id: sample for sample in sorted(samples, key=lambda sample: sample.step)}
    broken_off = sum(
        id in last and last[id].step + 1 < len(query.actions) and not (last[id].terminated or last[id].truncated)
        for id, query in queries.items()
    )
    return samples, [query for query in queries.values() if query.status in ("set_aside", "refused")], broken_off


def _consequence(
    subject: Subject, beside: Compared, before: Promise, view: SurrogateView, inputs: Inputs
) -> Consequence | None:
    """Test whether the model's errors in an audit have a part that all steps share, and compute how this part changes
    the return.

    Returns None if there is no step in a state that the policy visits, or no model.

    Args:
        subject: the policy.
        beside: the real steps with their predictions.
        before: promise before the audit.
        view: the surrogate.
        inputs: the standardisation of the inputs.
    """
    if len(beside.errors) == beside.elsewhere or view.model_version is None:
        return None
    shifted = beside.together(subject.port.spec(), inputs)
    weights = shifted.draws(DRAWS, np.random.default_rng(subject.seed), beside.surprising)
    predict = subject.counting(COMPARING, 2)  # with the errors and without them
    changes = changes_of(subject.port, predict, subject.seed, subject.session, view.model_version, shifted, weights)
    return Consequence(shifted, changes, before, SLACK * earned(before, subject.floor))


def _asked_more(subject: Subject, settings: AuditSettings, q: Array, u: Array) -> set[int]:
    """Add further queries of an audit in states q (m, C) with actions u (m, F). Returns their ids; none if the
    surrogate's audits have taken as many steps as they may, or if states can't be set."""
    if settings.steps < 1 or subject.port.spec().query == "rollout":
        return set()
    try:
        return _asked(subject, settings, q, u, claims=False)[0]
    except BeyondBudget:
        return set()


def _asked(subject: Subject, settings: AuditSettings, q: Array, u: Array, *, claims: bool) -> tuple[set[int], set[int]]:
    """Add the queries of an audit, in some of the states q (m, C) that the policy visits, with its actions u (m, F).

    If the design ``claims`` to know the whole sampling range, one of every ``ELSEWHERE`` queries is in a gap
    between its samples instead, because an error of the model in the gap may have kept the policy away. If the
    environment can't be set to a state, the queries are rollouts in which the policy acts, see ``_rollouts``, or the
    actions of virtual episodes if samplers can't compute the policy. Returns the queries' ids, and the ids of those in
    gaps.
    """
    spec, rng = subject.port.spec(), np.random.default_rng(settings.seed)
    if spec.query == "rollout":
        policy, replan = subject.predict, subject.plans
        acting = encoded(policy, subject.port) if isinstance(policy, Network) else None
        acting = None if acting is None or len(acting) > MAX_POLICY else acting
        rollouts = _rollouts(subject, settings.steps, q, LONGEST_EPISODE if acting or replan else LONGEST_ROLLOUT)
        queries = subject.api.add_queries(subject.name, rollouts=rollouts, policy=acting, replan=replan, audit=True)
        return {query.id for query in queries}, set()
    elsewhere = settings.steps // ELSEWHERE if claims else 0
    chosen = places(spec, q, u, settings.steps - elsewhere, rng)
    if not len(chosen):
        return set(), set()
    points = [(q[chosen], u[chosen])]
    if elsewhere:
        points.append(_in_gaps(subject, elsewhere))
    states, actions = (np.concatenate(parts) for parts in zip(*points, strict=True))
    queries = subject.api.add_queries(subject.name, states.tolist(), actions.tolist(), audit=True)
    numbers = [query.id for query in queries]
    return set(numbers), set(numbers[len(chosen) :])


def _rollouts(subject: Subject, steps: int, q: Array, most: int) -> list[list[list[float]]]:
    """Return the actions, (T, F) each, that are expected in the rollouts of an audit.

    One rollout knows the ways from one start, so there may be several, of equal length: the fewest that are expected to
    come near to all of the states q (m, C) that the policy visits but half of ``MOST_UNTESTED``, and have ``steps``
    learned steps in all. They take one audit's share of the steps that all audits may take, or two shares if one is not
    enough. If no number of rollouts is enough, those of one share that miss fewest steps, then fewest states, are
    taken. ``most`` is the greatest length of a rollout where the specification has none.
    """
    view, spec = subject.api.surrogate(subject.name), subject.port.spec()
    longest, unknown = min(spec.time_limit or LONGEST_EPISODE, spec.max_rollout or most), spec.unknown_steps
    left = _left_for_audits(view)
    share = max(min(max(view.budget, LEAST_AUDITED) // MOST_AUDITS, left), steps + unknown)
    ways = ways_of(subject, max(ROLLOUTS), min(longest, 2 * share))
    shortest = min(longest, min(steps, AUDIT_STEPS) + unknown)  # a longer audit may have more rollouts, not fewer
    best, least = ways[:0], (0, np.inf)
    for total in (share, min(2 * share, left)):
        for count in ROLLOUTS:
            if count > 1 and total // count < shortest:
                break
            parts = [(states[: total // count], actions[: total // count]) for states, actions in ways[:count]]
            learned = np.concatenate([states[unknown:] for states, _ in parts])
            missing, far = max(steps - len(learned), 0), untested(spec, q, learned)
            if not best or (total == share and (missing, far) < least):
                best, least = parts, (missing, far)
            if not missing and far <= MOST_UNTESTED / 2:
                return [actions.tolist() for _, actions in parts]
    return [actions.tolist() for _, actions in best]


def _left_for_audits(view: SurrogateView) -> int:
    """Return the number of real steps that the surrogate's audits may still take."""
    return max(view.budget, LEAST_AUDITED) - view.ledger.audit


def _in_gaps(subject: Subject, count: int) -> tuple[Array, Array]:
    """Return states (count, C) and actions (count, F) within the sampling ranges that are in the widest gaps between
    the samples."""
    spec = subject.port.spec()
    random = replace(subject, predict=baseline(spec, "random", subject.seed))
    q, u = way_of(random, ANYWHERE, 1, start_box=1.0)
    known = [sample for sample in subject.api.samples(subject.name) if spec.known(sample.coordinates)]
    samples = np.array([s.coordinates for s in known]), np.array([s.action for s in known])
    chosen = gaps(spec, q, u, samples, count)
    return q[chosen], u[chosen]


def way_of(subject: Subject, episodes: int, steps: int, start_box: float = 0.0) -> tuple[Array, Array]:
    """Return the states (m, C) and actions (m, F) of all episodes of ``ways_of``, the first steps of all before the
    second ones."""
    ways = ways_of(subject, episodes, steps, start_box)
    order = np.argsort(np.concatenate([np.arange(len(states)) for states, _ in ways]), kind="stable")
    states, actions = (np.concatenate(parts)[order] for parts in zip(*ways, strict=True))
    return states, actions


def ways_of(subject: Subject, episodes: int, steps: int, start_box: float = 0.0) -> list[tuple[Array, Array]]:
    """Return the states (T, C) and actions (T, F) of a policy in each of several whole virtual episodes.

    Each episode follows a function of its own, sampled from the model's posterior. Actions are in the original
    environment's units.

    Args:
        subject: the policy.
        episodes: number of episodes.
        steps: largest number of steps in an episode.
        start_box: share of episodes that begin anywhere in the sampling range; the others begin as declared.
    """
    spec = subject.port.spec()
    options = {**subject.session, **WHOLE, "start_box": start_box, "variant": "pathwise", "seed": subject.seed}
    lanes = Lanes(subject.port, session_request(episodes, "same_step", options))
    states, actions, running, lengths = [], [], np.ones(episodes, dtype=bool), np.zeros(episodes, dtype=int)
    try:
        observation = lanes.reset(subject.seed).observation
        for _ in range(steps):
            action = subject.predict(observation)
            states.append(np.array(subject.api.session_coordinates(lanes.view.id)))
            actions.append(decode_actions(spec, action, episodes))
            lengths += running
            step = lanes.step(action)
            if step.lost is not None:
                return ways_of(subject, episodes, steps, start_box)
            observation = step.result.observation
            running &= ~(step.result.terminated | step.result.truncated)
            if not running.any():
                break
    finally:
        lanes.close()
    q, u = np.stack(states, 1), np.stack(actions, 1)
    return [(q[lane, :length], u[lane, :length]) for lane, length in enumerate(lengths)]


def _not_possible(subject: Subject) -> str | None:
    """Return why no audit is possible; None if one is."""
    view = subject.api.surrogate(subject.name)
    if not view.spec.preset.audits:
        return f"preset {view.spec.preset.name} has no audits"
    if not view.samplers:
        return NO_SAMPLER
    return "the design is paused" if view.paused else None


def _verdict(audit: Audit, floor: float | None) -> tuple[bool, str]:
    if not audit.passed:
        return False, f"the audit failed: {audit.faults[0]}"
    if (doubt := _doubtful(audit.after, floor)) is not None:
        return False, doubt
    if audit.untestable is not None:
        name, share = audit.untestable
        return False, (
            f"{100 * share:.0f} % of the policy's states have a {name!r} beyond what the original environment can be "
            "set to, so no audit tests them: register under a new name with a wider range or bounds"
        )
    rollouts = f" in {counted(audit.rollouts, 'rollout')}" if audit.rollouts else ""
    if audit.untested > MOST_UNTESTED:
        return False, (
            f"the audit's {audit.steps} real steps{rollouts} reached {100 * (1 - audit.untested):.0f} % of the "
            "policy's states, and the others are untested: surrogym audit POLICY --env ENVIRONMENT takes whole episodes"
        )
    if audit.episodes:
        return (
            True,
            f"the return and the {audit.steps} real steps of {audit.episodes} whole episodes agree with the model",
        )
    where = f"{audit.steps - audit.elsewhere} real steps{rollouts} on the policy's way"
    if audit.elsewhere:
        where += f" and {audit.elsewhere} in the widest gaps of the samples"
    missing = f"; {audit.unanswered} in the gaps could not be taken" if audit.unanswered else ""
    return True, f"{where} agree with the model{missing}"


def _unaudited(subject: Subject, promise: Promise, why: str) -> Handover:
    """Return a handover without an audit; ``why`` is the reason. It has no promise if the policy leaves the log."""
    if (left := _left_the_log(subject)) is not None and left.much:
        return Handover(None, None, False, f"{left.words()}: no promise can be made for them")
    return _without(subject.api.surrogate(subject.name), promise, subject.floor, why)


def _without(view: SurrogateView, promise: Promise, floor: float | None, why: str) -> Handover:
    """Return a handover without an audit; ``why`` is the reason. The promise is trusted only if the design is ready and
    the interval is not doubtful compared with ``floor``, the return of an untrained policy."""
    if (doubt := _doubtful(promise, floor)) is not None:
        return Handover(promise, None, False, f"{doubt}; not audited: {why}")
    if view.phase == "ready":
        return Handover(promise, None, True, f"the design is ready; not audited: {why}")
    state = "is not certain of its model" if view.phase in COMPLETED else "has not ended"
    return Handover(promise, None, False, f"the design {state}, and there was no audit: {why}")


def _doubtful(promise: Promise, floor: float | None) -> str | None:
    """Return why a promise is doubtful although no audit failed, such as a wide interval; None if it is not doubtful.
    ``floor`` is the return of an untrained policy."""
    if floor is not None and promise.high <= floor:
        return (
            f"the promise is no more than the return of an untrained policy, {floor:.4g}: perhaps no policy can change "
            "the return within the sampling ranges"
        )
    if floor is None or not wider(promise, WIDE, floor):
        return None
    return (
        f"the promise, from {promise.low:.4g} to {promise.high:.4g}, is too wide compared with the gain over an "
        f"untrained policy, whose return is {floor:.4g}"
    )
