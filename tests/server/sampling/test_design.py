"""The rounds of Algorithm 1: what is asked first, when it is enough, what is asked next, and on whose budget."""

import gc
import json
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from support.real_steps import answer, arrays, join, random_steps
from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition, wrap
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples
from surrogym_server.models.guard import learn
from surrogym_server.sampling import batch
from surrogym_server.sampling.batch import NEAR, nearest
from surrogym_server.sampling.confidence import OutputConfidence
from surrogym_server.sampling.design import Decision, advance, initial_queries
from surrogym_server.sampling.judging import judge, monte_carlo
from surrogym_server.sampling.state import DesignState, Request
from surrogym_server.sampling.tolerances import DefaultTolerances, default_tolerances, sizes_of
from surrogym_shared.spec import Design, EnvironmentSpec

NEVER = DesignState(1, DefaultTolerances((1e-12,) * 3))  # tolerances that no model reaches


def designed(**design: object) -> EnvironmentSpec:
    return pendulum().model_copy(update={"design": Design(**design)})


def request(budget: int = 20, pending: Samples | None = None, **options: object) -> Request:
    return Request(budget, 0.999, () if pending is None else Points(pending.q, pending.u).queries, **options)


def defaults_of(definition: EnvironmentDefinition, samples: Samples) -> tuple[float, ...]:
    return default_tolerances(definition, sizes_of(definition, samples))


def first(samples: Samples, count: int) -> Samples:
    return Samples(*(getattr(samples, name)[:count] for name in samples.__dataclass_fields__))


def near(definition: EnvironmentDefinition, asked: Points, taken: Points) -> torch.Tensor:
    return nearest(definition, asked, taken) < NEAR


@dataclass
class Finished:
    samples: Samples
    initial: int
    decisions: list[Decision]


def design(spec: EnvironmentSpec, budget: int, state: DesignState | None = None) -> Finished:
    """Rounds until the verdict, every query answered by the real environment."""
    definition = definition_from_spec(spec)
    samples, state = answer(spec, *arrays(initial_queries(definition, budget))), state or DesignState()
    finished = Finished(samples, len(samples), [])
    while True:
        decision = advance(definition, finished.samples, state, request(budget))
        finished.decisions.append(decision)
        if decision.verdict != "continue":
            return finished
        state = DesignState.from_json(json.loads(json.dumps(decision.state.to_json())))
        finished.samples = join(finished.samples, answer(spec, *arrays(decision.queries)))


@pytest.mark.parametrize("seed", [0, 1])
def test_the_design_learns_the_pendulum_within_twenty_real_steps(seed, unseen):
    finished = design(designed(seed=seed), budget=20)
    last = finished.decisions[-1]
    assert last.verdict == "ready"
    assert len(finished.samples) <= 20
    assert len(finished.samples) - finished.initial >= len(finished.samples) / 3, "a third of them adaptive"
    assert len(last.queries) == 0
    predicted = last.model.transition(unseen.q, unseen.u)
    q_next, reward = predicted.q_next, predicted.reward
    error = torch.cat([q_next - unseen.q_next, (reward - unseen.reward)[:, None]], 1)
    error[:, 0] = wrap(error[:, 0])
    tolerances = torch.tensor(last.tolerances)
    assert torch.all(error.abs().quantile(0.95, 0) < tolerances)
    assert torch.all(error.square().mean(0).sqrt() < tolerances)


def test_default_tolerances_are_frozen_after_the_first_design_round(definition, few):
    one = advance(definition, first(few, 4), DesignState(), request()).state
    spread = torch.tensor([float(few.reward[:4].std(correction=0))])
    assert one.defaults.values[2] == pytest.approx(0.05 * float(spread))
    two = advance(definition, random_steps(pendulum(), 8, seed=2), one, request()).state
    assert two.defaults == one.defaults
    assert (one.round, two.round) == (1, 2)
    assert set(one.warm) <= set(two.warm)


def test_a_design_state_survives_json(definition, few):
    state = advance(definition, few, DesignState(), request()).state
    again = DesignState.from_json(json.loads(json.dumps(state.to_json())))
    assert (again.round, again.defaults) == (state.round, state.defaults)
    assert all(np.array_equal(again.warm[key], state.warm[key]) for key in state.warm)
    assert DesignState.from_json({}) == DesignState()


def test_the_design_uses_its_whole_budget_and_never_more():
    spec = designed(monte_carlo=64)
    finished = design(spec, budget=7, state=NEVER)
    assert finished.decisions[-1].verdict == "over_budget"
    assert len(finished.samples) == 7
    assert len(initial_queries(definition_from_spec(spec), 3)) == 3


def test_pending_queries_count_against_the_design_budget(definition, few, unseen):
    chosen = [
        len(advance(definition, few, NEVER, request(len(few) + 2, first(unseen, p))).queries) for p in (0, 1, 2, 3)
    ]
    assert chosen == [2, 1, 0, 0]


def test_the_design_does_not_choose_pending_queries_again(definition, few):
    asked = advance(definition, few, NEVER, request()).queries
    again = advance(definition, few, NEVER, replace(request(), pending=asked)).queries
    assert len(again) == 3
    assert not near(definition, Points.of(definition, again), Points.of(definition, asked)).any()


def test_a_design_round_chooses_one_distinct_query_per_uncertain_output(definition, few):
    made = advance(definition, few, NEVER, request())
    asked = Points.of(definition, made.queries)
    assert len(asked) == 3
    for i in range(3):
        others = [j for j in range(3) if j != i]
        assert not near(definition, asked[i : i + 1], asked[others]).any()
    assert not near(definition, asked, Points(few.q, few.u)).any()


def test_the_design_chooses_no_queries_for_certain_outputs(definition, few):
    generous = DesignState(1, DefaultTolerances((1e3, 1e3, 1e-12)))
    assert len(advance(definition, few, generous, request()).queries) == 1


def test_the_design_ends_unsure_if_no_distinct_query_is_left():
    spec = designed(monte_carlo=16)
    definition = definition_from_spec(spec)
    samples = answer(spec, *monte_carlo(definition))
    made = advance(definition, samples, NEVER, request(100))
    assert len(made.queries) == 0
    assert made.verdict == "unsure", "84 steps of its budget are left"


@pytest.mark.parametrize(("budget", "verdict"), [(20, "ready"), (4, "ready")])
def test_requested_extra_queries_are_chosen_even_if_the_design_has_ended(definition, few, unseen, budget, verdict):
    generous = DesignState(1, DefaultTolerances((1e3,) * 3))
    made = advance(definition, join(few, first(unseen, 4)), generous, request(budget, extra=5))
    assert made.verdict == verdict
    assert len(made.queries) == 5


def test_the_design_first_queries_a_step_that_terminates_the_episode():
    spec = cartpole()
    definition = definition_from_spec(spec)
    steps = random_steps(spec, 60, seed=0)
    going = Samples(*(getattr(steps, n)[~steps.terminated][:8] for n in steps.__dataclass_fields__))
    state = DesignState(1, DefaultTolerances((1e-12,) * 5))
    made = advance(definition, going, state, Request(50, 0.999))
    q, u = arrays(made.queries)
    assert bool(definition.terminated(made.model.transition(q, u).q_next)[0])
    assert not bool(definition.terminated(q)[0])


def test_a_design_round_repeated_on_equal_data_chooses_equal_queries(definition, few, monkeypatch):
    monkeypatch.setattr("surrogym_server.sampling.design.learn", learn)
    one, two = (advance(definition, few, DesignState(), request()) for _ in range(2))
    assert one.queries == two.queries


def test_another_design_seed_gives_other_initial_queries():
    one, same, other = (list(initial_queries(definition_from_spec(designed(seed=s)), 20)) for s in (0, 0, 1))
    assert one == same
    assert one != other


def test_preset_paper_has_ten_initial_queries_per_dimension_and_tolerance_one():
    definition = definition_from_spec(designed(preset="paper"))
    q, u = arrays(initial_queries(definition, 125))
    assert len(q) == len(u) == 10 * (3 + 1)
    samples = answer(pendulum(), q, u)
    assert defaults_of(definition, samples) == (1.0,) * 4
    made = advance(definition, samples, DesignState(), request(125))
    assert [c.confidence_index for c in made.confidences] == [c.confidence_index_paper for c in made.confidences]


def test_preset_paper_can_use_tolerances_relative_to_the_output_deviation():
    definition = definition_from_spec(designed(preset="paper", tolerance="relative"))
    samples = random_steps(pendulum(), 40, seed=0)
    change = definition.observe(samples.q_next) - definition.observe(samples.q)
    spread = torch.cat([change, samples.reward[:, None]], -1).std(0, correction=0)
    assert defaults_of(definition, samples) == pytest.approx((0.05 * spread).tolist())
    default = definition_from_spec(designed(tolerance="raw"))
    assert defaults_of(default, samples) == (1.0,) * 3


def test_a_latin_hypercube_design_spends_its_whole_budget_on_initial_queries():
    definition = definition_from_spec(designed(acquisition="latin_hypercube"))
    assert len(initial_queries(definition, 17)) == 17


def test_30000_initial_queries_are_made_without_comparing_all_pairs():
    """A spec may ask for 100,000 initial queries; the distances of all pairs would take 40 GB."""
    q, u = arrays(initial_queries(definition_from_spec(designed(initial=30_000)), 30_000))
    assert q.shape == (30_000, 2)
    assert u.shape == (30_000, 1)


def test_choosing_extra_queries_stops_once_no_distinct_candidate_is_left(definition, few, monkeypatch):
    """Once nothing distinct is left, nothing more is computed for the rest of an ``improve`` of thousands."""
    calls = []

    def counted(*arguments):
        calls.append(1)
        return judged(*arguments)

    judged = batch.candidate_view
    monkeypatch.setattr(batch, "candidate_view", counted)
    small = replace(definition, design=replace(definition.design, monte_carlo=64))
    decision = advance(small, few, DesignState(), request(budget=len(few), extra=10_000))
    assert len(decision.queries) <= len(calls) <= 64


def test_tolerances_of_the_specification_replace_the_defaults(few):
    definition = definition_from_spec(pendulum().model_copy(update={"tolerances": {"speed": 0.5}}))
    defaults = defaults_of(definition, few)
    assert definition.tolerances_or(defaults) == (defaults[0], 0.5, defaults[2])
    assert defaults[1] != 0.5
    assert advance(definition, few, DesignState(), request()).tolerances == definition.tolerances_or(defaults)


def test_the_default_tolerance_of_a_constant_output_is_relative_to_its_mean(definition, few):
    still = replace(few, reward=torch.ones_like(few.reward))
    assert defaults_of(definition, still)[2] == pytest.approx(0.05)


def test_a_tolerance_set_later_overrides_the_frozen_one_until_it_is_removed(definition, few):
    frozen = DesignState(1, DefaultTolerances((0.5, 0.5, 0.5)))
    made = advance(definition.with_tolerances({"speed": 1e-12}), few, frozen, request())
    assert made.tolerances == (0.5, 1e-12, 0.5)
    assert made.confidences[1].confidence_index < 0.999
    back = advance(definition, few, made.state, request())
    assert back.tolerances == (0.5, 0.5, 0.5)
    assert back.confidences[1].confidence_index > 0.999


def test_tolerances_in_the_specification_must_name_outputs_of_the_preset():
    """Preset ``paper`` moves the observation: it has no error in an angle to compare with a tolerance."""
    design = Design(preset="paper", initial=10)
    spec = EnvironmentSpec.model_validate(pendulum().model_dump() | {"tolerances": {"cos": 0.02}, "design": design})
    definition = definition_from_spec(spec)
    assert definition.tolerances_or(defaults_of(definition, random_steps(spec, 10, seed=0))) == (0.02, 1.0, 1.0, 1.0)
    with pytest.raises(ValueError, match=r"'theta'.*\['cos', 'sin', 'speed', 'reward'\]"):
        EnvironmentSpec.model_validate(pendulum().model_dump() | {"tolerances": {"theta": 0.02}, "design": design})


@pytest.mark.parametrize("outputs", ["all of it", "its reward"])
def test_a_design_whose_outputs_never_vary_becomes_ready(outputs):
    """An output that never varied has no deviation to choose queries by; the design is ready all the same."""
    spec = designed(initial=4, monte_carlo=64)
    definition = definition_from_spec(spec)
    state, samples = DesignState(), still(answer(spec, *arrays(initial_queries(definition, 20))), outputs)
    for _ in range(20):
        made = advance(definition, samples, state, request())
        if made.verdict != "continue":
            break
        samples, state = join(samples, still(answer(spec, *arrays(made.queries)), outputs)), made.state
    assert made.verdict == "ready"
    assert 6 <= len(samples) < 20
    assert made.confidences[2].confidence_index == 1


def still(steps: Samples, outputs: str) -> Samples:
    q_next = steps.q if outputs == "all of it" else steps.q_next
    return replace(steps, q_next=q_next, reward=torch.ones_like(steps.reward))


SURE = OutputConfidence(0.9995, 0.9995, 1.0, 0.5, 0.68, 0.95)
UNSURE = replace(SURE, confidence_index=0.9985)
SURPRISED = replace(SURE, leave_one_out_error=1.5)
UNTESTED = replace(SURE, leave_one_out_error=None)


@pytest.mark.parametrize(
    ("preset", "confidences", "samples", "verdict"),
    [
        ("default", (SURE, SURE, SURE), 15, "ready"),
        ("default", (SURE, UNSURE, SURE), 15, "continue"),
        ("default", (SURE, SURPRISED, SURE), 15, "continue"),
        ("default", (SURE, UNTESTED, SURE), 15, "continue"),
        ("default", (UNTESTED, UNTESTED, UNTESTED), 20, "over_budget"),
        ("default", (SURE, SURE, SURE), 14, "continue"),
        ("default", (SURE, UNSURE, SURE), 20, "over_budget"),
        ("default", (SURE, SURE, SURE), 20, "ready"),
        ("paper", (SURE, SURPRISED, SURE), 10, "ready"),
        ("paper", (UNTESTED, UNTESTED, UNTESTED), 10, "ready"),
        ("paper", (SURE, UNSURE, SURE), 10, "continue"),
        ("paper", (SURE, UNSURE, SURE), 21, "over_budget"),
    ],
)
def test_the_design_verdict_follows_from_confidences_samples_and_budget(preset, confidences, samples, verdict):
    definition = definition_from_spec(designed(preset=preset, initial=10))
    assert math.ceil(1.5 * 10) == 15
    assert judge(definition, confidences, (1.0,) * 3, samples, request(20)) == verdict


@pytest.mark.parametrize("acquisition", ["uncertainty_index", "integrated_variance"])
def test_the_design_prefers_queries_near_states_visited_by_policies(acquisition):
    """Or where those would have gone that are their mirror images, which tells as much."""
    spec = designed(seed=0, initial=5, acquisition=acquisition)
    definition = definition_from_spec(spec)
    samples = answer(spec, *arrays(initial_queries(definition, 5)))
    visited = torch.tensor([[2.0, 6.0]], dtype=torch.float64) + 0.2 * torch.randn(
        400, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    wide = advance(definition, samples, NEVER, request())
    near_them = advance(definition, samples, NEVER, request(states=visited))
    assert len(near_them.queries) == len(wide.queries) == 3
    there = torch.tensor([[[2.0, 6.0]], [[-2.0, -6.0]]])
    distance, anywhere = ((arrays(made.queries)[0] - there).abs().amax(-1).amin(0) for made in (near_them, wide))
    assert int((distance < 1).sum()) >= 2
    assert int((anywhere < 1).sum()) == 0


def test_an_ended_design_chooses_no_queries_after_an_audit(definition, few):
    first = advance(definition, few, DesignState(), request(budget=len(few)))
    assert first.verdict == "over_budget"
    state = DesignState.from_json(first.state.to_json())
    audited = replace(request(budget=len(few) + 8), audited=0)
    assert advance(definition, few, state, audited).queries, "another budget opens it again"
    more = random_steps(pendulum(), len(few) + 4, seed=0)
    same = replace(request(budget=len(few)), audited=4)
    after = advance(definition, more, state, same)
    assert (after.verdict, len(after.queries)) == ("over_budget", 0)
    open_again = advance(definition, more, replace(state, ended_under=None), replace(same, budget=len(few) + 8))
    assert open_again.queries


GENEROUS = 1e3  # tolerance of each output
BEYOND = 1.1  # no index reaches this target
LEARNED, AUDITED = 8, 4  # samples


def ready() -> Decision:
    """A design that ended as ready, long before its budget was spent."""
    definition, samples = definition_from_spec(designed(initial=4)), random_steps(pendulum(), LEARNED, seed=0)
    made = advance(definition, samples, DesignState(1, DefaultTolerances((GENEROUS,) * 3)), request(budget=100))
    assert made.verdict == "ready"
    return made


def after_audit(before: Decision, errors: float, budget: int = 100) -> Decision:
    """The round after an audit, whose fit leaves the index below the target.

    ``errors``: of each prediction by the last model, in tolerances.
    """
    state = DesignState.from_json(json.loads(json.dumps(before.state.to_json())))
    assert state.ended_under is not None
    state = replace(state, ended_under=replace(state.ended_under, target=BEYOND))
    surprises = ((errors * GENEROUS,) * AUDITED,) * 3
    asked = replace(request(budget, surprises=surprises, audited=AUDITED), target=BEYOND)
    after = advance(before.model.definition, random_steps(pendulum(), LEARNED + AUDITED, seed=0), state, asked)
    assert min(c.confidence_index for c in after.confidences) < BEYOND
    return after


def test_a_ready_design_stays_ready_after_audit_steps_within_tolerance():
    after = after_audit(ready(), errors=0.9)
    assert (after.verdict, len(after.queries), after.state.ended_as) == ("ready", 0, "ready")


def test_a_ready_design_stays_ready_after_extra_queries():
    before = ready()
    samples = random_steps(pendulum(), LEARNED, seed=0)
    asked = advance(before.model.definition, samples, before.state, request(budget=100, extra=4))
    assert (asked.verdict, len(asked.queries), asked.state.ended_as) == ("ready", 4, "ready")
    after = after_audit(asked, errors=0.9)
    assert (after.verdict, len(after.queries)) == ("ready", 0)


def test_a_ready_design_becomes_unsure_after_audit_steps_beyond_tolerance():
    after = after_audit(ready(), errors=2.0)
    assert (after.verdict, len(after.queries)) == ("unsure", 0), "92 steps of its budget are left"


def test_a_ready_design_continues_if_its_budget_is_raised():
    after = after_audit(ready(), errors=0.9, budget=101)
    assert after.verdict == "continue"
    assert after.queries


def test_queries_refused_by_the_environment_cost_no_budget_and_are_not_repeated(definition, few, unseen):
    refused = Points(unseen.q[:3], unseen.u[:3])
    budget = len(few) + 2
    made = advance(definition, few, NEVER, request(budget, refused=refused.queries))
    assert len(made.queries) == 2
    assert not near(definition, Points.of(definition, made.queries), refused).any()


def test_the_design_ends_unsure_if_the_environment_refuses_too_many_queries(definition, few):
    def verdict(refusals: int) -> str:
        refused = random_steps(pendulum(), refusals, seed=3)
        return advance(definition, few, NEVER, request(10, refused=Points(refused.q, refused.u).queries)).verdict

    assert (verdict(10 + len(few)), verdict(9 + len(few))) == ("unsure", "continue")


def test_a_design_with_open_queries_continues(definition, few, unseen):
    """A log may come while the rest of the budget is being answered."""
    made = advance(definition, few, NEVER, request(len(few) + 2, first(unseen, 2), open=2))
    assert (made.verdict, len(made.queries)) == ("continue", 0)


def test_initial_queries_are_made_when_they_are_read_and_always_the_same():
    queries = initial_queries(definition_from_spec(designed(initial=2_500)), 2_500)
    read = list(queries)
    assert read == [queries[i] for i in range(len(queries))] == list(queries)
    assert list(queries[990:1_010]) == read[990:1_010]
    assert len(queries) == 2_500
    assert queries[-1] == read[-1]


def test_planning_100000_queries_leaves_no_objects_that_a_garbage_collection_would_visit():
    definition = definition_from_spec(designed(initial=100_000))
    gc.collect()
    before = len(gc.get_objects())
    queries = initial_queries(definition, 100_000)
    assert len(queries) == 100_000
    assert len(gc.get_objects()) - before < 1_000
