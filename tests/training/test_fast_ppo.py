"""FASTPPO: it learns as Stable-Baselines3's does, and hands over what it can't learn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.running_mean_std import RunningMeanStd

from support.acting import Forgetful
from support.models import learn
from support.ppo import OBJECTIVE, RATE, batch_of, layers, linear, reference
from support.real_steps import random_steps
from surrogym_client.environments.lanes import Lanes, session_request
from surrogym_sampler.original.classic import cartpole, mountain_car_continuous, pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.local import LocalSurrogate
from surrogym_shared.distributions import Bounded, Choices
from surrogym_shared.spec import EnvironmentSpec, MultiDiscreteAction
from surrogym_trainer.evaluation import imagined_returns
from surrogym_trainer.policies import UnusablePolicy, load_policy
from surrogym_trainer.policies.defaults import EXPLORATION
from surrogym_trainer.training import TrainingInterrupted, TrainProgress, TrainSettings, train
from surrogym_trainer.training import search as trainings
from surrogym_trainer.training.checks import Checks
from surrogym_trainer.training.fast_ppo import learner as learners
from surrogym_trainer.training.fast_ppo import search as searches
from surrogym_trainer.training.fast_ppo.learner import Learner, noisy, restored
from surrogym_trainer.training.fast_ppo.rollouts import Collector, RewardScale, Rollout
from surrogym_trainer.training.search import search_for, with_algorithm

SMALL = {"n_steps": 16, "batch_size": 32, "n_epochs": 2}


def short(spec: EnvironmentSpec) -> LocalSurrogate:
    spec = spec.model_copy(update={"time_limit": 20})
    return LocalSurrogate(spec, learn(definition_from_spec(spec), random_steps(spec, 12, seed=0)).model)


@pytest.fixture(scope="module")
def surrogate() -> LocalSurrogate:
    return short(pendulum())


def several() -> EnvironmentSpec:
    """Two choices at once."""
    return cartpole().model_copy(update={"action": MultiDiscreteAction(nvec=(3, 2))})


@pytest.mark.parametrize("make", [pendulum, cartpole, several], ids=["continuous", "discrete", "several choices"])
def test_a_fast_ppo_update_equals_that_of_stable_baselines3(make: Callable[[], EnvironmentSpec]):
    """The same parameters after three updates of the same rollout, where some ratios are clipped."""
    spec, rng = make(), np.random.default_rng(0)
    size = len(spec.observation)
    learner = Learner(spec, rng.normal(size=size), rng.uniform(0.5, 2, size), (64, 64), rng)
    learner.actor[-1][0][:] *= 100  # actions that differ
    given, batch = batch_of(learner, rng)
    made = reference(learner, spec, given)
    for _ in range(3):
        made.train()
        learner.update(batch, OBJECTIVE, RATE)
    for module, (weights, bias) in zip(linear(made), layers(learner), strict=True):
        np.testing.assert_allclose(weights.T, module.weight.detach().numpy(), atol=2e-5)
        np.testing.assert_allclose(bias, module.bias.detach().numpy(), atol=2e-5)
    if hasattr(made.policy, "log_std"):
        np.testing.assert_allclose(learner.further, made.policy.log_std.detach().numpy(), atol=2e-5)


def test_fastppo_scales_rewards_like_vec_normalize():
    rng, gamma = np.random.default_rng(1), 0.97
    scale, statistics, returns = RewardScale(5, gamma), RunningMeanStd(shape=()), np.zeros(5)
    for _ in range(50):
        reward, ended = 20 * rng.normal(size=5), rng.random(5) < 0.1
        returns = returns * gamma + reward
        statistics.update(returns)
        expected = np.clip(reward / np.sqrt(statistics.var + 1e-8), -10, 10)
        returns[ended] = 0
        np.testing.assert_allclose(scale(reward, ended), expected, rtol=1e-12)


def test_fastppo_advantages_equal_those_of_stable_baselines3():
    rng, steps, lanes = np.random.default_rng(2), 30, 4
    rewards, values = (rng.normal(size=(steps, lanes)).astype(np.float32) for _ in range(2))
    ended, last = rng.random((steps, lanes)) < 0.2, rng.normal(size=lanes).astype(np.float32)
    space = spaces.Box(-1, 1, (1,))
    buffer = RolloutBuffer(steps, space, space, gae_lambda=0.95, gamma=0.98, n_envs=lanes)
    starts = np.concatenate([np.zeros((1, lanes)), ended[:-1]])
    for t in range(steps):
        nothing = np.zeros((lanes, 1))
        value, log = torch.from_numpy(values[t]), torch.zeros(lanes)
        buffer.add(nothing, nothing, rewards[t], starts[t], value, log)
    buffer.compute_returns_and_advantage(torch.from_numpy(last), ended[-1])
    collector = Collector.__new__(Collector)
    collector._gamma, collector._lambda = 0.98, 0.95
    np.testing.assert_allclose(
        collector._advantages(rewards, ended, values, last), buffer.advantages, rtol=1e-4, atol=1e-5
    )


def test_a_lost_session_truncates_its_episodes_and_collection_continues(surrogate):
    """One step of the rollout ends them where they stood; the others are taken in a new session."""
    spec, lanes = surrogate.spec(), 6
    learner = Learner(spec, np.zeros(3), np.ones(3), (8,), np.random.default_rng(0))
    whole, cut = (
        Collector(Lanes(port, session_request(lanes, "same_step", {"seed": 3})), 0.95, 0.95, seed=0)
        for port in (surrogate, Forgetful(surrogate, at=2))
    )
    first, same = whole.collect(learner, 10), cut.collect(learner, 10)
    np.testing.assert_array_equal(same.rows.observations, first.rows.observations)
    following, lost = whole.collect(learner, 10), cut.collect(learner, 10)
    assert (first.lost, following.lost, lost.lost) == (0, 0, lanes)
    np.testing.assert_array_equal(lost.rows.observations[:lanes], following.rows.observations[:lanes])
    np.testing.assert_array_equal(lost.rows.actions[:lanes], following.rows.actions[:lanes])
    assert not np.array_equal(lost.rows.observations[lanes:], following.rows.observations[lanes:])
    assert lost.rows.observations.shape == following.rows.observations.shape
    assert len(lost.earned) == 0, "episodes of twenty steps, none of which ended by itself"
    assert len(following.earned) == lanes


def test_imagined_episodes_restart_if_the_session_is_lost(surrogate):
    network = Learner(surrogate.spec(), np.zeros(3), np.ones(3), (8,), np.random.default_rng(0)).policy()
    returns = [imagined_returns(port, network, 4, 0) for port in (surrogate, Forgetful(surrogate, at=1))]
    np.testing.assert_array_equal(*returns)


def test_discrete_actions_are_drawn_with_their_probabilities():
    scores = np.array([[1.0, 0.0, -1.0, 0.5, 0.0]], dtype=np.float32)
    choices, rng = Choices((3, 2)), np.random.default_rng(0)
    none = np.zeros(0, dtype=np.float32)
    actions, logs = choices.sample(np.repeat(scores, 40_000, 0), none, rng)
    np.testing.assert_allclose(logs, choices.log_probability(np.repeat(scores, 40_000, 0), logs[:0], actions))
    for i, part in enumerate(np.split(scores[0], [3])):
        expected = np.exp(part) / np.exp(part).sum()
        found = np.bincount(actions[:, i].astype(int)) / len(actions)
        np.testing.assert_allclose(found, expected, atol=0.01)
    assert choices.sent(actions).shape == (40_000, 2)


def test_continuous_actions_are_normal_around_the_mean_and_clipped_to_bounds():
    bounded, rng = Bounded(np.float32([1.0]), np.float32([2.0])), np.random.default_rng(0)
    outputs = np.full((40_000, 1), 0.5, dtype=np.float32)
    further = np.zeros(1, dtype=np.float32)
    actions, logs = bounded.sample(outputs, further, rng)
    assert actions.mean() == pytest.approx(1 + 2 * np.tanh(0.5), abs=0.02)
    assert actions.std() == pytest.approx(1.0, abs=0.02)
    np.testing.assert_allclose(logs, bounded.log_probability(outputs, further, actions), atol=1e-5)
    assert actions.max() > 3
    assert bounded.sent(actions).max() == 3


def test_fastppo_learns_to_improve_its_return(tmp_path: Path):
    """An untrained CartPole falls after some twenty steps."""
    spec = cartpole().model_copy(update={"time_limit": 100})
    port = LocalSurrogate(spec, learn(definition_from_spec(spec), random_steps(spec, 40, seed=0)).model)
    settings = TrainSettings(algorithm="fastppo", total_steps=50_000, num_envs=32, prolong=False)
    assert train(port, tmp_path / "policy.zip", settings).imagined_return > 80


def test_a_policy_saved_by_fastppo_acts_with_and_without_noise(surrogate, tmp_path: Path):
    settings = TrainSettings(algorithm="fastppo", total_steps=512, num_envs=16, hyperparameters=SMALL)
    path = train(surrogate, tmp_path / "policy.zip", settings).path
    observations = np.random.default_rng(0).normal(size=(2_000, 3)).astype(np.float32)
    surely, first, again = (act(observations) for act in (load_policy(path), noisy(path), noisy(path)))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - surely).mean() > 0.1
    assert np.abs(first).max() <= 2


@pytest.mark.parametrize("make", [pendulum, cartpole], ids=["continuous", "discrete"])
def test_restandardising_the_inputs_does_not_change_the_policy(make: Callable[[], EnvironmentSpec]):
    """An input that hardly varies keeps a tenth of its deviation, so that it does not explode where it varies later."""
    spec, rng = make(), np.random.default_rng(0)
    size = len(spec.observation)
    learner = Learner(spec, rng.normal(size=size), rng.uniform(1, 2, size), (16, 16), rng)
    learner.actor[-1][0][:] = rng.normal(size=learner.actor[-1][0].shape)
    observations = (3 + 0.5 * rng.normal(size=(200, size))).astype(np.float32)
    observations[:, 0] = 0.7
    before, critic = learner.policy().outputs(observations), learner.values(learner.standardised(observations))
    narrowest = 0.1 * learner.deviation[0]
    learner.standardise_anew(learner.standardised(observations), rng)
    np.testing.assert_allclose(learner.policy().outputs(observations), before, atol=1e-5)
    inputs = learner.standardised(observations)
    np.testing.assert_allclose(inputs.mean(0), 0, atol=1e-4)
    np.testing.assert_allclose(inputs.std(0)[1:], 1, atol=1e-3)
    assert learner.deviation[0] == pytest.approx(narrowest, rel=1e-5)
    assert np.abs(learner.values(inputs) - critic).max() > 0.1, "the critic is a new one"


def watched(monkeypatch: pytest.MonkeyPatch) -> list[dict]:
    """The session fields of the lanes that are opened."""
    opened: list[dict] = []

    def seen(num_envs: int, mode: str, options: dict):
        opened.append(options)
        return session_request(num_envs, mode, options)

    monkeypatch.setattr(searches, "session_request", seen)
    return opened


def test_fastppo_refines_its_policy_from_the_declared_starts(surrogate, tmp_path: Path, monkeypatch):
    """The policy is never worse in the surrogate than before. Chosen steps are not followed by it."""
    opened = watched(monkeypatch)
    settings = TrainSettings(algorithm="fastppo", total_steps=4_096, num_envs=16, hyperparameters=SMALL, prolong=False)
    plain = train(surrogate, tmp_path / "plain.zip", settings)
    assert plain.virtual_steps == 4_096
    assert [one["start_box"] for one in opened] == [0.5]
    seen: list[TrainProgress] = []
    refined = train(surrogate, tmp_path / "refined.zip", replace(settings, prolong=True), seen.append)
    assert [one["start_box"] for one in opened[1:]] == [0.5, 0.0]
    assert [one["stage"] for one in refined.settings["cycles"]][-1] == "refine"
    assert (refined.settings["gamma"], refined.settings["time_limit"]) == (0.9, 20), "of the stage learn"
    assert all(now.steps <= now.total_steps for now in seen)
    assert list(dict.fromkeys(now.stage for now in seen)) == ["learn", "refine"], "each stage has lines of its own"
    further = replace(settings, prolong=True, start_from=refined.path)
    assert train(surrogate, tmp_path / "further.zip", further).imagined_return >= refined.imagined_return


def test_a_training_with_long_episodes_that_nothing_ends_is_one_long_cycle_and_keeps_its_noise(tmp_path: Path):
    """Each rollout has 64 steps of each lane, and the cycle takes three times the steps."""
    spec = pendulum().model_copy(update={"time_limit": 321})
    port = LocalSurrogate(spec, learn(definition_from_spec(spec), random_steps(spec, 12, seed=0)).model)
    settings = TrainSettings(total_steps=512, num_envs=4, prolong=True, hyperparameters={"n_epochs": 2})
    trained = train(port, tmp_path / "long.zip", settings)
    assert trained.settings["n_steps"] == 64
    first, *others = trained.settings["cycles"]
    assert (first["stage"], first["virtual_steps"]) == ("learn", 3 * 512)
    assert [one["stage"] for one in others] == ["refine"]
    learner = restored(trained.path, spec, (64, 64))
    learner.further[:] = -9.0
    learner.keep_noise(0.5)
    assert np.exp(learner.further) == pytest.approx(0.5 * EXPLORATION * 2, rel=1e-5), "half of 0.5 times 2 N m"


def test_fastppo_continues_from_a_saved_policy(surrogate, tmp_path: Path):
    """Parameters and the moments of Adam; a policy alone is refused."""
    settings = TrainSettings(algorithm="fastppo", total_steps=512, num_envs=16, hyperparameters=SMALL, prolong=False)
    first = train(surrogate, tmp_path / "first.zip", settings).path
    resumed = replace(settings, start_from=first)
    train(surrogate, tmp_path / "second.zip", resumed)
    load_policy(first).save(tmp_path / "alone.zip")
    with pytest.raises(UnusablePolicy, match="no state of a training"):
        train(
            surrogate,
            tmp_path / "third.zip",
            TrainSettings(**{**resumed.__dict__, "start_from": tmp_path / "alone.zip"}),
        )


def learned(monkeypatch: pytest.MonkeyPatch, value: bool) -> None:
    """Let every check find that a network has learned something, or nothing."""
    monkeypatch.setattr(Checks, "learned", property(lambda _: value))


@pytest.mark.parametrize(
    ("spec", "noise"),
    [(mountain_car_continuous(), [1, searches.HELD]), (cartpole(), [1])],
    ids=["continuous", "discrete"],
)
def test_a_network_that_does_not_learn_is_replaced_by_a_new_one(spec, noise, tmp_path: Path, monkeypatch):
    """Every second one explores by held noise, where actions are continuous. All of them together stay within the
    chosen steps."""
    holds: list[int] = []

    class Watched(Collector):
        def collect(self, learner: Learner, steps: int, hold: int = 1) -> Rollout:
            holds.append(hold)
            return super().collect(learner, steps, hold)

    learned(monkeypatch, False)
    monkeypatch.setattr(searches, "PATIENT_ROLLOUTS", 2)
    monkeypatch.setattr(searches, "Collector", Watched)
    seen: list[int] = []
    settings = TrainSettings(algorithm="fastppo", total_steps=4_096, num_envs=16, hyperparameters=SMALL, prolong=False)
    result = train(short(spec), tmp_path / "policy.zip", settings, lambda now: seen.append(now.steps))
    assert seen == sorted(seen)
    assert result.networks == 3, "each has a third of the steps"
    assert list(dict.fromkeys(holds)) == noise
    assert 3_500 < result.virtual_steps <= settings.total_steps
    load_policy(result.path, result.algorithm)


@pytest.mark.parametrize(("gained", "cycles"), [(True, 6), (False, 1)], ids=["while it gains", "it gains no more"])
def test_training_cycles_continue_while_the_last_one_improved(
    surrogate, gained: bool, cycles: int, tmp_path: Path, monkeypatch
):
    learned(monkeypatch, True)
    monkeypatch.setattr(Checks, "gained", lambda *_: gained)
    settings = TrainSettings(algorithm="fastppo", total_steps=3_072, num_envs=16, hyperparameters=SMALL, prolong=True)
    seen: list[TrainProgress] = []
    result = train(surrogate, tmp_path / "policy.zip", settings, seen.append)
    assert [one["stage"] for one in result.settings["cycles"]] == ["learn"] * cycles + ["refine"]
    totals = list(dict.fromkeys(now.total_steps for now in seen))
    assert len(totals) == cycles, "the total grows with a further cycle alone"
    assert totals[-1] == seen[-1].steps
    assert result.gaining is gained


def test_with_option_anew_the_saved_policy_is_kept_until_a_new_network_is_comparable(
    surrogate, tmp_path: Path, monkeypatch
):
    """With ``anew`` a new network learns beside it. The saved one is trained further only if that one falls short."""
    monkeypatch.setattr(searches, "PATIENT_ROLLOUTS", 2)
    small = {"total_steps": 2_048, "num_envs": 16, "hyperparameters": SMALL, "prolong": False}
    start = train(surrogate, tmp_path / "first.zip", TrainSettings("fastppo", **small))
    further = TrainSettings("fastppo", start_from=start.path, anew=True, **small)
    assert train(surrogate, tmp_path / "further.zip", further).imagined_return > start.untrained
    hopeless = replace(further, hyperparameters=SMALL | {"learning_rate": 0.0})
    result = train(surrogate, tmp_path / "hopeless.zip", hopeless)
    assert result.networks == 2
    assert result.imagined_return == pytest.approx(start.imagined_return)


def test_fastppo_refuses_to_continue_a_stable_baselines3_policy(surrogate, tmp_path: Path):
    small = {"total_steps": 512, "num_envs": 16, "hyperparameters": SMALL, "prolong": False}
    start = train(surrogate, tmp_path / "first.zip", TrainSettings("ppo", **small)).path
    with pytest.raises(UnusablePolicy, match="which it has not saved: leave --algorithm out"):
        train(surrogate, tmp_path / "further.zip", TrainSettings("fastppo", start_from=start, **small))
    with pytest.raises(UnusablePolicy, match=r"missing\.zip, which is no file"):
        train(
            surrogate, tmp_path / "further.zip", TrainSettings("fastppo", start_from=tmp_path / "missing.zip", **small)
        )


def test_ppo_of_stable_baselines3_is_the_default_where_nothing_can_be_compiled(tmp_path: Path, monkeypatch):
    for module in (learners, trainings):
        monkeypatch.setattr(module, "available", lambda: False)
    learners.compiled_update.cache_clear()
    assert with_algorithm(TrainSettings(), pendulum()).algorithm == "PPO"
    with pytest.raises(ValueError, match=r"expected numba and SciPy.*pip install.*--algorithm ppo"):
        train(short(pendulum()), tmp_path / "policy.zip", TrainSettings(algorithm="fastppo"))


def test_fastppo_ends_early_if_nothing_can_be_gained(surrogate, tmp_path: Path, monkeypatch):
    monkeypatch.setattr(Checks, "saturated", property(lambda self: self.best is not None))
    settings = TrainSettings(algorithm="fastppo", total_steps=8_192, num_envs=16, hyperparameters=SMALL, prolong=True)
    result = train(surrogate, tmp_path / "policy.zip", settings)
    assert 0 < result.virtual_steps < 8_192
    assert [one["stage"] for one in result.settings["cycles"]] == ["learn"]
    load_policy(result.path, result.algorithm)


def test_ctrl_c_during_fastppo_keeps_the_best_policy_so_far(surrogate, tmp_path: Path):
    def interrupt(now) -> None:
        if now.imagined_return is not None:
            raise KeyboardInterrupt

    settings = TrainSettings(algorithm="fastppo", total_steps=8_192, num_envs=16, hyperparameters=SMALL)
    with pytest.raises(TrainingInterrupted) as interruption:
        train(surrogate, tmp_path / "policy.zip", settings, interrupt)
    assert 0 < interruption.value.result.virtual_steps < 8_192
    load_policy(interruption.value.result.path)


@pytest.mark.parametrize(
    ("name", "value"),
    [("n_steps", 0), ("n_steps", 2.5), ("n_steps", True), ("clip_range", -1.0), ("gamma", 2.0), ("n_epochs", "x")],
)
def test_invalid_fastppo_settings_are_refused(name: str, value: object):
    with pytest.raises(ValueError, match=f"{name}: expected .* got {value!r}"):
        search_for(TrainSettings(algorithm="fastppo", hyperparameters={name: value}))
