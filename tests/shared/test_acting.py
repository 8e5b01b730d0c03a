"""How a policy of arrays acts: as its network does without noise, and with noise that its key alone decides."""

from __future__ import annotations

import numpy as np
import pytest

from support.acting import random_policy
from surrogym_shared.acting import ActingPolicy, Actor, KeyedGenerator, NoiseKey
from surrogym_shared.distributions import Choices
from surrogym_shared.network import Layer, Network

LOW, HIGH = np.array([-2.0, 0.0]), np.array([2.0, 1.0])
NONE = np.zeros(0)


def actor(counts: tuple[int, ...] = ()) -> Actor:
    if counts:
        return Actor(random_policy((3, 8, sum(counts)), continuous=False), 3, NONE, NONE, counts, noisy=True)
    return Actor(random_policy((3, 8, 2)), 3, LOW, HIGH, noisy=True)


def observations(lanes: int) -> np.ndarray:
    return np.random.default_rng(1).normal(size=(lanes, 3)).astype(np.float32)


@pytest.mark.parametrize("counts", [(), (4,), (3, 2)], ids=["continuous", "one choice", "two choices"])
def test_a_policy_without_noise_gives_the_actions_of_its_network(counts: tuple[int, ...]):
    policy = random_policy((3, 8, sum(counts) or 2), np.float64, continuous=not counts)
    low, high = (NONE, NONE) if counts else (LOW, HIGH)
    network = Network(policy.mean, policy.deviation, policy.layers, low, high, counts, policy.activation)
    acted = Actor(ActingPolicy.of(network), 3, low, high, counts).act(observations(9), None)
    np.testing.assert_array_equal(acted.sent, network(observations(9)), strict=True)
    assert acted.log_probability is None
    assert acted.action.shape == (9, len(counts) or 2)


@pytest.mark.parametrize("counts", [(), (4,), (3, 2)], ids=["continuous", "one choice", "two choices"])
def test_action_noise_depends_only_on_seed_step_and_environment_number(counts: tuple[int, ...]):
    """Not on the other lanes, nor on what was drawn before."""
    few, many = (actor(counts).act(observations(lanes), NoiseKey(5, 70)) for lanes in (4, 900))
    np.testing.assert_allclose(few.action, many.action[:4], atol=1e-6)
    np.testing.assert_allclose(few.log_probability, many.log_probability[:4], atol=1e-5)
    for other in (NoiseKey(6, 70), NoiseKey(5, 71)):
        assert not np.array_equal(actor(counts).act(observations(900), other).action, many.action)
    assert NoiseKey(5, 60).later(10) == NoiseKey(5, 70)


def test_held_action_noise_is_constant_for_the_given_number_of_steps():
    drawn = [actor().act(observations(4), NoiseKey(5, step, hold=4)).action for step in range(9)]
    for step in range(1, 9):
        assert np.array_equal(drawn[step], drawn[step - 1]) == (step % 4 != 0)
    assert NoiseKey(5, 60, 4).later(10) == NoiseKey(5, 70, 4)


def test_action_noise_equals_numpys_philox_keyed_by_seed_and_step():
    keyed = KeyedGenerator()
    keyed.at(NoiseKey(9, 9)).standard_normal(3, dtype=np.float32)
    drawn = keyed.at(NoiseKey(2**63 - 1, 5)).standard_normal(7)
    made = np.random.Generator(np.random.Philox(key=2**63 - 1, counter=5 << 128))
    np.testing.assert_array_equal(drawn, made.standard_normal(7))


def test_log_probabilities_of_noisy_actions_equal_the_normal_density():
    acted = actor().act(observations(50), NoiseKey(1))
    policy, x = actor().policy, observations(50)
    middle = np.array([0, 0.5]) + np.array([2, 0.5]) * np.tanh(
        np.tanh((x - policy.mean) / policy.deviation @ policy.layers[0].weights + policy.layers[0].bias)
        @ policy.layers[1].weights
        + policy.layers[1].bias
    )
    z = (acted.action - middle) / np.exp(policy.log_deviations)
    expected = (-0.5 * z**2 - policy.log_deviations - 0.5 * np.log(2 * np.pi)).sum(1)
    np.testing.assert_allclose(acted.log_probability, expected, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(acted.sent, acted.action.clip(LOW, HIGH), atol=1e-6)
    assert (acted.action > HIGH).any()


def test_noisy_actions_have_the_same_distribution_in_both_float_precisions():
    for dtype in (np.float32, np.float64):
        made = Actor(random_policy((3, 2), dtype), 3, LOW, HIGH, noisy=True)
        rows = np.zeros((20_000, 3), dtype=np.float32)
        action, middle = made.act(rows, NoiseKey(0)).action, made.act(rows[:1], None).action
        assert action.dtype == dtype
        np.testing.assert_allclose(action.std(0), np.exp(made.policy.log_deviations), rtol=0.03)
        np.testing.assert_allclose(action.mean(0), middle[0], atol=0.05)


def test_a_policy_with_mixed_float_precisions_is_refused():
    policy = random_policy((3, 2))
    mixed = (Layer(policy.layers[0].weights.astype(np.float64), policy.layers[0].bias),)
    with pytest.raises(ValueError, match=r"expected layers\[0\].weights as float32, got float64"):
        ActingPolicy(policy.mean, policy.deviation, mixed)


def test_a_zero_random_draw_for_a_discrete_action_raises_no_warning():
    class Draws:
        def standard_exponential(self, shape: tuple[int, int], dtype: type) -> np.ndarray:
            return np.array([[1.0, 0.0, 1.0]], dtype=dtype)

    outputs = np.array([[5.0, 0.0, 5.0]], dtype=np.float32)
    actions, _ = Choices((3,)).sample(outputs, np.zeros(0, dtype=np.float32), Draws())
    assert actions.tolist() == [[1.0]]
