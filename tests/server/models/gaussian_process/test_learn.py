"""Learning: structure by evidence, samples cut by bounds left out, constants, and what an ending pays."""

from dataclasses import replace

import pytest
import torch

from support.models import gaussian_processes, learn
from support.real_steps import join, random_steps
from surrogym_sampler.original.classic import cartpole, mountain_car_continuous, pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.samples import Samples
from surrogym_server.environment.step_rules import paid
from surrogym_server.errors import InvalidInput
from surrogym_server.gp import fit, sparse, subsets
from surrogym_server.models.files import from_bytes, to_bytes
from surrogym_server.models.gaussian_process.learning import output_learner
from surrogym_shared.spec import BoxAction, Coordinate, Design, EnvironmentSpec, ObservationEntry, Reward, Term, Uniform

PAPER = pendulum().model_copy(update={"design": Design(preset="paper")})


@pytest.mark.parametrize("seed", range(2))
def test_a_reward_of_the_squared_angle_selects_the_wrapped_angle_as_input(pendulum_definition, seed):
    steps = random_steps(pendulum(), 24, seed=seed)
    squared = replace(steps, reward=-steps.q[:, 0].square())
    reward = learn(pendulum_definition, squared).model.reward
    assert reward.feature_map.state == "wrapped"
    scores = dict(reward.scores)
    assert max(scores, key=scores.get) == str(reward.feature_map)


def test_a_reward_of_the_cosine_selects_cosine_and_sine_as_inputs(pendulum_definition):
    steps = random_steps(pendulum(), 24, seed=0)
    reward = learn(pendulum_definition, replace(steps, reward=3 * steps.q[:, 0].cos() - 1)).model.reward
    assert reward.feature_map.state == "cos_sin"


@pytest.mark.parametrize("task", [pendulum, cartpole])
@pytest.mark.parametrize("seed", range(2))
def test_the_odd_symmetry_of_the_dynamics_is_found(task, seed):
    model = learn(definition_from_spec(task()), random_steps(task(), 12, seed=seed)).model
    assert {output.feature_map.parity for output in model.transitions} == {"odd"}
    assert all(output.centre == 0 for output in model.transitions)


@pytest.mark.parametrize("task", [pendulum, mountain_car_continuous])
@pytest.mark.parametrize("seed", range(2))
def test_an_angle_that_depends_only_on_the_next_speed_is_recognised_after_six_steps(task, seed):
    """Both environments move by the speed after the step: no bound has to be met to know how far that goes."""
    model = learn(definition_from_spec(task()), random_steps(task(), 6, seed=seed)).model
    angle, speed = model.transitions
    assert (angle.feature_map.state, angle.feature_map.lead) == ("none", True)
    assert speed.feature_map.state != "none"


@pytest.mark.parametrize("seed", range(2))
def test_a_reward_that_is_an_even_function_of_the_state_is_recognised_as_even(pendulum_definition, seed):
    assert learn(pendulum_definition, random_steps(pendulum(), 12, seed=seed)).model.reward.feature_map.parity == "even"


@pytest.mark.parametrize("seed", range(2))
def test_a_constant_extra_torque_prevents_the_odd_symmetry(pendulum_definition, seed):
    """The same steps, said to have been taken with a tenth of the largest torque less."""
    steps = random_steps(pendulum(), 16, seed=seed)
    _, speed = learn(pendulum_definition, replace(steps, u=steps.u - 0.2)).model.transitions
    assert speed.feature_map.parity == ""


@pytest.mark.parametrize("after", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_reward_timing_before_or_after_the_step_is_selected_by_evidence(pendulum_definition, after, seed):
    steps = random_steps(pendulum(), 24, seed=seed)
    state = steps.q_next if after else steps.q
    paying = replace(steps, reward=-state[:, 0].square() - 0.1 * state[:, 1].square())
    reward = learn(replace(pendulum_definition, reward=Reward(timing="auto")), paying).model.reward
    assert reward.feature_map.after == after
    scores = dict(reward.scores)
    assert {", after" in name for name in scores} == {False, True}
    assert max(scores, key=scores.get) == str(reward.feature_map)


def test_samples_clipped_at_a_bound_train_the_reward_but_not_the_dynamics(pendulum_definition, half_saturated):
    cut = int((half_saturated.q_next[:, 1].abs() >= 8).sum())
    assert cut >= 5
    model = learn(pendulum_definition, half_saturated).model
    angle, speed = model.transitions
    assert speed.left_out == cut
    assert len(speed.posterior.y) == len(half_saturated) - cut
    assert angle.feature_map.lead
    assert angle.left_out == 0, "an angle that reads the clipped speed sees no kink"
    assert model.reward.left_out == 0


def test_if_every_sample_was_clipped_at_a_bound_the_dynamics_use_them_all(pendulum_definition, half_saturated):
    cut = half_saturated.q_next[:, 1].abs() >= 8
    only = Samples(*(getattr(half_saturated, name)[cut] for name in half_saturated.__dataclass_fields__))
    model = learn(pendulum_definition, only).model
    assert [o.left_out for o in model.transitions] == [0, 0]


def test_a_constant_output_has_no_process_and_zero_deviation(cartpole_model):
    assert cartpole_model.reward.posterior is None
    mean, std = cartpole_model.reward.mean_and_std(torch.zeros(3, 5, dtype=torch.float64))
    assert mean.tolist() == [1.0] * 3
    assert std.tolist() == [0.0] * 3


def test_the_terminal_reward_is_learned_from_terminated_samples(cartpole_definition):
    steps = random_steps(cartpole(), 60, seed=0)
    assert bool(steps.terminated.any())
    assert bool((~steps.terminated).any())
    failing = replace(steps, reward=torch.where(steps.terminated, -9.0, 1.0).double())
    few = Samples(*(getattr(failing, name)[:30] for name in failing.__dataclass_fields__))
    model = learn(cartpole_definition, few).model
    assert model.terminal_reward == pytest.approx(-10.0)
    reward = model.transition(few.q[:2], few.u[:2]).reward
    assert paid(model.terminal_reward, reward, torch.tensor([True, False])).tolist() == pytest.approx([-9.0, 1.0])


def test_without_terminated_samples_the_terminal_reward_is_zero(pendulum_model):
    assert pendulum_model.terminal_reward == 0.0


def test_preset_paper_models_the_observation_with_squared_exponential_kernels():
    steps = random_steps(PAPER, 30, seed=0)
    model = learn(definition_from_spec(PAPER), steps).model
    assert [o.name for o in (*model.transitions, model.reward)] == ["cos", "sin", "speed", "reward"]
    assert {o.posterior.hyper.kernel for o in (*model.transitions, model.reward)} == {"squared exponential"}
    q_next = model.transition(steps.q, steps.u).q_next
    assert float((q_next - steps.q_next)[:, 1].abs().max()) < 0.5


def test_learning_from_fewer_than_two_samples_is_refused(pendulum_definition):
    steps = random_steps(pendulum(), 1, seed=0)
    with pytest.raises(InvalidInput, match="at least 2 samples, got 1"):
        learn(pendulum_definition, steps)
    assert learn(pendulum_definition, join(steps, random_steps(pendulum(), 1, seed=1))).model.samples == 2


def test_learning_the_same_samples_gives_the_same_model(pendulum_definition, pendulum_samples, pendulum_model):
    again = learn(pendulum_definition, pendulum_samples).model
    assert again.digest == pendulum_model.digest == pendulum_samples.digest
    assert again.description == pendulum_model.description


@pytest.mark.parametrize(("points", "through"), [(40, False), (41, True)])
def test_a_model_of_many_samples_is_sparse_and_its_description_tells_so(
    pendulum_definition, points: int, through: bool, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sparse, "MAX_EXACT", 40)
    monkeypatch.setattr(subsets, "FEW", 30)
    monkeypatch.setattr(sparse, "INDUCING", 25)
    steps, later = random_steps(pendulum(), points, seed=0), random_steps(pendulum(), 100, seed=1)
    model = learn(pendulum_definition, steps).model
    reward = model.description["outputs"][-1]  # learned from all; transitions leave saturated samples out
    assert ("inducing_points" in reward) == through
    if through:
        assert (reward["points"], reward["inducing_points"] <= 25) == (points, True)
        assert 0 <= reward["unexplained_deviation"] < 0.05
        again = from_bytes(pendulum_definition, to_bytes(model))
        assert again.description == model.description
    inside = later.q_next[:, 1].abs() < 8
    error = (model.transition(later.q, later.u).q_next - later.q_next)[inside, 1]
    assert float(error.abs().max()) < 0.05


def test_a_model_of_many_noisy_samples_is_sparse_and_drops_irrelevant_inputs():
    """A mass on a spring, and a base on which nothing depends."""
    size, noise, seeded = 600, 0.02, torch.Generator().manual_seed(0)
    definition = definition_from_spec(spring())

    def steps(noise: float) -> Samples:
        q = 2 * torch.rand(size, 3, dtype=torch.float64, generator=seeded) - 1
        u = 2 * torch.rand(size, 1, dtype=torch.float64, generator=seeded) - 1
        push = u[:, 0] - 2 * torch.sin(2 * q[:, 0])
        after = torch.stack([q[:, 0] + 0.1 * q[:, 1], q[:, 1] + 0.1 * push, q[:, 2] + 0.1 * u[:, 0]], 1)
        after = after + noise * torch.randn(size, 3, dtype=torch.float64, generator=seeded)
        return Samples(q, u, after, torch.zeros(size, dtype=torch.float64), torch.zeros(size, dtype=torch.bool))

    model, test = gaussian_processes(definition, steps(noise)), steps(0.0)
    assert [output.posterior.points for output in model.transitions] == [size] * 3
    assert all(len(output.posterior.y) < 100 for output in model.transitions)
    assert [2 in output.feature_map.dropped for output in model.transitions] == [True] * 3
    off = model.transition(test.q, test.u).q_next - test.q_next
    assert float(off.square().mean().sqrt()) < 0.3 * noise
    assert model.leave_one_out()[1].error == pytest.approx(noise, rel=0.15)
    assert from_bytes(definition, to_bytes(model)).description == model.description


def spring() -> EnvironmentSpec:
    names = {"place": Uniform(low=-1, high=1), "speed": Uniform(low=-1, high=1), "base": Uniform(low=-1, high=1)}
    return EnvironmentSpec(
        coordinates=tuple(Coordinate(name=name, sampling=sampling) for name, sampling in names.items()),
        observation=tuple(ObservationEntry(name=name, term=Term.linear(**{name: 1})) for name in names),
        action=BoxAction(low=(-1,), high=(1,)),
        start=names,
        time_limit=50,
    )


@pytest.mark.parametrize("seed", range(2))
def test_a_model_structure_chosen_on_a_subset_predicts_as_one_chosen_on_all_samples(
    pendulum_definition, seed, monkeypatch: pytest.MonkeyPatch
):
    """The same samples by the whole path, and by structure and first hyperparameters of a third of them."""
    steps, later = random_steps(pendulum(), 120, seed=seed), random_steps(pendulum(), 200, seed=9)
    whole = learn(pendulum_definition, steps).model
    monkeypatch.setattr(subsets, "FEW", 40)
    part = learn(pendulum_definition, steps).model
    assert part.structures == whole.structures
    assert [len(o.posterior.y) for o in part.outputs] == [len(o.posterior.y) for o in whole.outputs]
    ours, theirs = (m.transition(later.q, later.u, stds=True, reward_std=True) for m in (part, whole))
    for name in ("q_next", "reward", "std", "reward_std"):
        torch.testing.assert_close(getattr(ours, name), getattr(theirs, name), rtol=1e-2, atol=1e-4)
    again = learn(pendulum_definition, steps).model
    assert to_bytes(again) == to_bytes(part)


def test_structure_search_uses_a_fixed_number_of_points_for_any_sample_count(
    pendulum_definition, monkeypatch: pytest.MonkeyPatch
):
    """What is compared costs the same for any number of samples: all maps see no more than a few of them."""
    sizes: list[int] = []

    def counted(x, y, *more):
        sizes.append(len(y))
        return fit(x, y, *more)

    monkeypatch.setattr(output_learner, "fit", counted)
    for points in (subsets.FEW, 3 * subsets.FEW):
        learn(pendulum_definition, random_steps(pendulum(), points, seed=0))
    assert max(sizes) == subsets.FEW
