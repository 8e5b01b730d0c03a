"""AUR-D and AUR-P (section 4, eq. 14): penalty, weights, noise and the mean of particles, worked out by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.exact_models import ExactModel
from support.models import gaussian_processes
from support.plane import drifting, plane
from surrogym_server.convert import definition_from_spec
from surrogym_server.virtual import step
from surrogym_server.virtual.dynamics import mean_state, move_mean, move_particles
from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    EnvironmentSpec,
    Fixed,
    Inequality,
    ObservationEntry,
    Term,
    Uniform,
)

CART = EnvironmentSpec(
    coordinates=(Coordinate(name="x", sampling=Uniform(low=-10, high=10)),),
    observation=(ObservationEntry(name="x", term=Term.linear(x=1)),),
    action=BoxAction(low=(-1.0,), high=(1.0,)),
    start={"x": Fixed(value=0)},
    termination=((Inequality(term=Term.linear(x=1), relation=">", value=3.0),),),
)


@pytest.fixture
def cart() -> ExactModel:
    """x' = x + u; the reward 10 x of the state before deviates by x, the transition by 0.5."""
    return ExactModel(
        definition_from_spec(CART),
        move=lambda q, u: q + u,
        pay=lambda q, u: 10 * q[:, 0] + 0 * u[:, 0],
        std=0.5,
        reward_std=lambda q: q[:, 0].abs(),
    )


def column(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)[:, None]


def test_the_deterministic_variant_follows_the_mean_with_a_lower_bound_reward(cart):
    moved = move_mean(cart, column(1.0, 2.5), column(0.5, 1.0), penalty=3.0, stds=True)
    assert moved.q[:, 0].tolist() == [1.5, 3.5]
    assert moved.reward_mean.tolist() == [10.0, 25.0]
    assert moved.reward.tolist() == [10 - 3 * 1.0, 25 - 3 * 2.5]
    assert moved.terminated.tolist() == [False, True]
    assert moved.std.tolist() == [[0.5, 1.0], [0.5, 2.5]]


def test_without_an_uncertainty_penalty_the_reward_is_the_mean(cart):
    moved = move_mean(cart, column(1.0), column(0.5), penalty=0.0, stds=False)
    assert moved.reward.tolist() == moved.reward_mean.tolist() == [10.0]
    assert moved.std is None


def test_particle_rewards_are_weighted_by_inverse_variance(cart):
    """Rewards 10, 20, 40 deviate by 1, 2, 4: weights 16 : 4 : 1 of 21."""
    particles = torch.tensor([[[1.0], [2.0], [4.0]]], dtype=torch.float64)
    moved = move_particles(cart, particles, column(0.5), 3.0, None)
    assert moved.particles[0, :, 0].tolist() == [1.5, 2.5, 4.5]
    assert float(moved.q) == pytest.approx((1.5 + 2.5 + 4.5) / 3)
    assert float(moved.reward_mean) == pytest.approx((16 * 10 + 4 * 20 + 1 * 40) / 21)
    assert float(moved.reward) == pytest.approx((16 * (10 - 3) + 4 * (20 - 6) + 1 * (40 - 12)) / 21)
    assert moved.std[0].tolist() == [pytest.approx(0.5), pytest.approx(math.sqrt((1 + 4 + 16) / 3))]


def test_a_particle_with_zero_reward_variance_gets_all_the_weight(cart):
    particles = torch.tensor([[[0.0], [2.0]]], dtype=torch.float64)
    moved = move_particles(cart, particles, column(0.0), 3.0, None)
    assert float(moved.reward) == pytest.approx(0, abs=1e-9)


def test_particles_with_equally_certain_rewards_get_equal_weights(cart):
    certain = replace(cart, reward_std=lambda q: 0 * q[:, 0])
    particles = torch.tensor([[[1.0], [2.0]]], dtype=torch.float64)
    moved = move_particles(certain, particles, column(0.0), 0.0, None)
    assert float(moved.reward) == pytest.approx(15)


def test_with_noise_each_particle_moves_by_its_own_random_draw(cart):
    particles = torch.tensor([[[1.0], [2.0]], [[0.0], [0.0]]], dtype=torch.float64)
    noise = torch.tensor([[[1.0], [-2.0]], [[0.0], [3.0]]], dtype=torch.float64)
    moved = move_particles(cart, particles, column(0.0, 1.0), 0.0, noise)
    assert moved.particles[..., 0].tolist() == [[1.5, 1.0], [1.0, 2.5]]
    assert moved.q[:, 0].tolist() == [1.25, 1.75]


def test_termination_depends_on_the_mean_state_and_not_on_single_particles(cart):
    particles = torch.tensor([[[1.0], [4.0]], [[2.5], [4.0]]], dtype=torch.float64)
    moved = move_particles(cart, particles, column(0.0, 0.0), 0.0, None)
    assert moved.terminated.tolist() == [False, True]


def test_the_mean_of_particle_angles_is_the_circular_mean(pendulum_model):
    particles = torch.tensor([[[3.0, 1.0], [-3.0, 3.0]], [[0.2, 0.0], [0.4, 1.0]]], dtype=torch.float64)
    mean = mean_state(pendulum_model.definition, particles)
    assert abs(float(mean[0, 0])) == pytest.approx(math.pi)
    assert float(mean[1, 0]) == pytest.approx(0.3)
    assert mean[:, 1].tolist() == [2.0, 0.5]


def test_one_particle_in_a_certain_model_equals_the_deterministic_variant(pendulum_model, started):
    particle = {"variant": "probabilistic", "particles": 1, "spread": 0.0}
    runs = [started(pendulum_model, 3, time_limit=20, **chosen) for chosen in ({}, particle)]
    states = [lanes for _, lanes in runs]
    for action in np.random.default_rng(0).uniform(-2, 2, (50, 3, 1)):
        made = []
        for i, (settings, _) in enumerate(runs):
            states[i], transition = step(pendulum_model, settings, states[i], action)
            made.append(transition)
        np.testing.assert_allclose(made[0].observation, made[1].observation, atol=1e-6)
        np.testing.assert_allclose(made[0].reward, made[1].reward, atol=1e-9)
        np.testing.assert_array_equal(made[0].truncated, made[1].truncated)


def test_sampled_particle_steps_differ_between_environments_and_repeat_with_the_seed(cart, started):
    def run(num_envs: int) -> np.ndarray:
        settings, lanes = started(cart, num_envs, 5, variant="probabilistic", particles=3)
        made = []
        for _ in range(4):
            lanes, transition = step(cart, settings, lanes, np.zeros((num_envs, 1)))
            made.append(transition.observation[:, 0])
        return np.stack(made)

    four = run(4)
    assert len(np.unique(four)) == four.size
    np.testing.assert_array_equal(four, run(4))
    np.testing.assert_array_equal(four[:, :2], run(2))


def test_a_step_in_which_every_environment_resets_moves_no_particle(cart, started):
    settings, lanes = started(cart, 2, variant="probabilistic", particles=3, time_limit=1)
    lanes, ended = step(cart, settings, lanes, np.zeros((2, 1)), stds=True)
    lanes, begun = step(cart, settings, lanes, np.zeros((2, 1)), stds=True)
    assert ended.truncated.all()
    assert begun.reset_lanes.all()
    assert begun.std.tolist() == [[0.0, 0.0]] * 2
    assert lanes.particles.shape == (2, 3, 1)


def bump(q: torch.Tensor, _: torch.Tensor) -> torch.Tensor:
    return (-0.5 * (q / 0.04).square().sum(-1)).exp()


def test_compiled_particles_with_a_log_reward_agree_with_torch():
    model = gaussian_processes(definition_from_spec(plane()), drifting(bump, 12))
    assert model.reward.warp is not None
    steps = model.compiled()
    if steps is None:
        pytest.skip("steps can't be compiled here")
    noise = torch.randn(5, 6, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    near, u = 0.02 * noise, torch.zeros(5, 1, dtype=torch.float64)
    ours, theirs = (move_particles(model, near, u, penalty=1.0, noise=noise, steps=how) for how in (steps, None))
    assert float(theirs.reward_mean.max()) > 0.1
    for name in ("particles", "reward_mean", "reward", "std"):
        torch.testing.assert_close(getattr(ours, name), getattr(theirs, name), rtol=2e-5, atol=0.0)


def test_particle_weights_stay_finite_for_tiny_rewards_whose_squares_underflow():
    """A hidden reward may have paid 1e-170 at most, and a particle then deviates by as little."""

    def faint(q: torch.Tensor, _: torch.Tensor) -> torch.Tensor:
        return 1e-170 * bump(q, _)

    model = gaussian_processes(definition_from_spec(plane()), drifting(faint, 12))
    assert model.reward.warp is not None
    near, u = torch.zeros(2, 3, 2, dtype=torch.float64), torch.zeros(2, 1, dtype=torch.float64)
    moved = move_particles(model, near, u, penalty=0.0, noise=None)
    assert bool(torch.isfinite(moved.reward).all())
    assert float(moved.reward.min()) > 0
