"""Judge a model: how well it knows each output, whether the design has to continue, and candidates for queries."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples
from surrogym_server.models.guard import plugin_calls, require_stds
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.candidates import Candidates, candidates_of, with_reserved
from surrogym_server.sampling.confidence import OutputConfidence, confidences_of, stds
from surrogym_server.sampling.endings import ending
from surrogym_server.sampling.latin_hypercube import going_on, random_points
from surrogym_server.sampling.noise import SLACK, established_noise, widened_by
from surrogym_server.sampling.past import owed_to_past
from surrogym_server.sampling.reward_peaks import highest
from surrogym_server.sampling.seeds import generator_for
from surrogym_server.sampling.sensor_noise import noise_of_sensors, sensor_noise
from surrogym_server.sampling.state import Conditions, DesignState, Request
from surrogym_shared.states import Verdict


@dataclass(frozen=True)
class Judgement:
    """Judgement of a model with O outputs: how well it knows each, the verdict that follows, and the candidates for the
    next queries."""

    confidences: tuple[OutputConfidence, ...]  # (O,) how well the model knows each output
    # (O,) tolerances with which the confidences were computed: sqrt(tolerance^2 + noise^2), with the confirmed noise.
    widened_tolerances: tuple[float, ...]
    verdict: Verdict  # verdict that follows from this model alone, without regard to earlier rounds of the design
    candidates: Candidates  # points from which the next queries are chosen


def judge_model(
    model: DynamicsModel,
    samples: Samples,
    tolerances: Sequence[float],
    request: Request,
    state: DesignState,
) -> Judgement:
    """Compute a model's confidences, its verdict, and the candidates for the next queries.

    The candidates are up to 4,096 points of the Monte Carlo set, with states that policies visited, and a point at
    which the reward may be highest. Some may be reserved for the first query (see ``endings.ending``): under every
    preset those at which an episode may end, and, if the model and the stopping rule look for them, those at a jump or
    peak of the reward.

    Args:
        model: the model of this round.
        samples: the samples that the model has learned from.
        tolerances: tolerance of each output (O,), in its unit.
        request: budget and target of the design.
        state: result of the previous round.

    Raises:
        PluginFailed: code of the model's family failed.
    """
    definition = model.definition
    with plugin_calls(definition):
        past = owed_to_past(model, samples, tolerances)
        sensors = tuple(None if any(past) else one for one in sensor_noise(model, samples, tolerances))
        of_sensors = noise_of_sensors(model, samples, sensors, tolerances)
        noise = established_noise(model, samples, tolerances).maximum(of_sensors)
        # If earlier steps explain errors of any output, there is a hidden state, which may influence every output. Then
        # differences between repeated steps are no evidence of noise.
        if any(past):
            noise = torch.zeros_like(noise)
    widened = widened_by(noise, tolerances)
    points = Points(*monte_carlo(definition))
    with plugin_calls(definition):
        std = stds(model, points.q, points.u)
        require_stds(model, std)
        without_noise = confidences_of(model, points, std, widened)
    confidences = tuple(
        replace(
            c,
            noise=float(w),
            sensor_noise=0.0 if one is None else one.std,
            past=past[i],
        )
        for i, (c, w, one) in enumerate(zip(without_noise, noise, sensors, strict=True))
    )
    candidates = candidates_of(model, points, request.states, generator_for(definition, f"visited {state.round}"))
    candidates = replace(candidates, reserved=ending(model, samples, candidates.points))
    settled = candidates.reserved is None or not definition.learns_termination
    peak = None
    if definition.design.stopping == "tested_confidence":
        rng = generator_for(definition, f"peak {state.round}")
        peak = highest(model, samples, candidates.points, widened[-1], rng)
    if peak is not None:
        settled = False
        # If both ends of episodes and a peak of the reward need queries, even rounds query ends, odd rounds the peak.
        if candidates.reserved is None or state.round % 2:
            candidates = with_reserved(candidates, peak)
    verdict = judge(definition, confidences, widened, len(samples), request, settled)
    return Judgement(confidences, widened, verdict, candidates)


def monte_carlo(definition: EnvironmentDefinition) -> tuple[Tensor, Tensor]:
    """Draw the Monte Carlo set of eq. 8: random points over which the confidence index is averaged. It is drawn from
    the declared sampling distributions and the action space, and is the same in every round. Return coordinates (m, C)
    and actions (m, F)."""
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
    """Return the verdict on a model: "ready", "continue", "over_budget" if the budget is spent, or "from_log" if the
    budget is 0.

    A design is ready if the confidence index of every output has reached the target. With the stopping rule
    ``tested_confidence`` the budget must also be above 0, and three more conditions have to be met: leave-one-out
    errors are known and within the tolerances; ends of episodes and peaks of the reward are known; and at least half as
    many adaptive steps as initial ones were taken. Logged steps count as initial ones, because they were not chosen to
    disprove the model.

    Args:
        definition: the environment, with the settings of its design.
        confidences: confidence of each output, (O,).
        tolerances: tolerance of each output, (O,).
        samples: number of samples.
        request: budget and target of the design.
        settled: whether no doubt is left about terminations and peaks of the reward.
    """
    initial, cost = definition.design.initial, request.cost(samples)
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
    """Return whether the leave-one-out error of an output is known and within the tolerance, or within 1.25 times the
    tolerance if the output has confirmed noise."""
    limit = SLACK * tolerance if confidence.noise else tolerance
    return confidence.leave_one_out_error is not None and confidence.leave_one_out_error <= limit


def below_target(confidences: Sequence[OutputConfidence], target: float) -> list[int]:
    """Return the indices of the outputs whose confidence index is below the target, the lowest first. If all reach the
    target, return only the index of the output with the lowest confidence index."""
    index = [confidence.confidence_index for confidence in confidences]
    order = sorted(range(len(index)), key=index.__getitem__)
    return [i for i in order if index[i] < target] or order[:1]


def verdict_with_history(judgement: Judgement, state: DesignState, request: Request, conditions: Conditions) -> Verdict:
    """Return the verdict on a design, given the verdict on its present model and how the design ended in an earlier
    round, if it did.

    A design that was ready stays ready, unless a person has changed its budget or target or reduced a tolerance, or
    errors contradict the model: those with which the previous model predicted the new samples, or, if there are none,
    leave-one-out errors. Without this rule, a design could lose its readiness because a fit to further steps lowers the
    confidence index a little, although the model had predicted these steps well. Other designs that have ended don't
    continue only because audits or logs have added samples. They are "unsure" if budget is left.

    Args:
        judgement: judgement of the present model.
        state: result of the previous round.
        request: budget and target of the design.
        conditions: conditions of the present round (such as budget and target). The design may continue if they differ
            from those under which it ended.
    """
    if judgement.verdict in ("ready", "from_log"):
        return judgement.verdict
    before = state.ended_under
    if state.ended_as == "ready" and not _asks_more(conditions, before) and not _contradicted(judgement, request):
        return "ready"
    if judgement.verdict == "continue" and takes_no_more_steps(state, request, conditions):
        return "unsure"
    return judgement.verdict


def takes_no_more_steps(state: DesignState, request: Request, conditions: Conditions) -> bool:
    """Return whether a design that is not ready takes no further steps although its budget is not spent: its conditions
    are those under which it ended, or the environment refused too many steps."""
    stopped = conditions == state.ended_under or request.is_mostly_refused(conditions.cost)
    return stopped and conditions.cost < request.budget


def _asks_more(now: Conditions, before: Conditions | None) -> bool:
    """Return whether a person has changed the budget or the target, or reduced a tolerance, since the design ended."""
    if before is None:
        return True
    smaller = any(new < old for new, old in zip(now.tolerances, before.tolerances, strict=True))
    return (now.budget, now.target) != (before.budget, before.target) or smaller


def _contradicted(judgement: Judgement, request: Request) -> bool:
    """Return whether the recent prediction errors of any output exceed 1.25 times its tolerance, as root mean square.

    Recent errors are those with which the previous model predicted the newest samples. If there are no new samples,
    leave-one-out errors are used.
    """
    surprises = request.surprises
    for i, (confidence, tolerance) in enumerate(zip(judgement.confidences, judgement.widened_tolerances, strict=True)):
        latest = surprises[i] if surprises else ()
        error = confidence.leave_one_out_error or 0.0
        if latest:
            error = math.sqrt(sum(one**2 for one in latest) / len(latest))
        if error > SLACK * tolerance:
            return True
    return False
