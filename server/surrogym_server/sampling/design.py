"""The rounds of Algorithm 1: fit the model, judge it, choose queries. Pure: state and samples in, decision and state
out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples
from surrogym_server.models.guard import learn, plugin_calls, require_deviations
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.acquisition import acquisition_of
from surrogym_server.sampling.batch import choose
from surrogym_server.sampling.candidates import Candidates, candidates_of, with_more
from surrogym_server.sampling.confidence import OutputConfidence, confidences_of, deviations
from surrogym_server.sampling.endings import ending
from surrogym_server.sampling.excursions import excursion
from surrogym_server.sampling.latin_hypercube import going_on, latin_hypercube, random_points
from surrogym_server.sampling.noise import SLACK, established_noise, to_repeat, widened
from surrogym_server.sampling.past import owed_to_past, pairs_lacking
from surrogym_server.sampling.peaks import highest
from surrogym_server.sampling.prequential import Predictions, from_pairs, pairs_of, scores_of
from surrogym_server.sampling.rollouts import Aim, Rollout, first_rollouts, plan_round, random_sequences
from surrogym_server.sampling.serial import noise_of_sensors, sensor_noise
from surrogym_server.sampling.tolerances import Usual, frozen_tolerances

Verdict = Literal["continue", "ready", "over_budget", "unsure", "from_log"]
SHORTEST_ROUND = 4  # real steps
LONGER = 8  # steps of a rollout that shows what the steps before explain
FEW_POINTS = 500  # more points leave no large gap, and comparing all pairs takes memory in the square of their number


@dataclass(frozen=True)
class DesignState:
    """State that one round passes to the next; can be written as JSON."""

    round: int = 0
    usual: tuple[float, ...] = ()  # default tolerances, per output; see ``tolerances``
    warm: dict[str, NDArray[np.float64]] = field(default_factory=dict)  # what a fit passes to the next one
    ended_with: tuple[float, ...] = ()  # steps of the budget, budget, target and tolerances at the end of the design
    ended_as: str = ""  # the verdict at that end; "" while the design continues
    ranges: tuple[float, ...] = ()  # of the targets, from which each tolerance was computed
    predictions: Predictions = ()  # the last ones of each output, of samples that were then learned from
    tested_at: int = 0  # number of samples when the model became sure and an excursion was planned; 0: it is not sure

    def to_json(self) -> dict[str, Any]:
        warm = {key: array.tolist() for key, array in self.warm.items()}
        ended, ranges = list(self.ended_with), list(self.ranges)
        fields = {"round": self.round, "usual": list(self.usual), "ranges": ranges, "warm": warm, "ended_with": ended}
        fields["ended_as"] = self.ended_as
        return fields | {"predictions": pairs_of(self.predictions), "tested_at": self.tested_at}

    @classmethod
    def from_json(cls, state: dict[str, Any]) -> DesignState:
        warm = {key: np.array(array) for key, array in state.get("warm", {}).items()}
        usual, ended, ranges = (tuple(state.get(name, ())) for name in ("usual", "ended_with", "ranges"))
        predictions, tested_at = from_pairs(state.get("predictions", [])), state.get("tested_at", 0)
        ended_as = state.get("ended_as", "")
        return cls(state.get("round", 0), usual, warm, ended, ended_as, ranges, predictions, tested_at)


@dataclass(frozen=True)
class Request:
    """Input of a round.

    Pending queries, open or set aside, are treated as answered. They count towards the budget, so that a design whose
    queries all fail comes to an end, and in the acquisition, so that the next queries go elsewhere. Queries that the
    environment refused count in the acquisition alone, because no real step was taken.
    """

    budget: int
    target: float
    pending: Points  # p
    extra: int = 0  # real steps to choose even if the design has ended
    states: Tensor | None = None  # (v, C) visited by policies
    pending_rollouts: tuple[Rollout, ...] = ()
    snapshots: Tensor | None = None  # (s, C) states to which the environment can return
    logged: int = 0  # of the samples, from a log
    audited: int = 0  # of the samples, steps of audits
    unlearned: int = 0  # further real steps, whose lags were not known
    open: int = 0  # real steps of the pending queries that may still be answered
    refused: Points | None = None  # queries that the environment refused
    refused_rollouts: tuple[Rollout, ...] = ()
    surprises: Predictions = ()  # predictions of the samples that the last model had not learned from

    @property
    def free(self) -> int:
        """Number of samples that don't count towards the budget, less the real steps that are no samples."""
        return self.logged + self.audited - self.unlearned

    @property
    def assumed(self) -> Points:
        """Queries without an answer, which the acquisition treats as answered."""
        return self.pending if self.refused is None else Points.joined([self.pending, self.refused])

    def is_mostly_refused(self, spent: float) -> bool:
        """Whether the environment refused as many steps as it has taken, ``spent``, and the budget has in addition.

        Without this limit, a design whose queries are all refused would never end.
        """
        steps = (0 if self.refused is None else len(self.refused)) + sum(map(len, self.refused_rollouts))
        return steps >= self.budget + spent


@dataclass(frozen=True)
class Decision:
    model: DynamicsModel
    confidences: tuple[OutputConfidence, ...]  # per output
    tolerances: tuple[float, ...]  # per output, used for the verdict
    state: DesignState
    verdict: Verdict
    q: Tensor  # (m, C) next queries
    u: Tensor  # (m, F)
    rollouts: tuple[Rollout, ...] = ()  # next rollouts if the environment can't be set to any state


def initial_design(definition: EnvironmentDefinition, budget: int) -> tuple[Tensor, Tensor]:
    """Draw the initial Latin hypercube: coordinates (n, C), actions (n, F), n at most the budget."""
    count = min(definition.design.initial, budget)
    if not acquisition_of(definition.design.acquisition).adaptive:
        count = budget
    tries = 1 if count > FEW_POINTS else definition.design.hypercube_tries
    rng = _rng(definition, "initial")
    return going_on(definition, *latin_hypercube(definition, count, rng, tries), rng)


def initial_rollouts(definition: EnvironmentDefinition, budget: int) -> list[Tensor]:
    """Draw the initial rollouts of an environment that can't be set to a state: action sequences (T, F), with at most
    as many steps as the budget has."""
    planned = acquisition_of(definition.design.acquisition).adaptive
    steps = min(definition.design.initial, budget) if planned else budget
    return first_rollouts(definition, steps, _rng(definition, "initial"))


def advance(definition: EnvironmentDefinition, samples: Samples, state: DesignState, request: Request) -> Decision:
    """Do one round.

    Raises:
        InvalidInput, NumericalFailure: as ``Learner.learn`` does.
        PluginFailed: the family of models raised anything else, or its model can't be used.
        ChoiceFailed: the acquisition broke its laws.
    """
    learned = learn(definition, samples, state.warm)
    frozen = frozen_tolerances(definition, samples, Usual(state.usual, state.ranges))
    usual = frozen.tolerances
    judged = judge_model(learned.model, samples, usual, request, state.round, state.predictions)
    confidences, tolerances = judged.confidences, judged.tolerances
    now = (
        float(len(samples) - request.free),
        float(request.budget),
        request.target,
        *definition.tolerances_over(usual),
    )
    verdict = _verdict(judged, state, request, now)
    sure = verdict == "ready"
    testing = sure and _is_untested(definition, samples, state)
    verdict = "continue" if testing else verdict
    candidates, reserved = judged.candidates, judged.reserved
    chosen, rollouts = candidates.points[:0], tuple[Rollout, ...]()
    if definition.max_rollout is None:
        chosen = _repeated(learned.model, samples, usual, verdict, request)
        if not len(chosen):
            chosen = _choose(learned.model, samples, candidates, confidences, tolerances, verdict, request, reserved)
    else:
        rng = _rng(definition, f"rollouts {state.round}")
        if testing:
            rollouts = _excursion(learned.model, samples, request, rng)
        elif not (rollouts := _longer(definition, samples, confidences, tolerances, verdict, request, rng)):
            ends = reserved is not None
            rollouts = _plan(learned.model, samples, confidences, tolerances, verdict, request, rng, ends)
    asks = bool(len(chosen) or rollouts)
    if verdict == "continue" and not asks and not request.open:
        # no distinct query is left, or those that were set aside hold the rest of the budget, or there is no rest
        verdict = "unsure" if now[0] < request.budget else "over_budget"
    ended, ended_as = (now, verdict) if verdict != "continue" and not asks else ((), "")
    tested_at = (len(samples) if testing else state.tested_at) if sure else 0
    new_state = DesignState(
        state.round + 1, usual, learned.warm, ended, ended_as, frozen.ranges, state.predictions, tested_at
    )
    return Decision(learned.model, confidences, tolerances, new_state, verdict, chosen.q, chosen.u, rollouts)


def _verdict(judged: Judged, state: DesignState, request: Request, now: tuple[float, ...]) -> Verdict:
    """The verdict of a round, given how the design ended before.

    A design that was ready stays ready, unless a person has asked for more or the steps since then contradict it. A fit
    to more steps may lower a confidence index a little, although the model had predicted them all. Audits and logs
    don't make a design that has ended take further real steps.
    """
    if judged.verdict in ("ready", "from_log"):
        return judged.verdict
    if state.ended_as == "ready" and not _asks_more(now, state.ended_with) and not _contradicted(judged, request):
        return "ready"
    if judged.verdict == "continue" and (now == state.ended_with or request.is_mostly_refused(now[0])):
        return "unsure"
    return judged.verdict


def _asks_more(now: tuple[float, ...], before: tuple[float, ...]) -> bool:
    """Whether another budget, another target or a smaller tolerance is asked for than at the design's end."""
    smaller = any(new < old for new, old in zip(now[3:], before[3:], strict=True))
    return now[1:3] != before[1:3] or smaller


def _contradicted(judged: Judged, request: Request) -> bool:
    """Whether the errors of an output are larger than its tolerance: those of the predictions of the latest steps or,
    without any, the leave-one-out errors."""
    surprises = request.surprises
    for i, (confidence, tolerance) in enumerate(zip(judged.confidences, judged.tolerances, strict=True)):
        latest = surprises[i] if surprises else ()
        error = confidence.leave_one_out_error or 0.0
        if latest:
            error = math.sqrt(sum(one.error**2 for one in latest) / len(latest))
        if error > SLACK * tolerance:
            return True
    return False


@dataclass(frozen=True)
class Judged:
    """Verdict on a model."""

    confidences: tuple[OutputConfidence, ...]  # per output
    tolerances: tuple[float, ...]  # per output
    verdict: Verdict
    candidates: Candidates  # m
    reserved: Tensor | None  # (m,) bool: candidates to be queried first; see ``endings`` and ``peaks``


def judge_model(
    model: DynamicsModel,
    samples: Samples,
    usual: Sequence[float],
    request: Request,
    round_: int,
    predictions: Predictions = (),
) -> Judged:
    """Judge a model by its definition's tolerances, or else by the ``usual`` ones (O,). Raises ``PluginFailed``."""
    definition = model.definition
    with plugin_calls(definition):
        limits = definition.tolerances_over(usual)
        past = owed_to_past(model, samples, limits)
        sensors = tuple(None if any(past) else one for one in sensor_noise(model, samples, limits))
        noise = established_noise(model, samples, limits).maximum(noise_of_sensors(model, samples, sensors, limits))
        noise = torch.zeros_like(noise) if any(past) else noise  # what is hidden may be in every output
    tolerances = widened(definition.tolerances_over(usual), noise)
    points = Points(*monte_carlo(definition))
    with plugin_calls(definition):
        deviation = deviations(model, points.q, points.u)
        require_deviations(model, deviation)
        judged = confidences_of(model, points, deviation, tolerances)
    confidences = tuple(
        replace(
            c,
            noise=float(w),
            sensor_noise=0.0 if one is None else one.deviation,
            past=past[i],
            prequential=scores_of(predictions[i], tolerances[i]) if predictions else None,
        )
        for i, (c, w, one) in enumerate(zip(judged, noise, sensors, strict=True))
    )
    candidates = candidates_of(model, points, request.states, _rng(definition, f"visited {round_}"))
    reserved = ending(model, samples, candidates.points)
    settled = reserved is None or not definition.learns_termination
    peak = None
    if definition.design.stopping == "tested_confidence":
        peak = highest(model, samples, candidates.points, tolerances[-1], _rng(definition, f"peak {round_}"))
    if peak is not None:
        settled = False
        if reserved is None or round_ % 2:  # the two alternate
            candidates, reserved = with_more(candidates, peak)
    verdict = judge(definition, confidences, tolerances, len(samples), request, settled)
    return Judged(confidences, tolerances, verdict, candidates, reserved)


def monte_carlo(definition: EnvironmentDefinition) -> tuple[Tensor, Tensor]:
    """Draw the Monte Carlo set of eq. 8, the same in every round: coordinates (m, C), actions (m, F)."""
    rng = _rng(definition, "monte carlo")
    return going_on(definition, *random_points(definition, definition.design.monte_carlo, rng), rng)


def judge(
    definition: EnvironmentDefinition,
    confidences: tuple[OutputConfidence, ...],
    tolerances: tuple[float, ...],
    samples: int,
    request: Request,
    settled: bool = True,
) -> Verdict:
    """Decide whether the design continues.

    With ``tested_confidence`` the index counts only if leave-one-out errors are known and within the tolerances, if the
    end of episodes is known, and if adaptive queries, half as many as the initial design had, have failed to disprove
    the model. Logged samples can replace initial queries but not adaptive ones, because nobody chose them to disprove
    the model.
    """
    initial, spent = definition.design.initial, samples - request.free
    sure = all(c.confidence_index >= request.target for c in confidences)
    if definition.design.stopping == "tested_confidence":
        sure = sure and all(_agrees(c, t) for c, t in zip(confidences, tolerances, strict=True))
        sure = sure and settled and spent + min(request.logged, initial) >= math.ceil(1.5 * initial)
        sure = sure and request.budget > 0
    if sure:
        return "ready"
    if request.budget == 0:
        return "from_log"
    return "continue" if spent < request.budget else "over_budget"


def _agrees(confidence: OutputConfidence, tolerance: float) -> bool:
    limit = SLACK * tolerance if confidence.noise else tolerance
    return confidence.leave_one_out_error is not None and confidence.leave_one_out_error <= limit


def _repeated(
    model: DynamicsModel, samples: Samples, usual: Sequence[float], verdict: Verdict, request: Request
) -> Points:
    """Steps to repeat, to tell noise from misfit: in the second half of a budget, if the model is uncertain."""
    none = Points(samples.q[:0], samples.u[:0])
    design, spent = model.definition.design, len(samples) - request.free
    if verdict != "continue" or design.stopping != "tested_confidence":
        return none
    if spent < max(request.budget / 2, 1.5 * design.initial):
        return none
    with plugin_calls(model.definition):
        again = to_repeat(model, samples, model.definition.tolerances_over(usual))
    room = max(0, request.budget - spent - len(request.pending))
    return none if again is None else again[:room]


def _longer(
    definition: EnvironmentDefinition,
    samples: Samples,
    confidences: tuple[OutputConfidence, ...],
    tolerances: tuple[float, ...],
    verdict: Verdict,
    request: Request,
    rng: np.random.Generator,
) -> tuple[Rollout, ...]:
    """Random rollouts that give enough consecutive steps to tell noise from what the steps before explain: in the
    second half of a budget, if an error exceeds its tolerance. Snapshots need none, because they keep the past."""
    spent, design = len(samples) - request.free, definition.design
    if verdict != "continue" or design.stopping != "tested_confidence" or definition.snapshots:
        return ()
    if spent < max(request.budget / 2, 1.5 * design.initial) or request.pending_rollouts:
        return ()
    if all(_agrees(c, t) for c, t in zip(confidences[:-1], tolerances, strict=False)):
        return ()
    length = min(LONGER, definition.max_rollout or 1)
    lacking = pairs_lacking(definition, samples)
    count = min(-(-lacking // max(length - 1, 1)), _room(samples, request) // length) if length > 1 else 0
    sequences = random_sequences(definition, count, length, rng) if count else ()
    return tuple(Rollout(torch.from_numpy(sequence)) for sequence in sequences)


def _choose(
    model: DynamicsModel,
    samples: Samples,
    candidates: Candidates,
    confidences: tuple[OutputConfidence, ...],
    tolerances: tuple[float, ...],
    verdict: Verdict,
    request: Request,
    reserved: Tensor | None,
) -> Points:
    """Choose one query for each output below its target, the least confident first. The first query is a
    reserved one."""
    below = _below(confidences, request.target)
    if verdict == "continue":
        wanted = below[: max(0, request.budget + request.free - len(samples) - len(request.pending))]
    else:
        wanted = [below[i % len(below)] for i in range(request.extra)]
    taken = Points.joined([Points(samples.q, samples.u), request.assumed])
    return candidates.points[choose(model, candidates, taken, request.assumed, wanted, tolerances, reserved)]


def _plan(
    model: DynamicsModel,
    samples: Samples,
    confidences: tuple[OutputConfidence, ...],
    tolerances: tuple[float, ...],
    verdict: Verdict,
    request: Request,
    rng: np.random.Generator,
    ending: bool,
) -> tuple[Rollout, ...]:
    """Plan rollouts for the outputs below their target, with a quarter as many real steps as there are samples.

    So plans become longer as the model sees more, and fits are few. With snapshots, which need no way from a reset, a
    round has half as many steps, and at least one for each of these outputs, as with single steps.

    If the initial rollouts ended so early that more steps of the initial design are missing than a round has, the
    round is further random rollouts. Otherwise many small rounds would follow, each with a fit of few steps.
    """
    steps, below = request.extra, _below(confidences, request.target)
    if verdict == "continue":
        usual = max(SHORTEST_ROUND, len(samples) // 4)
        if not model.definition.snapshots and (missing := _missing(model.definition, samples, request)) > usual:
            return tuple(map(Rollout, first_rollouts(model.definition, missing, rng)))
        steps = min(
            _room(samples, request), max(len(below), len(samples) // 8) if model.definition.snapshots else usual
        )
    longest = model.definition.max_rollout or 1
    ended = bool(samples.terminated.any())
    aim = Aim(below, tolerances, longest, request.snapshots, request.states, ending, ended)
    return tuple(plan_round(model, aim, steps, (*request.pending_rollouts, *request.refused_rollouts), rng))


def _is_untested(definition: EnvironmentDefinition, samples: Samples, state: DesignState) -> bool:
    """Whether a design that would be ready needs an excursion first: it has snapshots, and no step was taken since one
    was planned."""
    if not definition.snapshots or definition.design.stopping != "tested_confidence":
        return False
    return not state.tested_at or len(samples) <= state.tested_at


def _excursion(
    model: DynamicsModel, samples: Samples, request: Request, rng: np.random.Generator
) -> tuple[Rollout, ...]:
    """An excursion, if the budget has room for it."""
    room = _room(samples, request)
    visited = torch.cat([samples.q, samples.q_next])
    return (excursion(model, visited, request.snapshots, room, rng),) if room > 0 else ()


def _room(samples: Samples, request: Request) -> int:
    """Real steps that the budget has left for rollouts, without those of pending ones."""
    return request.budget + request.free - len(samples) - sum(map(len, request.pending_rollouts))


def _missing(definition: EnvironmentDefinition, samples: Samples, request: Request) -> int:
    """Real steps that the initial design has yet to take within the budget. Logged ones can replace them."""
    begun = len(samples) - request.free + min(request.logged, definition.design.initial)
    initial = definition.design.initial - begun - sum(map(len, request.pending_rollouts))
    return min(initial, _room(samples, request))


def _below(confidences: tuple[OutputConfidence, ...], target: float) -> list[int]:
    """Outputs below their target, the least confident first. If there is none, the least confident output."""
    order = sorted(range(len(confidences)), key=lambda i: confidences[i].confidence_index)
    return [i for i in order if confidences[i].confidence_index < target] or order[:1]


def _rng(definition: EnvironmentDefinition, purpose: str) -> np.random.Generator:
    return np.random.default_rng([definition.design.seed, *purpose.encode()])
