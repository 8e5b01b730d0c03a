"""The rounds of Algorithm 1: fit, judge, choose. Pure: state and samples in, decision and new state out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
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
from surrogym_server.sampling.latin_hypercube import going_on, latin_hypercube, random_points
from surrogym_server.sampling.noise import SLACK, established_noise, to_repeat, widened
from surrogym_server.sampling.peaks import highest
from surrogym_server.sampling.rollouts import Aim, first_rollouts, plan_round
from surrogym_server.sampling.tolerances import Usual, frozen_tolerances

Verdict = Literal["continue", "ready", "over_budget", "from_log"]
SHORTEST_ROUND = 4  # real steps
WARM = "thetas"  # in stored states, as it was called when it was always hyperparameters
FEW_POINTS = 500  # more of them leave no gap worth a comparison of all pairs, whose memory grows with their square


@dataclass(frozen=True)
class DesignState:
    """What one round leaves for the next; JSON-able."""

    round: int = 0
    usual: tuple[float, ...] = ()  # tolerances, per output, where nobody set one; see ``tolerances``
    warm: dict[str, NDArray[np.float64]] = field(default_factory=dict)  # what the fit leaves for the next one
    ended_with: tuple[float, ...] = ()  # steps of the budget, budget, target and tolerances, where the design ended
    ranges: tuple[float, ...] = ()  # of the targets that each tolerance was taken from

    def to_json(self) -> dict[str, Any]:
        warm = {key: array.tolist() for key, array in self.warm.items()}
        ended, ranges = list(self.ended_with), list(self.ranges)
        return {"round": self.round, "usual": list(self.usual), "ranges": ranges, WARM: warm, "ended_with": ended}

    @classmethod
    def from_json(cls, state: dict[str, Any]) -> DesignState:
        warm = {key: np.array(array) for key, array in state.get(WARM, {}).items()}
        usual, ended, ranges = (tuple(state.get(name, ())) for name in ("usual", "ended_with", "ranges"))
        return cls(state.get("round", 0), usual, warm, ended, ranges)


@dataclass(frozen=True)
class Request:
    """What a round is asked to do.

    Pending queries, open or set aside, count as if they had been answered: against the budget, so that a design whose
    every query fails comes to an end, and in the acquisition, so that the next ones go elsewhere.
    """

    budget: int
    target: float
    pending: Points  # p
    extra: int = 0  # real steps to choose whatever the verdict
    states: Tensor | None = None  # (v, C) visited by policies
    pending_rollouts: tuple[Tensor, ...] = ()  # each (T, F)
    logged: int = 0  # of the samples, from a log
    audited: int = 0  # of the samples, steps of audits

    @property
    def free(self) -> int:
        """Samples that cost none of the budget."""
        return self.logged + self.audited


@dataclass(frozen=True)
class Decision:
    model: DynamicsModel
    confidences: tuple[OutputConfidence, ...]  # per output
    tolerances: tuple[float, ...]  # per output, those that it was judged by
    state: DesignState
    verdict: Verdict
    q: Tensor  # (m, C) next queries
    u: Tensor  # (m, F)
    rollouts: tuple[Tensor, ...] = ()  # next ones where it can only reset and act, each (T, F)


def initial_design(definition: EnvironmentDefinition, budget: int) -> tuple[Tensor, Tensor]:
    """The Latin hypercube that everything starts from: coordinates (n, C), actions (n, F), n at most the budget."""
    count = min(definition.design.initial, budget)
    if not acquisition_of(definition.design.acquisition).adaptive:
        count = budget
    tries = 1 if count > FEW_POINTS else definition.design.hypercube_tries
    rng = _rng(definition, "initial")
    return going_on(definition, *latin_hypercube(definition, count, rng, tries), rng)


def initial_rollouts(definition: EnvironmentDefinition, budget: int) -> list[Tensor]:
    """What everything starts from where no state can be set: action sequences (T, F), in all at most the budget."""
    planned = acquisition_of(definition.design.acquisition).adaptive
    steps = min(definition.design.initial, budget) if planned else budget
    return first_rollouts(definition, steps, _rng(definition, "initial"))


def advance(definition: EnvironmentDefinition, samples: Samples, state: DesignState, request: Request) -> Decision:
    """One round.

    Raises:
        InvalidInput, NumericalFailure: as ``Learner.learn`` does.
        PluginFailed: the family of models raised anything else, or its model can't be used.
        ChoiceFailed: the acquisition broke its laws.
    """
    learned = learn(definition, samples, state.warm)
    frozen = frozen_tolerances(definition, samples, Usual(state.usual, state.ranges))
    usual = frozen.tolerances
    judged = judge_model(learned.model, samples, usual, request, state.round)
    confidences, tolerances, verdict = judged.confidences, judged.tolerances, judged.verdict
    now = (
        float(len(samples) - request.free),
        float(request.budget),
        request.target,
        *definition.tolerances_over(usual),
    )
    if verdict == "continue" and now == state.ended_with:
        verdict = "over_budget"  # audits and logs alone have come since it ended: they ask for no further real step
    candidates, reserved = judged.candidates, judged.reserved
    chosen, rollouts = candidates.points[:0], tuple[Tensor, ...]()
    if definition.max_rollout is None:
        chosen = _repeated(learned.model, samples, usual, verdict, request)
        if not len(chosen):
            chosen = _choose(learned.model, samples, candidates, confidences, tolerances, verdict, request, reserved)
    else:
        rng = _rng(definition, f"rollouts {state.round}")
        rollouts = _plan(learned.model, samples, confidences, tolerances, verdict, request, rng, reserved is not None)
    if verdict == "continue" and not len(chosen) and not rollouts:
        verdict = "over_budget"  # the rest of the budget is pending, or nothing distinct is left to ask
    ended = now if verdict != "continue" and not len(chosen) and not rollouts else ()
    new_state = DesignState(state.round + 1, usual, learned.warm, ended, frozen.ranges)
    return Decision(learned.model, confidences, tolerances, new_state, verdict, chosen.q, chosen.u, rollouts)


@dataclass(frozen=True)
class Judged:
    """How well a model is known, and what follows."""

    confidences: tuple[OutputConfidence, ...]  # per output
    tolerances: tuple[float, ...]  # per output
    verdict: Verdict
    candidates: Candidates  # m
    reserved: Tensor | None  # (m,) bool: which of them are to be asked first; see ``endings`` and ``peaks``


def judge_model(
    model: DynamicsModel, samples: Samples, usual: Sequence[float], request: Request, round_: int
) -> Judged:
    """Judge a model by the ``usual`` tolerances (O,), over which those of its definition go. Raises PluginFailed."""
    definition = model.definition
    with plugin_calls(definition):
        noise = established_noise(model, samples, definition.tolerances_over(usual))
    tolerances = widened(definition.tolerances_over(usual), noise)
    points = Points(*monte_carlo(definition))
    with plugin_calls(definition):
        deviation = deviations(model, points.q, points.u)
        require_deviations(model, deviation)
        judged = confidences_of(model, deviation, tolerances)
    confidences = tuple(replace(c, noise=float(w)) for c, w in zip(judged, noise, strict=True))
    candidates = candidates_of(model, points, request.states, _rng(definition, f"visited {round_}"))
    reserved = ending(model, samples, candidates.points)
    settled = reserved is None or not definition.learns_termination
    peak = None
    if definition.design.stopping == "tested_confidence":
        peak = highest(model, samples, candidates.points, tolerances[-1], _rng(definition, f"peak {round_}"))
    if peak is not None:
        settled = False
        if reserved is None or round_ % 2:  # both are asked in turn
            candidates, reserved = with_more(candidates, peak)
    verdict = judge(definition, confidences, tolerances, len(samples), request, settled)
    return Judged(confidences, tolerances, verdict, candidates, reserved)


def monte_carlo(definition: EnvironmentDefinition) -> tuple[Tensor, Tensor]:
    """The Monte Carlo set of eq. 8, the same in every round: coordinates (m, C), actions (m, F)."""
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
    """Whether to continue. A ``tested_confidence`` counts only when leave-one-out errors are known and agree, it is
    settled where episodes end, and adaptive queries, half as many as the initial design had, have tried to disprove
    it. Logged samples stand for initial queries, never for adaptive ones: nobody chose them to disprove anything."""
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
    """Steps to take again, to tell noise from misfit: in the second half of a budget, where the model is not sure."""
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
    """One query for each output below its target, least confident first; the first one of those reserved."""
    below = _below(confidences, request.target)
    if verdict == "continue":
        wanted = below[: max(0, request.budget + request.free - len(samples) - len(request.pending))]
    else:
        wanted = [below[i % len(below)] for i in range(request.extra)]
    taken = Points.joined([Points(samples.q, samples.u), request.pending])
    return candidates.points[choose(model, candidates, taken, request.pending, wanted, tolerances, reserved)]


def _plan(
    model: DynamicsModel,
    samples: Samples,
    confidences: tuple[OutputConfidence, ...],
    tolerances: tuple[float, ...],
    verdict: Verdict,
    request: Request,
    rng: np.random.Generator,
    ending: bool,
) -> tuple[Tensor, ...]:
    """Rollouts for the outputs below their target: a quarter as many real steps as there are samples, so that a model
    is trusted with longer plans the more it has seen, and fits are few."""
    steps = request.extra
    if verdict == "continue":
        pending = sum(len(actions) for actions in request.pending_rollouts)
        room = request.budget + request.free - len(samples) - pending
        steps = min(room, max(SHORTEST_ROUND, len(samples) // 4))
    longest = model.definition.max_rollout or 1
    ended = bool(samples.terminated.any())
    aim = Aim(_below(confidences, request.target), tolerances, longest, request.states, ending, ended)
    return tuple(plan_round(model, aim, steps, request.pending_rollouts, rng))


def _below(confidences: tuple[OutputConfidence, ...], target: float) -> list[int]:
    """Outputs below their target, least confident first; where there is none, the least confident."""
    order = sorted(range(len(confidences)), key=lambda i: confidences[i].confidence_index)
    return [i for i in order if confidences[i].confidence_index < target] or order[:1]


def _rng(definition: EnvironmentDefinition, purpose: str) -> np.random.Generator:
    return np.random.default_rng([definition.design.seed, *purpose.encode()])
