"""Algorithm 1 of the AUR paper (see docs/glossary.md): one function for its start, and one for each round.

Real steps take long, and samplers take them, so the algorithm is split where it waits for them:

=========  ============================================================  ==============================================
line       of Algorithm 1                                                where
=========  ============================================================  ==============================================
1          Latin hypercube of initial points                             ``initial_queries``
2, 11      run single steps in the original environment                  a sampler, ``surrogym_sampler.queries``
3, 4, 12   fit all processes to all data                                 ``advance``
5, 6, 13   confidence index (CI) of each process over Monte Carlo data   ``advance``
7          repeat                                                        ``services.designer``: one ``advance`` when no
                                                                         query is open: each was answered, refused, or
                                                                         set aside; or when a log has arrived
8, 9, 10   for each process below the target, select a point by U        ``advance``
14         until CI >= target                                            ``advance``, by its verdict
15         step function of the virtual environment                      ``virtual``
=========  ============================================================  ==============================================

A policy is trained in the virtual environment, by ``surrogym_trainer``. All functions here are pure: they receive
samples and state, and return a decision and the next state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples
from surrogym_server.models.guard import learn
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.acquisition import acquisition_of
from surrogym_server.sampling.confidence import OutputConfidence
from surrogym_server.sampling.judging import below_target, judge_model, takes_no_more_steps, verdict_with_history
from surrogym_server.sampling.latin_hypercube import going_on, latin_hypercube
from surrogym_server.sampling.rollouts import first_rollouts
from surrogym_server.sampling.round import Round
from surrogym_server.sampling.rules import ROLLOUT_RULES, STEP_RULES
from surrogym_server.sampling.seeds import generator_for
from surrogym_server.sampling.state import Conditions, DesignState, Request
from surrogym_server.sampling.tolerances import frozen_tolerances
from surrogym_server.sampling.way_to_end import way_to_end
from surrogym_shared.nouns import Query
from surrogym_shared.states import Verdict

# With more initial points only one Latin hypercube is drawn. Otherwise several are compared by the distances of all
# pairs of points, which takes much memory.
FEW_POINTS = 500


@dataclass(frozen=True)
class Decision:
    """Result of one round of the design: the model that was learned, how well it knows its O outputs, the verdict, and
    the next queries."""

    model: DynamicsModel
    confidences: tuple[OutputConfidence, ...]  # (O,) how well the model knows each output
    tolerances: tuple[float, ...]  # (O,) tolerance of each output: declared or default, widened by confirmed noise
    state: DesignState  # state to pass to the next round of the design
    verdict: Verdict
    queries: tuple[Query, ...]  # real steps that are requested before the next round of the design


def initial_queries(definition: EnvironmentDefinition, budget: int) -> Sequence[Query]:
    """Return the real steps to request (queries) before the first fit of a model, at most ``budget`` in total.

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
    return Points(*going_on(definition, *latin_hypercube(definition, steps, rng, tries), rng)).queries_on_demand


def advance(definition: EnvironmentDefinition, samples: Samples, state: DesignState, request: Request) -> Decision:
    """Do one round of Algorithm 1 of the paper: lines 3 to 6, 8 to 10 and 12 to 14. The module's docstring says where
    the other lines are.

    The paper fits models again after every real step (line 12). Here a round chooses several real steps to request
    (queries), each as if those chosen before had been answered (see ``batch.choose`` and ``rollouts.plan_round``). A
    query that is refused or set aside counts as closed, so the next round needs no sample of it.

    Comments in the code name preset "paper" beside the setting by which the preset changes a decision. ``tolerance``
    and ``acquisition`` can also be set alone, the stopping rule only by the preset.

    Args:
        definition: the environment, with the settings of its design.
        samples: results of all real steps so far from which a model can learn, those of logs and audits included.
        state: state that the previous round returned; ``DesignState()`` before the first round.
        request: budget and target of the design, and its queries without an answer.

    Raises:
        InvalidInput: too few samples to learn from.
        NumericalFailure: the fit fails on these samples.
        PluginFailed: code of the model family raised another error, or its model breaks the rules of ``models.port``.
        ChoiceFailed: the acquisition returned values of a wrong shape, or values that are not finite.
    """
    # Lines 3, 4 and 12: fit all processes to all samples: the transitions, the reward unless it is declared, and, not
    # in the paper, the termination unless it is declared.
    fit = learn(definition, samples, state.warm, request.prior)

    # The confidence index (CI) needs a tolerance for each output, (O,): the declared one, or a default. The setting
    # ``tolerance`` decides the default: 1 if it is "raw" (preset "paper"), or else 5 % of the output's standard
    # deviation in the first round. Later rounds may change a default (see ``tolerances``).
    defaults = frozen_tolerances(definition, samples, state.defaults)
    tolerances = definition.tolerances_or(defaults.values)

    # Lines 5, 6, 13, and the test of line 14. The judgement has the CI of each output over the Monte Carlo set; the
    # candidates for queries: part of that set, states that policies visited, and a peak of the reward; and a verdict on
    # this model alone: "ready", "continue", "over_budget", or "from_log" if the budget is 0 and it is not ready. Unless
    # the stopping rule is "confidence" (preset "paper"), ready needs more than the CI (see ``judging.judge``).
    # Tolerances are widened by confirmed noise here, because no error of a prediction can be expected below the noise.
    judgement = judge_model(fit.model, samples, tolerances, request, state)

    # The verdict on the design. It is ready whenever its model satisfies the stopping rule. Otherwise a design that was
    # ready stays so, unless budget or target have changed, a tolerance became smaller, or prediction errors of new
    # samples contradict the model. A design that has ended and is not ready takes no further steps until its conditions
    # change, the cost included; it is "unsure" if budget is left. ``request.cost`` leaves out steps of logs and audits.
    conditions = Conditions(request.cost(len(samples)), request.budget, request.target, tolerances)
    verdict = verdict_with_history(judgement, state, request, conditions)

    # Not in the paper: if the environment has snapshots, a design about to be ready first takes an excursion: an action
    # sequence beyond the sampled states that tests the model. If it may take no steps for it, it ends not ready. If the
    # environment can only be reset, the design first takes a sequence to a declared end of the episode that no sample
    # has shown, as long as the rest of the budget is enough to reach it.
    testing = verdict == "ready" and _lacks_excursion(definition, conditions, state)
    if testing and takes_no_more_steps(state, request, conditions):
        verdict, testing = "unsure", False
    if verdict == "ready" and not testing and state.ended_as != "ready":
        room, rng = request.budget - request.cost(len(samples)), generator_for(definition, f"end {state.round}")
        testing = way_to_end(fit.model, samples, room, rng) is not None
    tested_at = state.tested_at if verdict == "ready" else 0
    continues = verdict == "continue" or testing

    # Line 8, "for each process with CI < target": the indices of the outputs with CI < target, the least confident
    # first. If there are none, only the output with the lowest CI.
    outputs = below_target(judgement.confidences, request.target)

    # Lines 9 and 10: the first rule that does not return None chooses the queries. For single steps the last rule is
    # the paper's: for each index in ``outputs``, query the candidate with the largest value of the acquisition, which
    # is U if the setting ``acquisition`` is "uncertainty_index" (preset "paper"). Unlike the paper, under every preset,
    # no candidate close to an earlier query is chosen, and the first query is a reserved candidate, if there are any,
    # so that an end of an episode gets sampled. For rollouts, the last rule plans action sequences in the model,
    # without candidates, whose value is summed over ``outputs``. The rules before the last one are not in the paper,
    # such as repeated steps, which show what is noise. A design that has ended chooses only ``request.extra`` steps.
    round = Round(state.round, fit.model, samples, request, judgement, tolerances, outputs, continues, testing)
    rules = STEP_RULES if definition.max_rollout is None else ROLLOUT_RULES
    queries = next(choice for rule in rules if (choice := rule(round)) is not None)
    if testing and queries:
        tested_at = conditions.cost
    if continues:
        verdict = _verdict_with(queries, round)

    # The state that the next round needs. A design with extra queries has not ended, unless it is ready. A design that
    # has ended continues if its conditions change.
    ended = verdict == "ready" or (verdict != "continue" and not queries)
    following = DesignState(
        round=state.round + 1,
        defaults=defaults,
        warm=fit.warm,
        ended_under=conditions if ended else None,
        ended_as=verdict if ended else "",
        tested_at=tested_at,
    )
    return Decision(fit.model, judgement.confidences, judgement.widened_tolerances, following, verdict, queries)


def _verdict_with(queries: tuple[Query, ...], round: Round) -> Verdict:
    """Return the verdict on a design that may continue: "continue" if a query was chosen or an earlier query may still
    be answered, otherwise "unsure", or "over_budget" if the budget is spent.

    No query is chosen in two cases. Either the budget that remains, without the steps of queries that were set aside,
    is too small. Or each candidate is close to an earlier query or would teach nothing, because its step is predicted
    to end at a bound or to end the episode.
    """
    if queries or round.request.open:
        return "continue"
    return "unsure" if round.cost < round.request.budget else "over_budget"


def _lacks_excursion(definition: EnvironmentDefinition, conditions: Conditions, state: DesignState) -> bool:
    """Return whether a design whose model satisfies the stopping rule still has to be tested by an excursion (see
    ``sampling.excursions``).

    It has to if the stopping rule is ``tested_confidence``, if the environment has snapshots, if the design did not
    end as ready in the previous round, and if no excursion was planned yet or none was answered: the design has taken
    no real step since the last excursion was planned. Samples of logs and audits don't count, because they may be
    anywhere.
    """
    if not definition.snapshots or definition.design.stopping != "tested_confidence" or state.ended_as == "ready":
        return False
    return not state.tested_at or conditions.cost <= state.tested_at
