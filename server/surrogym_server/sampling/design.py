"""Algorithm 1, a round at a time: fit the model, judge it, choose the next queries.

Pure: samples and state in, decision and state out.
"""

from __future__ import annotations

from dataclasses import dataclass

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples
from surrogym_server.models.guard import learn
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.acquisition import acquisition_of
from surrogym_server.sampling.confidence import OutputConfidence
from surrogym_server.sampling.judging import judge_model, outcome_of
from surrogym_server.sampling.latin_hypercube import going_on, latin_hypercube
from surrogym_server.sampling.rollouts import first_rollouts
from surrogym_server.sampling.round import Round
from surrogym_server.sampling.rules import ROLLOUT_RULES, STEP_RULES
from surrogym_server.sampling.seeds import generator_for
from surrogym_server.sampling.state import DesignState, Request
from surrogym_server.sampling.tolerances import Usual, frozen_tolerances
from surrogym_shared.nouns import Query, Verdict

FEW_POINTS = 500  # more points leave no large gap, and comparing all pairs takes memory in the square of their number


@dataclass(frozen=True)
class Decision:
    """What a round decides. O outputs."""

    model: DynamicsModel
    confidences: tuple[OutputConfidence, ...]  # per output
    tolerances: tuple[float, ...]  # (O,) used for the verdict
    state: DesignState
    verdict: Verdict
    queries: tuple[Query, ...]  # next ones


def initial_queries(definition: EnvironmentDefinition, budget: int) -> tuple[Query, ...]:
    """Return the queries before the first fit, with at most ``budget`` real steps: a Latin hypercube, or random
    rollouts if the environment can't be set to any state."""
    adaptive = acquisition_of(definition.design.acquisition).adaptive
    steps = min(definition.design.initial, budget) if adaptive else budget
    rng = generator_for(definition, "initial")
    if definition.max_rollout is not None:
        return first_rollouts(definition, steps, rng)
    if not steps:
        return ()
    tries = 1 if steps > FEW_POINTS else definition.design.hypercube_tries
    return Points(*going_on(definition, *latin_hypercube(definition, steps, rng, tries), rng)).queries


def advance(definition: EnvironmentDefinition, samples: Samples, state: DesignState, request: Request) -> Decision:
    """Do one round of Algorithm 1.

    Raises:
        InvalidInput, NumericalFailure: as ``Learner.learn`` does.
        PluginFailed: the family of models raised anything else, or its model can't be used.
        ChoiceFailed: the acquisition broke its laws.
    """
    # Fit.
    fit = learn(definition, samples, state.warm)
    default = frozen_tolerances(definition, samples, Usual(state.usual, state.ranges))

    # Judge.
    judgement = judge_model(fit.model, samples, default.tolerances, request, state)
    tolerances = definition.tolerances_over(default.tolerances)
    now = (float(len(samples) - request.free), float(request.budget), request.target, *tolerances)
    outcome = outcome_of(judgement, state, request, now)
    testing = outcome == "ready" and _is_untested(definition, samples, state)

    # Choose.
    continues = outcome == "continue" or testing
    round = Round(state.round, fit.model, samples, request, judgement, default.tolerances, continues, testing)
    queries = _choose(round)
    verdict = _verdict(round, outcome, queries)

    ended = verdict != "continue" and not queries
    tested_at = len(samples) if testing else state.tested_at
    following = DesignState(
        round=state.round + 1,
        usual=default.tolerances,
        ranges=default.ranges,
        warm=fit.warm,
        ended_with=now if ended else (),
        ended_as=verdict if ended else "",
        predictions=state.predictions,
        tested_at=tested_at if outcome == "ready" else 0,
    )
    return Decision(fit.model, judgement.confidences, judgement.tolerances, following, verdict, queries)


def _choose(round: Round) -> tuple[Query, ...]:
    """Let the first rule that applies choose the queries. The last rule of each kind always applies."""
    rules = STEP_RULES if round.definition.max_rollout is None else ROLLOUT_RULES
    return next(queries for rule in rules if (queries := rule(round)) is not None)


def _verdict(round: Round, outcome: Verdict, queries: tuple[Query, ...]) -> Verdict:
    """Decide the verdict of a round: the outcome of its judgement, unless the design may continue.

    A design that may continue can't if it has nothing to ask and nothing to wait for: no distinct query is left,
    unanswered queries hold the rest of the budget, or there is no rest.
    """
    if not round.continues:
        return outcome
    if queries or round.request.open:
        return "continue"
    return "unsure" if round.cost < round.request.budget else "over_budget"


def _is_untested(definition: EnvironmentDefinition, samples: Samples, state: DesignState) -> bool:
    """Whether a design that would be ready needs an excursion first: it has snapshots, and no step was taken since one
    was planned."""
    if not definition.snapshots or definition.design.stopping != "tested_confidence":
        return False
    return not state.tested_at or len(samples) <= state.tested_at
