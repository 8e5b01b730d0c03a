"""Judge a model: confidence per output, the verdict that follows, and the candidates for the next queries."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples
from surrogym_server.models.guard import plugin_calls, require_deviations
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.candidates import Candidates, candidates_of, with_reserved
from surrogym_server.sampling.confidence import OutputConfidence, confidences_of, deviations
from surrogym_server.sampling.endings import ending
from surrogym_server.sampling.latin_hypercube import going_on, random_points
from surrogym_server.sampling.noise import SLACK, established_noise, widened
from surrogym_server.sampling.past import owed_to_past
from surrogym_server.sampling.peaks import highest
from surrogym_server.sampling.prequential import scores_of
from surrogym_server.sampling.seeds import generator_for
from surrogym_server.sampling.serial import noise_of_sensors, sensor_noise
from surrogym_server.sampling.state import DesignState, Request
from surrogym_shared.nouns import Verdict


@dataclass(frozen=True)
class Judgement:
    """Verdict on a model."""

    confidences: tuple[OutputConfidence, ...]  # per output
    tolerances: tuple[float, ...]  # per output
    verdict: Verdict
    candidates: Candidates  # m


def judge_model(
    model: DynamicsModel,
    samples: Samples,
    usual: Sequence[float],
    request: Request,
    state: DesignState,
) -> Judgement:
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
        without_noise = confidences_of(model, points, deviation, tolerances)
    confidences = tuple(
        replace(
            c,
            noise=float(w),
            sensor_noise=0.0 if one is None else one.deviation,
            past=past[i],
            prequential=scores_of(state.predictions[i], tolerances[i]) if state.predictions else None,
        )
        for i, (c, w, one) in enumerate(zip(without_noise, noise, sensors, strict=True))
    )
    candidates = candidates_of(model, points, request.states, generator_for(definition, f"visited {state.round}"))
    candidates = replace(candidates, reserved=ending(model, samples, candidates.points))
    settled = candidates.reserved is None or not definition.learns_termination
    peak = None
    if definition.design.stopping == "tested_confidence":
        peak = highest(
            model, samples, candidates.points, tolerances[-1], generator_for(definition, f"peak {state.round}")
        )
    if peak is not None:
        settled = False
        if candidates.reserved is None or state.round % 2:  # the two alternate
            candidates = with_reserved(candidates, peak)
    verdict = judge(definition, confidences, tolerances, len(samples), request, settled)
    return Judgement(confidences, tolerances, verdict, candidates)


def monte_carlo(definition: EnvironmentDefinition) -> tuple[Tensor, Tensor]:
    """Draw the Monte Carlo set of eq. 8, the same in every round: coordinates (m, C), actions (m, F)."""
    rng = generator_for(definition, "monte carlo")
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
    initial, cost = definition.design.initial, samples - request.free
    sure = all(c.confidence_index >= request.target for c in confidences)
    if definition.design.stopping == "tested_confidence":
        sure = sure and all(agrees(c, t) for c, t in zip(confidences, tolerances, strict=True))
        sure = sure and settled and cost + min(request.logged, initial) >= math.ceil(1.5 * initial)
        sure = sure and request.budget > 0
    if sure:
        return "ready"
    if request.budget == 0:
        return "from_log"
    return "continue" if cost < request.budget else "over_budget"


def agrees(confidence: OutputConfidence, tolerance: float) -> bool:
    """Whether an output's leave-one-out error is known and within its tolerance."""
    limit = SLACK * tolerance if confidence.noise else tolerance
    return confidence.leave_one_out_error is not None and confidence.leave_one_out_error <= limit


def outcome_of(judgement: Judgement, state: DesignState, request: Request, now: tuple[float, ...]) -> Verdict:
    """The verdict on a model, given how the design ended before.

    A design that was ready stays ready, unless a person has asked for more or the steps since then contradict it. A fit
    to more steps may lower a confidence index a little, although the model had predicted them all. Audits and logs
    don't make a design that has ended take further real steps.
    """
    if judgement.verdict in ("ready", "from_log"):
        return judgement.verdict
    if state.ended_as == "ready" and not _asks_more(now, state.ended_with) and not _contradicted(judgement, request):
        return "ready"
    if judgement.verdict == "continue" and (now == state.ended_with or request.is_mostly_refused(now[0])):
        return "unsure"
    return judgement.verdict


def _asks_more(now: tuple[float, ...], before: tuple[float, ...]) -> bool:
    """Whether budget or target have changed since the design ended, or a tolerance has become smaller."""
    smaller = any(new < old for new, old in zip(now[3:], before[3:], strict=True))
    return now[1:3] != before[1:3] or smaller


def _contradicted(judgement: Judgement, request: Request) -> bool:
    """Whether the errors of an output are larger than its tolerance: those of the predictions of the latest steps or,
    without any, the leave-one-out errors."""
    surprises = request.surprises
    for i, (confidence, tolerance) in enumerate(zip(judgement.confidences, judgement.tolerances, strict=True)):
        latest = surprises[i] if surprises else ()
        error = confidence.leave_one_out_error or 0.0
        if latest:
            error = math.sqrt(sum(one.error**2 for one in latest) / len(latest))
        if error > SLACK * tolerance:
            return True
    return False
