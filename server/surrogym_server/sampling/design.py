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
from surrogym_shared.nouns import Query
from surrogym_shared.states import Verdict

FEW_POINTS = 500  # points above which only one Latin hypercube is made, because comparing all pairs takes much memory


@dataclass(frozen=True)
class Decision:
    """Result of a round: a model, its judgement, and the next queries. O outputs."""

    model: DynamicsModel
    confidences: tuple[OutputConfidence, ...]  # (O,) one for each output
    tolerances: tuple[float, ...]  # (O,) that the verdict is based on
    state: DesignState
    verdict: Verdict
    queries: tuple[Query, ...]  # the next queries


def initial_queries(definition: EnvironmentDefinition, budget: int) -> tuple[Query, ...]:
    """Return the queries before the first fit, with at most ``budget`` real steps in all.

    They are a Latin hypercube, or random rollouts if the environment can't be set to any state.
    """
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
        InvalidInput, NumericalFailure: from ``Learner.learn``.
        PluginFailed: the family of models raised another error, or its model can't be used.
        ChoiceFailed: the acquisition returned values of a wrong shape, or that are not finite.
    """
    # Fit the model to all samples.
    fit = learn(definition, samples, state.warm)
    default = frozen_tolerances(definition, samples, Usual(state.usual, state.ranges))

    # Judge it: may the design end?
    judgement = judge_model(fit.model, samples, default.tolerances, request, state)
    tolerances = definition.tolerances_over(default.tolerances)
    now = (float(len(samples) - request.free), float(request.budget), request.target, *tolerances)
    outcome = outcome_of(judgement, state, request, now)
    testing = outcome == "ready" and _is_untested(definition, samples, state)

    # Choose the next queries.
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
    """Return the queries of the first rule that applies. The last rule always applies."""
    rules = STEP_RULES if round.definition.max_rollout is None else ROLLOUT_RULES
    return next(queries for rule in rules if (queries := rule(round)) is not None)


def _verdict(round: Round, outcome: Verdict, queries: tuple[Query, ...]) -> Verdict:
    """Decide the verdict of a round.

    It is the outcome of the judgement. But a design that could continue ends, if no query was chosen and none is
    open: no distinct query is left, or the budget has no real steps left for one.
    """
    if not round.continues:
        return outcome
    if queries or round.request.open:
        return "continue"
    return "unsure" if round.cost < round.request.budget else "over_budget"


def _is_untested(definition: EnvironmentDefinition, samples: Samples, state: DesignState) -> bool:
    """Whether a design with snapshots, which would be ready, has to take an excursion first.

    It has to unless a step was taken since an excursion was planned.
    """
    if not definition.snapshots or definition.design.stopping != "tested_confidence":
        return False
    return not state.tested_at or len(samples) <= state.tested_at
