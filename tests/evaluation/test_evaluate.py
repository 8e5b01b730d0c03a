"""Evaluation takes real steps of the original environment and counts and judges them rightly."""

from dataclasses import replace
from functools import partial

import gymnasium
import numpy as np
import pytest

from support.moody import Alike, Line
from surrogym_sampler import original
from surrogym_sampler.original.actions import decode_actions, explored
from surrogym_sampler.original.episodes import open_episode
from surrogym_sampler.original.errors import NotPerturbable
from surrogym_shared.spec import Success
from surrogym_trainer.evaluation.evaluator import (
    EvaluationInterrupted,
    EvaluationSettings,
    evaluate,
    interquartile_mean,
    succeeded,
)
from surrogym_trainer.evaluation.reporting import words_of


def pendulum_policy(observation):
    """Pumps energy, then holds the pole upright."""
    cos, sin, speed = observation.T
    angle = np.arctan2(sin, cos)
    pump = 2 * np.sign(speed * (10 - (0.5 * speed**2 / 3 + 10 * cos) * 1.0))
    return np.where(cos > 0.8, -12 * angle - 3 * speed, pump).clip(-2, 2)[:, None]


def cartpole_policy(observation):
    x, velocity, pole, omega = observation.T
    return (pole + 0.3 * omega + 0.01 * x + 0.03 * velocity > 0).astype(int)


def opener(name, **options):
    spec = original.make(name, **options).spec()
    return partial(open_episode, name, spec, partial(original.make, name))


def by_gymnasium(name, policy, seeds):
    """The same episodes, run by Gymnasium itself."""
    returns, lengths = [], []
    for seed in seeds:
        env = gymnasium.make(name)
        observation, _ = env.reset(seed=seed)
        total, length, done = 0.0, 0, False
        while not done:
            action = policy(observation[None])[0]
            action = action.astype(np.float32) if isinstance(env.action_space, gymnasium.spaces.Box) else int(action)
            observation, reward, terminated, truncated, _ = env.step(action)
            total, length, done = total + float(reward), length + 1, terminated or truncated
        returns.append(total)
        lengths.append(length)
    return returns, lengths


@pytest.mark.parametrize(
    ("name", "policy"),
    [
        ("Pendulum-v1", pendulum_policy),
        ("CartPole-v1", cartpole_policy),
        ("MountainCarContinuous-v0", lambda o: np.sign(o[:, 1:])),
        ("Acrobot-v1", lambda o: np.where(o[:, 4] > 0, 2, 0)),
    ],
)
def test_evaluated_returns_equal_those_of_gymnasium(name, policy):
    result = evaluate(policy, opener(name), EvaluationSettings(episodes=4))
    returns, lengths = by_gymnasium(name, policy, range(10_000, 10_004))
    np.testing.assert_allclose(result.returns, returns, rtol=1e-5)
    assert result.lengths.tolist() == lengths
    assert result.steps == sum(lengths)


def test_success_in_cart_pole_depends_on_the_episode_length():
    good = evaluate(cartpole_policy, opener("CartPole-v1"), EvaluationSettings(episodes=3))
    bad = evaluate(lambda o: np.zeros(len(o), int), opener("CartPole-v1"), EvaluationSettings(episodes=3))
    assert good.success.all()
    assert not bad.success.any()
    assert good.summary()["success_rate"] == 1.0


def test_success_in_mountain_car_is_reaching_the_goal():
    pumping = evaluate(lambda o: np.sign(o[:, 1:]), opener("MountainCarContinuous-v0"), EvaluationSettings(episodes=2))
    idle = evaluate(lambda o: np.zeros((len(o), 1)), opener("MountainCarContinuous-v0"), EvaluationSettings(episodes=2))
    assert pumping.success.all()
    assert not idle.success.any()
    assert idle.lengths.tolist() == [999, 999]


def test_success_in_pendulum_is_being_upright_in_the_last_twenty_steps():
    held = evaluate(pendulum_policy, opener("Pendulum-v1"), EvaluationSettings(episodes=20))
    upright = np.cos(held.trace.coordinates[-20:, 0]) > 0.95
    assert held.success[0] == upright.all()
    limp = evaluate(lambda o: np.zeros((len(o), 1)), opener("Pendulum-v1"), EvaluationSettings(episodes=5))
    assert not limp.success.any()


@pytest.mark.parametrize(
    ("name", "policy"), [("Pendulum-v1", pendulum_policy), ("MountainCarContinuous-v0", lambda o: np.sign(o[:, 1:]))]
)
def test_an_episode_that_was_recorded_elsewhere_succeeds_as_an_evaluated_one(name, policy):
    opened = opener(name)()
    result = evaluate(policy, opener(name), EvaluationSettings(episodes=6))
    for trace, success in zip(result.traces, result.success, strict=True):
        states, ended = trace.coordinates[1:], trace.terminated
        assert succeeded(opened.spec, states, trace.reward, terminated=ended) == success
        assert not succeeded(opened.spec, states[:5], trace.reward[:5], terminated=False)


def test_the_evaluation_trace_is_that_of_the_first_episode():
    result = evaluate(pendulum_policy, opener("Pendulum-v1"), EvaluationSettings(episodes=2))
    assert result.trace.coordinates.shape == (201, 2)
    assert result.trace.action.shape == (200, 1)
    assert result.trace.reward.sum() == pytest.approx(result.returns[0])


def test_wide_evaluation_starts_cover_the_sampling_range_and_are_reproducible():
    settings = EvaluationSettings(episodes=30, wide=True)
    starts = []

    def policy(observation):
        if not starts:
            starts.append(observation.copy())
        return np.zeros((len(observation), 1))

    first = evaluate(policy, opener("Pendulum-v1"), settings)
    assert np.abs(starts[0][:, 2]).max() > 4
    assert evaluate(policy, opener("Pendulum-v1"), settings).returns.tolist() == first.returns.tolist()


def test_perturb_changes_physical_constants_and_the_quantities_derived_from_them():
    plain = evaluate(cartpole_policy, opener("CartPole-v1"), EvaluationSettings(episodes=3))
    changed = evaluate(cartpole_policy, opener("CartPole-v1"), EvaluationSettings(episodes=3, perturb=0.3))
    assert not np.allclose(plain.trace.coordinates[:10], changed.trace.coordinates[:10])
    episode = opener("CartPole-v1")()
    episode.perturb(np.random.default_rng(0), 0.3)
    env = episode._env
    assert env.total_mass == env.masscart + env.masspole != 1.1
    assert env.polemass_length == env.masspole * env.length


def test_perturbing_a_user_defined_environment_class_is_refused():
    """What its masses and lengths are, nobody here knows; that is no fault of the policy."""
    settings = EvaluationSettings(episodes=1, perturb=0.1)
    with pytest.raises(NotPerturbable):
        evaluate(
            lambda observation: np.zeros((len(observation), 1)),
            lambda: open_episode("line", Line().spec(), Line),
            settings,
        )


def test_a_user_defined_environment_class_can_be_evaluated():
    result = evaluate(
        lambda o: -np.sign(o), partial(open_episode, "a line", None, Line), EvaluationSettings(episodes=3)
    )
    assert result.lengths.tolist() == [20, 20, 20]
    assert result.success is None
    assert result.summary()["success_rate"] is None
    assert np.abs(result.trace.coordinates[-1, 0]) <= 0.1


def test_evaluation_decodes_binned_actions_and_keeps_action_bounds():
    spec = original.make("Pendulum-v1", bins=5).spec()
    np.testing.assert_allclose(decode_actions(spec, np.arange(5), 5)[:, 0], [-2, -1, 0, 1, 2])
    plain = original.make("Pendulum-v1").spec()
    np.testing.assert_allclose(decode_actions(plain, np.array([[5.0], [-5.0]]), 2)[:, 0], [2, -2])
    with pytest.raises(ValueError, match=r"expected actions of shape \(2, 1\), got \(3, 1\)"):
        decode_actions(plain, np.zeros((3, 1)), 2)


def test_exploration_noise_stays_within_action_bounds_and_is_reproducible():
    settings = EvaluationSettings(episodes=2, explore=0.5)
    again, alone = (evaluate(pendulum_policy, opener("Pendulum-v1"), replace(settings, parallel=n)) for n in (1, 2))
    plain = evaluate(pendulum_policy, opener("Pendulum-v1"), replace(settings, explore=0.0))
    for one, other in zip(again.traces, alone.traces, strict=True):
        np.testing.assert_allclose(one.action, other.action, atol=1e-5)  # with instances beside it, too
    first = again.trace.action
    assert np.abs(first).max() <= 2
    assert not np.allclose(first[0], plain.trace.action[0])
    assert not np.allclose(first[0], again.traces[1].action[0])
    assert not settings.declared  # the promise is for the policy itself
    assert words_of(replace(settings, explore=0.004)).endswith("actions changed at random by 0.004")


def test_exploration_replaces_a_share_of_discrete_actions():
    rng, spec = np.random.default_rng(0), original.make("CartPole-v1").spec()
    changed = np.array([explored(spec, np.array([1.0]), 0.5, rng)[0] for _ in range(2_000)])
    assert set(changed) == {0.0, 1.0}
    assert changed.mean() == pytest.approx(0.75, abs=0.05)
    binned = original.make("Pendulum-v1", bins=5).spec()
    drawn = {float(explored(binned, np.array([1.0]), 1.0, rng)[0]) for _ in range(200)}
    assert drawn == {-2.0, -1.0, 0.0, 1.0, 2.0}


def test_exploration_noise_is_relative_to_half_the_action_range():
    rng, spec = np.random.default_rng(0), original.make("Pendulum-v1").spec()
    changed = np.array([explored(spec, np.array([0.5]), 0.1, rng)[0] for _ in range(4_000)])
    assert changed.std() == pytest.approx(0.2, rel=0.05)
    with pytest.raises(ValueError, match="explore to be a share from 0 to 1, got 2"):
        EvaluationSettings(explore=2)


def test_the_interquartile_mean_leaves_out_the_outer_quarters():
    assert interquartile_mean(np.array([-1000.0, 1, 2, 3, 4, 5, 6, 1000])) == 3.5
    assert interquartile_mean(np.array([7.0])) == 7.0


def test_an_episode_succeeds_only_if_every_success_criterion_holds():
    spec = original.make("CartPole-v1").spec()
    strict = spec.model_copy(update={"success": Success(min_steps=100, min_return=1e6)})
    result = evaluate(
        cartpole_policy, partial(open_episode, "CartPole-v1", strict, lambda: None), EvaluationSettings(episodes=2)
    )
    assert not result.success.any()


def test_start_scale_widens_the_declared_start_range_about_its_middle():
    starts = []

    def policy(observation):
        starts.append(observation.copy())
        return np.zeros(len(observation), int)

    evaluate(policy, opener("CartPole-v1"), EvaluationSettings(episodes=60, start_scale=2.0))
    assert 0.09 < np.abs(starts[0]).max() <= 0.1
    with pytest.raises(ValueError, match="got both"):
        EvaluationSettings(wide=True, start_scale=2.0)


def test_an_interrupted_evaluation_reports_the_real_steps_taken():
    def interrupt(share, _):
        if share >= 3 / 200:
            raise KeyboardInterrupt

    with pytest.raises(EvaluationInterrupted) as interrupted:
        evaluate(pendulum_policy, opener("Pendulum-v1"), EvaluationSettings(episodes=2), interrupt)
    assert interrupted.value.steps == 3 * 2


def noting(factory, episodes, **choices):
    """An evaluation, and its remarks."""
    remarks = []
    opener = partial(open_episode, "a line", None, factory)
    settings = EvaluationSettings(episodes=episodes, **choices)
    result = evaluate(lambda observation: np.full((len(observation), 1), 0.5), opener, settings, remark=remarks.append)
    return result, remarks


def test_equal_evaluation_episodes_are_reported_after_the_third():
    """A deterministic plant repeated one episode a hundred times without a word."""
    result, remarks = noting(Alike, 8)
    assert result.equal
    assert result.summary()["equal"] is True
    assert len(remarks) == 1
    assert remarks[0].startswith("the first 3 of 8 episodes are equal in every number")


@pytest.mark.parametrize(("factory", "episodes"), [(Line, 8), (Alike, 1), (Alike, 3)])
def test_different_or_few_evaluation_episodes_give_no_remark_about_equality(factory, episodes):
    result, remarks = noting(factory, episodes)
    assert remarks == []
    assert result.equal is (factory is Alike and episodes > 1)


def test_episodes_that_differ_in_one_number_are_not_reported_as_equal():
    result, _ = noting(Alike, 4)
    paid = result.traces[3].reward + np.eye(5)[4] * 1e-12
    other = replace(result, traces=(*result.traces[:3], replace(result.traces[3], reward=paid)))
    assert not other.equal
