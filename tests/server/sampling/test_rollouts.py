"""Action sequences: random ones that spread, and planned ones that give more information per real step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from support.models import learn
from support.plane import drifting, plane
from support.real_steps import columns, join, roll
from surrogym_sampler.original.classic import acrobot, cartpole, pendulum
from surrogym_server.convert import default_budget, definition_from_spec
from surrogym_server.engine.design_job import DesignJob, run_design_job
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.models.abilities import PredictedSteps
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.lookahead import process_inputs
from surrogym_server.sampling.confidence import stds
from surrogym_server.sampling.design import advance, initial_queries
from surrogym_server.sampling.rollouts import (
    Aim,
    as_if_done,
    first_rollouts,
    path_values,
    plan_rollout,
    plan_round,
    predict_paths,
    random_sequences,
    start_points,
)
from surrogym_server.sampling.state import DesignState, Request
from surrogym_shared.nouns import Query
from surrogym_shared.spec import EnvironmentSpec, Uniform

ALL = (0, 1, 2)


def only_resets(spec: EnvironmentSpec, **changes: object) -> EnvironmentSpec:
    return EnvironmentSpec.model_validate({**spec.model_dump(), "query": "rollout", **changes})


SPEC = only_resets(pendulum(), max_rollout=40)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def planned(model: GaussianProcessModel, aim: Aim) -> torch.Tensor:
    """Actions (T, F) of the best sequence."""
    return torch.tensor(plan_rollout(model, aim, rng()).actions, dtype=torch.float64)


@pytest.fixture(scope="module")
def swinging() -> EnvironmentDefinition:
    return definition_from_spec(SPEC)


@pytest.fixture(scope="module")
def begun(swinging: EnvironmentDefinition) -> Samples:
    """The answers to the first rollouts, cut to so few that the model has something left to learn."""
    return join(*(roll(SPEC, query.actions, seed) for seed, query in enumerate(first_rollouts(swinging, 6, rng())[:2])))


@pytest.fixture(scope="module")
def model(swinging: EnvironmentDefinition, begun: Samples) -> GaussianProcessModel:
    return learn(swinging, begun).model


@pytest.fixture(scope="module")
def aim(model: GaussianProcessModel) -> Aim:
    outputs = (*model.transitions, model.reward)
    return Aim(ALL, [0.05 * output.scale for output in outputs], longest=12)


def test_initial_rollouts_grow_in_length_and_use_the_given_number_of_steps(swinging: EnvironmentDefinition):
    rollouts = first_rollouts(swinging, 12, rng())
    assert [query.steps for query in rollouts] == [1, 2, 3, 4, 2]
    assert all(len(action) == 1 and abs(action[0]) <= 2 for query in rollouts for action in query.actions)
    assert [query.steps for query in first_rollouts(replace(swinging, max_rollout=2), 7, rng())] == [1, 2, 2, 2]


def test_random_action_sequences_hold_each_action_for_different_durations(swinging: EnvironmentDefinition):
    sequences = random_sequences(swinging, 64, 16, rng())
    changes = (np.diff(sequences[..., 0], axis=1) != 0).sum(1)
    assert {0, 1, 3, 7} <= set(changes.tolist()), "all of it, a half, a quarter, an eighth"
    assert np.abs(sequences).max() == 2, "limits reach farthest"


def test_random_action_sequences_of_discrete_actions_are_valid_action_numbers():
    sequences = random_sequences(definition_from_spec(only_resets(cartpole())), 32, 8, rng())
    assert set(np.unique(sequences)) == {0.0, 1.0}


def test_predicted_rollouts_start_stratified_in_the_declared_start_range(swinging: EnvironmentDefinition):
    starts = start_points(swinging, 8, rng())
    assert sorted(((starts[:, 0] + torch.pi) / (2 * torch.pi) * 8).int().tolist()) == list(range(8))
    assert bool((starts[:, 1].abs() <= 1).all())


def test_a_predicted_path_continues_from_its_last_state(model: GaussianProcessModel):
    actions = torch.from_numpy(random_sequences(model.definition, 5, 7, rng()))
    paths = predict_paths(model, start_points(model.definition, 5, rng()), actions)
    torch.testing.assert_close(paths.q[:, 1:], paths.q_next[:, :-1])
    torch.testing.assert_close(paths.q_next[:, 3], model.transition(paths.q[:, 3], paths.u[:, 3]).q_next)
    assert bool((paths.drift.diff(dim=1) >= 0).all())


def test_path_information_equals_the_chain_rule_over_its_points(model: GaussianProcessModel, aim: Aim):
    """Against the chain rule: 1/2 log(1 + var / tau^2) of each point, given those before with noise tau^2."""
    paths = predict_paths(model, start_points(model.definition, 1, rng()), torch.zeros(1, 6, 1, dtype=torch.float64))
    paths = replace(paths, drift=torch.zeros_like(paths.drift))
    posterior = model.reward.posterior
    assert posterior is not None
    tolerance = aim.tolerances[2] / model.reward.scale
    x = process_inputs(model.definition, model.reward, PredictedSteps(paths.q[0], paths.u[0], paths.q_next[0]))
    joint = posterior.joint_covariance(x[None])[0]
    expected, known = [], 0.0
    for t in range(6):
        before, own = joint[:t, :t] + tolerance**2 * torch.eye(t), joint[t, t]
        left = own - joint[t, :t] @ torch.linalg.solve(before, joint[:t, t]) if t else own
        known += 0.5 * float(torch.log1p(left / tolerance**2))
        expected.append(known)
    got = path_values(model, replace(aim, columns=(2,)), paths)
    torch.testing.assert_close(got[0], torch.tensor(expected, dtype=torch.float64), rtol=1e-6, atol=1e-9)


def test_a_point_repeated_on_a_path_adds_almost_no_information(model: GaussianProcessModel, aim: Aim):
    paths = predict_paths(model, start_points(model.definition, 1, rng()), torch.ones(1, 4, 1, dtype=torch.float64))
    stuck = {name: getattr(paths, name)[:, :1].expand(-1, 4, -1) for name in ("q", "u", "q_next")}
    gain = path_values(model, aim, replace(paths, **stuck, drift=torch.zeros_like(paths.drift)))[0]
    first, *later = torch.cat([gain[:1], gain.diff()]).tolist()
    assert max(later) < 0.35 * first


def test_path_steps_outside_the_sampling_range_or_after_termination_add_no_information(
    model: GaussianProcessModel, aim: Aim
):
    paths = predict_paths(model, start_points(model.definition, 1, rng()), torch.ones(1, 4, 1, dtype=torch.float64))
    away = torch.tensor([0.0, 30.0], dtype=torch.float64)
    outside = replace(paths, q=torch.cat([paths.q[:, :2], (paths.q + away)[:, 2:]], 1))
    ended = replace(paths, running=torch.tensor([[1.0, 1.0, 0.0, 0.0]], dtype=torch.float64))
    for cut in (outside, ended):
        gain = path_values(model, aim, cut)[0]
        assert gain[1] > 0
        torch.testing.assert_close(gain[2:], gain[1].expand(2))


def test_steps_of_a_predicted_path_with_uncertain_states_add_less_information(model: GaussianProcessModel, aim: Aim):
    paths = predict_paths(model, start_points(model.definition, 3, rng()), torch.ones(3, 4, 1, dtype=torch.float64))
    known, lost = (replace(paths, drift=torch.full_like(paths.drift, d)) for d in (0.0, 20.0))
    assert bool((path_values(model, aim, lost) < 0.01 * path_values(model, aim, known)).all())


def test_planned_rollouts_prefer_states_visited_by_policies(model: GaussianProcessModel, aim: Aim):
    paths = predict_paths(model, start_points(model.definition, 8, rng()), torch.ones(8, 2, 1, dtype=torch.float64))
    near = 0.1 * torch.randn(200, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) + paths.q[5, 0]
    plain, drawn = (path_values(model, replace(aim, states=states), paths)[:, 0] for states in (None, near))
    assert int((drawn / plain).argmax()) == 5


def test_a_planned_rollout_gives_more_information_than_random_ones():
    """Of Acrobot, from a dozen steps: much is left to learn, and a random swing stays low."""
    spec = only_resets(acrobot())
    definition = definition_from_spec(spec)
    rollouts = first_rollouts(definition, 12, rng())
    model = learn(definition, join(*(roll(spec, query.actions, seed) for seed, query in enumerate(rollouts)))).model
    aim = Aim((0, 1, 2, 3), [0.05 * output.scale for output in model.transitions], longest=12)
    actions = planned(model, aim)
    assert 1 <= len(actions) <= aim.longest
    starts = start_points(definition, 32, rng(7))

    def worth(sequence: torch.Tensor) -> float:
        paths = predict_paths(model, starts, sequence.expand(32, -1, -1))
        return float(path_values(model, aim, paths)[:, -1].mean()) / len(sequence)

    others = [worth(torch.from_numpy(s)[: len(actions)]) for s in random_sequences(definition, 20, 12, rng(1))]
    assert worth(actions) > 0.98 * max(others)
    assert worth(actions) > 1.1 * float(np.median(others))


def test_planning_a_rollout_is_reproducible_from_its_seed(model: GaussianProcessModel, aim: Aim):
    assert plan_rollout(model, aim, rng(3)) == plan_rollout(model, aim, rng(3))


def test_a_pending_rollout_reduces_the_information_of_similar_paths(model: GaussianProcessModel, aim: Aim):
    actions = torch.full((6, 1), 2.0, dtype=torch.float64)
    done = as_if_done(model, Query.rollout(actions.tolist()), {}, rng())
    paths = predict_paths(model, start_points(model.definition, 1, rng()), actions[None])
    again, first = (float(path_values(m, aim, paths)[0, -1]) for m in (done, model))
    assert again < 0.1 * first
    q, u = start_points(model.definition, 50, rng(2)), torch.full((50, 1), 2.0, dtype=torch.float64)
    before, after = stds(model, q, u), stds(done, q, u)
    assert bool((after <= before + 1e-9).all())
    torch.testing.assert_close(done.transition(q, u).q_next, model.transition(q, u).q_next, rtol=0, atol=1e-6)


def test_a_round_of_planned_rollouts_uses_exactly_its_number_of_steps(model: GaussianProcessModel, aim: Aim):
    rollouts = plan_round(model, replace(aim, longest=3), 7, [Query.rollout([[1.0]] * 2)], rng())
    assert sum(query.steps for query in rollouts) == 7
    assert max(query.steps for query in rollouts) <= 3


def test_planned_rollouts_aim_at_termination_until_one_was_sampled():
    """Mirrored samples would tell all of the pole, and what is planned without need pushes it over as well."""
    spec = only_resets(cartpole(), design={"symmetry": "none"})
    definition = definition_from_spec(spec)
    samples = join(
        *(roll(spec, query.actions, seed) for seed, query in enumerate(first_rollouts(definition, 20, rng())))
    )
    assert not bool(samples.terminated.any())
    learned = learn(definition, samples).model
    aim = Aim(tuple(range(5)), [0.05] * 5, longest=30, ending=True)
    starts = start_points(definition, 16, rng(5))

    def ends(sequence: torch.Tensor) -> float:
        return float(predict_paths(learned, starts, sequence.expand(16, -1, -1)).ended[:, -1].mean())

    assert ends(planned(learned, aim)) > 0.75
    assert ends(planned(learned, replace(aim, ending=False))) < 0.5
    assert ends(planned(learned, replace(aim, ended=True))) < 0.5, "one was seen"


@pytest.mark.parametrize("side", [1, -1])
def test_planned_rollouts_aim_at_an_uncertain_reward_jump(side: int):
    """It pays beyond x = 0.5, or beyond -0.5, which starts around 0 reach by pushing that way for a while."""
    samples = drifting(lambda q, _: (side * q[:, 0] > 0.5).double(), 12)
    spec = only_resets(plane(), start={name: Uniform(low=-0.1, high=0.1) for name in "xy"})
    definition = definition_from_spec(spec)
    learned = learn(definition, samples).model
    assert learned.jumps
    aim = Aim((1,), [0.05] * 3, longest=8, ending=True, ended=True)
    driven = planned(learned, aim)
    assert side * float(driven.mean()) > 0.5


def test_a_rollout_design_counts_its_budget_in_real_steps(swinging: EnvironmentDefinition, begun: Samples):
    complete = replace(swinging, design=replace(swinging.design, initial=len(begun)))

    def ask(**options: object) -> list[int]:
        values = {"budget": len(begun) + 9, "target": 1 - 1e-12} | options
        queries = advance(complete, begun, DesignState(), Request(**values)).queries
        assert {query.kind for query in queries} <= {"rollout"}
        return [query.steps for query in queries]

    assert sum(ask()) == 4, "a round is a quarter of the samples, four at least"
    assert sum(ask(budget=len(begun) + 2)) == 2
    pending = (Query.rollout([[1.0]] * 7),)
    assert sum(ask(pending=pending)) == 2, "its seven steps are spoken for"
    assert sum(ask(budget=len(begun), extra=5)) == 5
    assert ask(budget=len(begun)) == []


def test_initial_steps_lost_to_early_termination_are_queried_again_in_one_round(
    swinging: EnvironmentDefinition, begun: Samples
):
    """Each round had a quarter of the samples, so that many small rounds followed, each with a fit."""
    assert (swinging.design.initial, len(begun)) == (12, 3)

    def ask(**options) -> list[int]:
        request = Request(**{"budget": 60, "target": 1 - 1e-12} | options)
        return [query.steps for query in advance(swinging, begun, DesignState(), request).queries]

    assert ask() == [1, 2, 3, 3]
    assert sum(ask(budget=8)) == 5, "the budget has no more"
    assert sum(ask(logged=3)) == 9, "a log is free, and replaces as many initial steps"
    pending = (Query.rollout([[1.0]] * 7),)
    assert sum(ask(pending=pending)) == 4, "two are missing, which is less than a usual round"


def test_with_acquisition_latin_hypercube_random_rollouts_use_the_whole_budget():
    spec = only_resets(pendulum(), design={"acquisition": "latin_hypercube"})
    assert sum(query.steps for query in initial_queries(definition_from_spec(spec), 30)) == 30
    assert sum(query.steps for query in initial_queries(definition_from_spec(SPEC), 30)) == 12


def test_the_default_budget_depends_on_the_number_of_dimensions():
    assert default_budget(SPEC) == 60
    assert default_budget(only_resets(cartpole())) == 100


def test_the_longest_rollout_is_limited_to_the_episode_length():
    assert definition_from_spec(only_resets(pendulum(), max_rollout=300)).max_rollout == 200
    assert definition_from_spec(only_resets(pendulum(), time_limit=None)).max_rollout == 200
    assert definition_from_spec(pendulum()).max_rollout is None


def counted(spec: EnvironmentSpec, steps: int) -> EnvironmentSpec:
    """The specification with a count of the first steps, from which nothing is learned."""
    fields, past = spec.model_dump(), {"kind": "uniform", "low": 0.0, "high": float(steps)}
    count = {"name": "steps", "sampling": past, "bounds": {"low": 0.0, "high": float(steps)}, "lag": {"kind": "steps"}}
    start = {**fields["start"], "steps": {"kind": "fixed", "value": float(steps)}}
    return EnvironmentSpec.model_validate(fields | {"coordinates": [*fields["coordinates"], count], "start": start})


def test_initial_rollouts_are_longer_than_their_first_steps_with_unknown_past():
    definition = definition_from_spec(counted(SPEC, 2))
    assert [query.steps for query in first_rollouts(definition, 14, rng())] == [3, 4, 5]


def test_planned_rollouts_are_longer_than_their_first_steps_with_unknown_past():
    definition = definition_from_spec(counted(SPEC, 2))
    walked = roll(SPEC, random_sequences_of(8), 0)
    known = torch.full((8, 1), 2.0, dtype=torch.float64)
    samples = replace(walked, q=torch.cat([walked.q, known], 1), q_next=torch.cat([walked.q_next, known], 1))
    model = learn(definition, samples).model
    aim = Aim(ALL, [0.05 * float(scale) for scale in model.scales], longest=6)
    paths = predict_paths(model, start_points(definition, 2, rng()), torch.zeros(2, 6, 1, dtype=torch.float64))
    value = path_values(model, aim, paths)
    assert not value[:, :2].any()
    assert (value[:, 2] > 0).all()
    assert all(query.steps > 2 for query in plan_round(model, aim, 8, (), rng()))


def random_sequences_of(length: int) -> torch.Tensor:
    return torch.from_numpy(random_sequences(definition_from_spec(SPEC), 1, length, rng())[0])


def test_first_steps_of_a_rollout_with_unknown_past_cost_budget_but_are_not_learned_from():
    definition = definition_from_spec(counted(SPEC, 2))
    walked = roll(SPEC, random_sequences_of(8), 0)
    count = torch.arange(9.0, dtype=torch.float64).clamp_max(2.0)[:, None]
    q, q_next = (torch.hstack(pair) for pair in ((walked.q, count[:-1]), (walked.q_next, count[1:])))
    job = DesignJob(definition, columns(replace(walked, q=q, q_next=q_next)), state={}, budget=10, target=0.999)
    result = run_design_job(job)
    assert result.fidelity["samples"] == 6
    assert 0 < sum(query.steps for query in result.queries) <= 2 or result.phase in ("over_budget", "unsure")


@pytest.mark.parametrize("seed", range(3))
def test_path_information_stays_finite_for_a_tiny_tolerance(model: GaussianProcessModel, aim: Aim, seed: int):
    """The covariance of a path is rounding there, and its factorization failed: a design ended with ChoiceFailed."""
    actions = torch.from_numpy(random_sequences(model.definition, 48, 12, rng(seed)))
    paths = predict_paths(model, start_points(model.definition, len(actions), rng(seed)), actions)
    values = path_values(model, replace(aim, tolerances=[1e-12] * 3), paths)
    assert values.isfinite().all()
    assert (values.diff(dim=1) >= -1e-9).all()


def test_a_planned_rollout_starts_at_the_most_informative_snapshot(model: GaussianProcessModel, aim: Aim):
    """Far from what is known, beside the states that a reset leads to."""
    snapshots = {"one": (0.0, 0.0), "two": (0.0, 0.0), "three": (0.0, 0.0), "fast": (2.0, 7.0)}
    plan = plan_rollout(model, replace(aim, snapshots=snapshots), rng())
    assert plan.snapshot == "fast"
    reset = plan_rollout(model, aim, rng())
    assert reset.snapshot is None


def test_without_snapshots_a_planned_rollout_starts_at_a_reset(model: GaussianProcessModel, aim: Aim):
    plan = plan_rollout(model, replace(aim, snapshots={}), rng())
    assert plan.snapshot is None
    assert plan == plan_rollout(model, aim, rng())


def test_a_pending_rollout_from_a_snapshot_reduces_uncertainty_at_that_state(model: GaussianProcessModel):
    place, actions = torch.tensor([[2.0, 6.0]], dtype=torch.float64), torch.full((1, 1), 2.0, dtype=torch.float64)
    done = as_if_done(model, Query.rollout([[2.0]], "fast"), {"fast": (2.0, 6.0)}, rng())
    before, after = (stds(m, place, actions)[0, 1] for m in (model, done))
    assert after < 0.2 * before


def test_a_design_with_snapshots_starts_with_few_steps_and_then_uses_snapshots():
    spec = only_resets(pendulum(), snapshots=True)
    definition = definition_from_spec(spec)
    first = initial_queries(definition, 60)
    assert sum(query.steps for query in first) == 4, "as few as single steps"
    samples = join(*(roll(spec, query.actions, seed) for seed, query in enumerate(first)))
    snapshots = {str(number): tuple(state) for number, state in enumerate(samples.q_next.tolist())}
    request = Request(budget=60, target=1 - 1e-12, snapshots=snapshots)
    decision = advance(definition, samples, DesignState(), request)
    below = sum(output.confidence_index < request.target for output in decision.confidences)
    steps = sum(query.steps for query in decision.queries)
    assert steps == max(1, below), "one step for each output below its target"
    begins = {query.snapshot for query in decision.queries} - {None}
    assert begins
    assert begins <= snapshots.keys()
