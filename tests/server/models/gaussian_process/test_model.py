"""A model moves coordinates as the environment does: bounds, walls, the lead first, draws, and the reward's timing."""

from dataclasses import replace

import pytest
import torch

from support.models import learn
from support.real_steps import random_steps
from surrogym_sampler.original.classic import cartpole, mountain_car_continuous, pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import wrap
from surrogym_server.environment.features import FeatureMap, encode
from surrogym_server.environment.step_rules import settle
from surrogym_server.gp import serving
from surrogym_server.models.gaussian_process.prediction.description import describe
from surrogym_server.virtual.single_step import predict_points


def test_predicted_states_have_wrapped_angles_and_clipped_speeds(pendulum_definition):
    q = torch.tensor([[4.0, 9.0], [-4.0, -9.0], [1.0, 1.0]], dtype=torch.float64)
    expected = torch.tensor([[4 - 2 * torch.pi, 8], [2 * torch.pi - 4, -8], [1, 1]], dtype=torch.float64)
    torch.testing.assert_close(settle(pendulum_definition, q), expected)


def test_a_wall_sets_the_speed_to_zero_only_for_states_moving_into_it(mountain_car_definition):
    q = torch.tensor([[-1.3, -0.03], [-1.2, -0.01], [-1.3, 0.02], [-1.0, -0.03], [0.7, 0.09]], dtype=torch.float64)
    expected = [[-1.2, 0], [-1.2, 0], [-1.2, 0.02], [-1.0, -0.03], [0.7, 0.07]]
    before = q.clone()
    torch.testing.assert_close(settle(mountain_car_definition, q), torch.tensor(expected, dtype=torch.float64))
    torch.testing.assert_close(q, before, rtol=0, atol=0)


def test_a_learned_mountain_car_model_stops_at_its_wall():
    spec = mountain_car_continuous()
    model = learn(definition_from_spec(spec), random_steps(spec, 12, seed=1)).model
    at = torch.tensor([[-1.19, -0.06], [-0.5, 0.01]], dtype=torch.float64)
    q_next = model.transition(at, torch.zeros(2, 1, dtype=torch.float64)).q_next
    assert q_next[0].tolist() == [pytest.approx(-1.2), 0.0]
    assert q_next[1, 0] == pytest.approx(-0.49, abs=2e-3)


def test_pendulum_steps_outside_the_samples_are_predicted_accurately(pendulum_model):
    unseen = random_steps(pendulum(), 100, seed=5)
    q_next = pendulum_model.transition(unseen.q, unseen.u).q_next
    error = torch.stack([wrap(q_next[:, 0] - unseen.q_next[:, 0]), q_next[:, 1] - unseen.q_next[:, 1]], -1)
    assert float(error[:, 0].abs().max()) < 0.02
    assert float(error[:, 1].abs().max()) < 0.2
    assert q_next[:, 1].abs().max() <= 8


def test_a_drawn_step_is_the_mean_plus_noise_times_deviation(pendulum_model):
    q = torch.tensor([[0.5, 1.0], [2.0, -3.0]], dtype=torch.float64)
    u, noise = torch.zeros(2, 1, dtype=torch.float64), torch.tensor([[1.0, -2.0], [0.0, 0.5]], dtype=torch.float64)
    mean = pendulum_model.transition(q, u, stds=True)
    drawn = pendulum_model.transition(q, u, noise=noise)
    speed = mean.q_next[:, 1] + mean.std[:, 1] * noise[:, 1]
    torch.testing.assert_close(drawn.q_next[:, 1], speed)
    assert drawn.std is None
    assert mean.std.shape == (2, 2)
    quiet = pendulum_model.transition(q, u, noise=torch.zeros_like(noise))
    torch.testing.assert_close(quiet.q_next, mean.q_next)


@pytest.mark.parametrize("timing", ["before", "after"])
def test_a_batch_stepped_in_blocks_equals_single_steps(pendulum_model, monkeypatch, timing):
    feature_map = replace(pendulum_model.reward.feature_map, after=timing == "after")
    model = replace(pendulum_model, reward=replace(pendulum_model.reward, feature_map=feature_map))
    points = random_steps(pendulum(), 20, seed=3)
    noise = torch.randn(20, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    asked = {"stds": True, "reward_std": True}
    whole = model.transition(points.q, points.u, noise=noise, **asked)
    monkeypatch.setattr(serving, "BLOCK", 1)
    monkeypatch.setattr(serving, "MIN_ROWS", 7)
    blocks = model.transition(points.q, points.u, noise=noise, **asked)
    singles = [
        model.transition(points.q[i : i + 1], points.u[i : i + 1], noise=noise[i : i + 1], **asked) for i in range(20)
    ]
    for name in ("q_next", "reward", "std", "reward_std"):
        torch.testing.assert_close(getattr(blocks, name), getattr(whole, name), rtol=0, atol=1e-7)
        alone = torch.cat([getattr(single, name) for single in singles])
        torch.testing.assert_close(alone, getattr(whole, name), rtol=0, atol=1e-7)


def test_a_model_predicts_the_posteriors_of_its_processes(pendulum_model):
    """Compiled, each output is the posterior that was fitted."""
    points = random_steps(pendulum(), 50, seed=3)
    predicted = pendulum_model.transition(points.q, points.u, stds=True, reward_std=True)
    angle, speed = pendulum_model.transitions
    lead = predicted.q_next[:, 1:]
    for output, change, std in (
        (angle, wrap(predicted.q_next[:, 0] - points.q[:, 0]), predicted.std[:, 0]),
        (speed, predicted.q_next[:, 1] - points.q[:, 1], predicted.std[:, 1]),
        (pendulum_model.reward, predicted.reward, predicted.reward_std),
    ):
        x = encode(pendulum_model.definition, output.feature_map, points.q, points.u, lead)
        mean, expected = output.mean_and_std(x)
        inside = lead[:, 0].abs() < 8
        torch.testing.assert_close(change[inside], mean[inside], rtol=0, atol=1e-7 * output.scale)
        torch.testing.assert_close(std, expected, rtol=1e-3, atol=1e-4 * output.scale)


def test_an_angle_predicted_from_the_next_speed_uses_the_drawn_next_speed(pendulum_definition, half_saturated):
    """Where speeds were cut the lead alone tells how far the angle goes."""
    model = learn(pendulum_definition, half_saturated).model
    angle, speed = model.transitions
    assert angle.feature_map.lead
    assert not speed.feature_map.lead
    q, u = torch.tensor([[0.5, 1.0]], dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64)
    std = model.transition(q, u, stds=True).std
    kick = torch.tensor([[0.0, 1.0]], dtype=torch.float64) / std
    pushed = model.transition(q, u, noise=kick).q_next
    rest = model.transition(q, u, noise=torch.zeros_like(kick)).q_next
    change = pushed - rest
    assert float(change[0, 1]) == pytest.approx(1)
    assert float(change[0, 0]) == pytest.approx(0.05, rel=0.05)


@pytest.mark.parametrize("timing", ["before", "after"])
def test_the_reward_is_predicted_from_the_state_before_or_after_the_step_by_its_timing(pendulum_model, timing):
    feature_map = replace(pendulum_model.reward.feature_map, after=timing == "after")
    model = replace(pendulum_model, reward=replace(pendulum_model.reward, feature_map=feature_map))
    q, u = torch.tensor([[0.0, 6.0]], dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64)
    predicted = model.transition(q, u, reward_std=True)
    angle, speed = (q if timing == "before" else predicted.q_next)[0].tolist()
    assert abs(predicted.q_next[0, 0] - q[0, 0]) > 0.2
    assert float(predicted.reward) == pytest.approx(-(angle**2 + 0.1 * speed**2), abs=0.05)
    assert float(predicted.reward_std) > 0
    assert model.transition(q, u).reward_std is None


def test_the_predictions_for_requested_points_contain_next_state_reward_and_termination(pendulum_model, cartpole_model):
    points = predict_points(
        cartpole_model, torch.tensor([[2.39, 3.0, 0, 0]]).double().numpy(), torch.ones(1, 1).numpy()
    )
    assert points.terminated.tolist() == [True]
    steps = random_steps(cartpole(), 1, seed=3)
    points = predict_points(cartpole_model, steps.q.numpy(), steps.u.numpy())
    assert points.next_coordinates[0] == pytest.approx(steps.q_next[0].numpy(), abs=0.02)
    assert points.reward.tolist() == [1.0]
    points = predict_points(pendulum_model, torch.tensor([[0.5, 1.0]]).double().numpy(), torch.ones(1, 1).numpy())
    assert points.next_observation.shape == (1, 3)
    assert float((points.next_observation[:, :2] ** 2).sum()) == pytest.approx(1)


def test_a_model_description_lists_outputs_features_and_length_scales(pendulum_model):
    outputs = {o["name"]: o for o in pendulum_model.description["outputs"]}
    assert list(outputs) == ["theta", "speed", "reward"]
    assert outputs["speed"]["points"] + outputs["speed"]["left_out"] == pendulum_model.samples
    assert len(outputs["reward"]["lengthscale"]) in (3, 4, 5)
    assert len(outputs["reward"]["features"]) == len(outputs["reward"]["lengthscale"])
    assert set(outputs["speed"]["features"]) <= {"cos theta", "sin theta", "wrapped theta", "speed", "action 0"}
    assert outputs["speed"]["rates"] == {}


def test_a_model_description_names_dropped_features_and_nonstationary_processes(pendulum_model):
    speed = pendulum_model.transitions[1]
    feature_map = FeatureMap("cos_sin", dropped=(1,), rates=(0.0, 0.4, 0.0))
    described = describe(pendulum_model.definition, replace(speed, feature_map=feature_map))
    assert described["features"] == ["cos theta", "speed", "action 0"]
    assert described["features_left_out"] == ["sin theta"]
    assert described["rates"] == {"speed": 0.4}
