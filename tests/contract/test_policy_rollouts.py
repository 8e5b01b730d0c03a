"""A policy on the surrogate's side does what it would do step by step, on every transport and in process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support.acting import Stepwise, assert_same_rollout, random_policy, stepped
from surrogym_shared.acting import ActingPolicy, Actor, NoiseKey
from surrogym_shared.network import Layer, Network
from surrogym_shared.port import PolicyPort
from surrogym_shared.wire import OpenSession
from surrogym_trainer.evaluation.imagined import imagine
from surrogym_trainer.training import TrainSettings, train
from surrogym_trainer.training.fast_ppo.learner import restored

N, SIZES = 5, (3, 16, 8, 1)  # of Pendulum: 3 observation entries, 1 action entry
Opened = Callable[..., str]


@pytest.fixture
def port(harness) -> PolicyPort:
    assert isinstance(harness.port, PolicyPort)
    return harness.port


@pytest.fixture
def opened(port: PolicyPort):
    """Opens sessions of N lanes with seed 7 and episodes of 4 steps, and closes them at the end."""
    sessions = []

    def open_session(**options: Any) -> str:
        asked = {"num_envs": N, "seed": 7, "time_limit": 4, "autoreset_mode": "same_step", **options}
        sessions.append(port.open(OpenSession(**asked)).id)
        return sessions[-1]

    yield open_session
    for session in sessions:
        port.close(session)


def actor_of(policy: ActingPolicy, noise: NoiseKey | None) -> Actor:
    return Actor(policy, 3, np.array([-2.0]), np.array([2.0]), noisy=noise is not None)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("noise", [None, NoiseKey(11, 3), NoiseKey(11, 3, 4)], ids=["most probable", "noisy", "held"])
@pytest.mark.parametrize("mode", ["same_step", "next_step"])
def test_a_policy_rollout_equals_single_steps_bit_for_bit(port: PolicyPort, opened: Opened, mode: str, noise, dtype):
    """Bit for bit: episodes end and begin within the rollout, and a penalty and a trusted range are on."""
    options = {"autoreset_mode": mode, "penalty": 1.5, "trust": 100.0}
    whole, single = opened(**options), opened(**options)
    port.reset(whole)
    start = port.reset(single).observation
    policy = random_policy(SIZES, dtype)
    ours = port.rollout_policy(whole, policy, 11, noise=noise)
    theirs = stepped(port, single, actor_of(policy, noise), start, 11, noise)
    assert_same_rollout(ours, theirs)
    assert ours.truncated.any()
    assert (len(ours.final_lanes) == 2 * N) == (mode == "same_step")
    assert (ours.log_probability is None) == (noise is None)
    assert ours.action.dtype == np.float64
    assert (np.abs(ours.action) > 2).any() == (noise is not None), "noise leaves the bounds before it is clipped"


@pytest.mark.parametrize("variant", ["probabilistic", "pathwise"])
def test_policy_rollouts_of_every_session_variant_equal_single_steps(port: PolicyPort, opened: Opened, variant: str):
    noisy = {"process_noise": True, "sensor_noise": {"speed": 0.1}}
    options = {"variant": variant, **noisy} | ({"particles": 9} if variant == "probabilistic" else {})
    whole, single, noise = opened(**options), opened(**options), NoiseKey(0)
    port.reset(whole)
    start = port.reset(single).observation
    policy = random_policy(SIZES)
    ours = port.rollout_policy(whole, policy, 6, noise=noise)
    assert_same_rollout(ours, stepped(port, single, actor_of(policy, noise), start, 6, noise))


def test_two_consecutive_rollouts_equal_one_if_the_noise_continues(port: PolicyPort, opened: Opened):
    once, twice, noise, policy = opened(), opened(), NoiseKey(2), random_policy(SIZES)
    port.reset(once)
    port.reset(twice)
    whole = port.rollout_policy(once, policy, 9, noise=noise)
    parts = [port.rollout_policy(twice, policy, t, noise=noise.later(first)) for first, t in ((0, 5), (5, 4))]
    for name in ("action", "log_probability", "observation", "reward", "terminated"):
        np.testing.assert_array_equal(np.concatenate([getattr(part, name) for part in parts]), getattr(whole, name))


def test_a_rollout_stops_once_every_awaited_environment_has_ended_an_episode(port: PolicyPort, opened: Opened):
    session, policy = opened(), random_policy(SIZES)
    port.reset(session)
    port.rollout_policy(session, policy, 1)
    assert len(port.rollout_policy(session, policy, 50, until=np.arange(N) < 2)) == 3, "three steps were left"
    assert len(port.rollout_policy(session, policy, 2, until=np.ones(N, dtype=bool))) == 2, "fewer than until"


def test_the_action_noise_of_a_rollout_is_reproducible_from_its_seed(port: PolicyPort, opened: Opened):
    policy, seeds = random_policy(SIZES), (4, 4, 5)
    actions = []
    for seed in seeds:
        session = opened()
        port.reset(session)
        actions.append(port.rollout_policy(session, policy, 3, noise=NoiseKey(seed)).action)
    np.testing.assert_array_equal(actions[0], actions[1])
    assert not np.isin(actions[2], actions[0]).any()


GOOD = random_policy(SIZES)
HUGE = tuple(Layer(np.full_like(one.weights, 3e38), np.full_like(one.bias, 3e38)) for one in GOOD.layers)
BAD: dict[str, tuple[dict[str, Any], str]] = {
    "another observation": ({"policy": random_policy((4, 8, 1))}, "mean"),
    "another action": (
        {"policy": random_policy((3, 8, 2))},
        "expected 1 units in the last layer, as the action space needs, got 2",
    ),
    "no deviations for noise": (
        {"policy": replace(GOOD, log_deviations=None), "noise": NoiseKey(0)},
        "expected log_deviations with noise, got none",
    ),
    "deviations of another action": (
        {"policy": replace(GOOD, log_deviations=np.zeros(2, dtype=np.float32))},
        "expected log_deviations of 1 entries, got 2",
    ),
    "no steps": ({"steps": 0}, "steps: expected 1 to 100000, got 0"),
    "too many steps": ({"steps": 100_001}, "steps: expected 1 to 100000, got 100001"),
    "negative seed of noise": ({"noise": NoiseKey(-1)}, "noise: expected a seed"),
    "noise held for no step": ({"noise": NoiseKey(0, 0, 0)}, "a hold of 1 or more"),
    "short until": ({"until": np.ones(N + 1, dtype=bool)}, "until: expected (5 entries|shape)"),
    "outputs beyond all bounds": ({"policy": replace(GOOD, layers=HUGE, activation="relu")}, "finite outputs"),
}


@pytest.mark.parametrize("what", list(BAD))
def test_a_rollout_with_an_invalid_policy_is_refused_and_changes_nothing(
    port: PolicyPort, opened: Opened, harness, what: str
):
    touched, undisturbed = opened(), opened()
    port.reset(touched)
    port.reset(undisturbed)
    given, message = BAD[what]
    asked = {"policy": GOOD, "steps": 3, **given}
    with pytest.raises(harness.errors.InvalidInput, match=message):
        port.rollout_policy(touched, **asked)
    ours, theirs = (port.rollout_policy(session, GOOD, 2) for session in (touched, undisturbed))
    assert_same_rollout(ours, theirs)


def test_a_policy_rollout_before_the_first_reset_is_refused(port: PolicyPort, opened: Opened, harness):
    with pytest.raises(harness.errors.NotReset):
        port.rollout_policy(opened(), GOOD, 2)


def test_with_autoreset_disabled_a_rollout_beyond_an_episode_end_is_refused(port: PolicyPort, opened: Opened, harness):
    touched, undisturbed = opened(autoreset_mode="disabled"), opened(autoreset_mode="disabled")
    port.reset(touched)
    port.reset(undisturbed)
    with pytest.raises(harness.errors.NotReset):
        port.rollout_policy(touched, GOOD, 5)
    ours, theirs = (port.rollout_policy(session, GOOD, 4) for session in (touched, undisturbed))
    assert_same_rollout(ours, theirs)


def test_a_rollout_with_too_many_steps_over_all_environments_is_refused(port: PolicyPort, opened: Opened, harness):
    session = opened(num_envs=11)
    port.reset(session)
    with pytest.raises(harness.errors.TooLarge, match="1000000"):
        port.rollout_policy(session, GOOD, 100_000)


def test_a_policy_layer_too_wide_for_the_number_of_environments_is_refused(port: PolicyPort, opened: Opened, harness):
    session = opened(num_envs=20_000)
    port.reset(session)
    with pytest.raises(harness.errors.TooLarge, match="widest layer times lanes"):
        port.rollout_policy(session, random_policy((3, 1_000, 1)), 1)


@pytest.mark.parametrize("episodes", [1, 7])
def test_the_imagined_return_is_equal_by_rollouts_and_by_single_steps(port: PolicyPort, episodes: int):
    arrays = random_policy(SIZES, np.float64)
    network = Network(arrays.mean, arrays.deviation, arrays.layers, np.array([-2.0]), np.array([2.0]))
    ours = imagine(port, network, episodes, 3, penalty=1.0)
    theirs = imagine(port, lambda observation: network(observation), episodes, 3, penalty=1.0)
    np.testing.assert_array_equal(ours.returns, theirs.returns)
    assert ours.episode_penalty == theirs.episode_penalty > 0
    assert ours.penalty_share == pytest.approx(theirs.penalty_share)


def test_fastppo_learns_the_same_policy_by_rollouts_and_by_single_steps(
    port: PolicyPort, local_harness, tmp_path: Path
):
    """By rollouts over each transport, and by single steps in process: the same parameters, bit for bit."""
    settings = TrainSettings(
        algorithm="fastppo",
        total_steps=1_024,
        num_envs=16,
        hyperparameters={"n_steps": 16, "batch_size": 64, "n_epochs": 2},
        session={"time_limit": 12},
        prolong=False,
    )
    policies = []
    for number, one in enumerate((port, Stepwise(local_harness.port))):
        path = train(one, tmp_path / f"{number}.zip", settings).path
        policies.append(restored(path, one.spec(), (64, 64)).parameters)
    np.testing.assert_array_equal(*policies)
