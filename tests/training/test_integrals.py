"""Integrals of errors as observations: the same sums in virtual and real episodes, from 0 at each reset."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from support.models import learn
from support.moody import DECLARED, SPEC
from support.real_steps import random_steps
from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.local import LocalSurrogate
from surrogym_shared.integrals import UNIT, Integrals, errors_of
from surrogym_shared.network import Network
from surrogym_shared.spec import DeclaredReward, Quantity, RewardTerm, Term
from surrogym_shared.wire import OpenSession
from surrogym_trainer.deployment.reading import controller_of
from surrogym_trainer.evaluation import imagined_returns
from surrogym_trainer.policies import load_policy
from surrogym_trainer.policies.card import read_card
from surrogym_trainer.policies.integrals import acting_with_integrals, with_integrals
from surrogym_trainer.policies.predict import PerEpisode
from surrogym_trainer.training import TrainSettings, train

LIMIT = 8  # steps of an episode
WIDTH = UNIT * 16  # of the error of the speed, whose sampling range is 16 wide


@pytest.fixture(scope="module")
def turning() -> LocalSurrogate:
    """A pendulum that is to turn at 1 rad/s."""
    error = Quantity(term=Term.linear(speed=0.5) + Term.constant(-0.5))
    reward = DeclaredReward(kind="declared", terms=(RewardTerm(shape="bump", of=(error,)),))
    spec = pendulum().model_copy(update={"time_limit": LIMIT, "reward": reward})
    return LocalSurrogate(spec, learn(definition_from_spec(spec), random_steps(spec, 25, seed=0)).model)


@pytest.mark.parametrize("mode", ["same_step", "next_step"])
def test_integrals_are_sums_of_clipped_errors_and_begin_at_0_in_each_episode(
    turning: LocalSurrogate, mode: Any
) -> None:
    port = with_integrals(turning, ("speed",), {"speed": 2.0})
    assert port.spec().observation_names[-1] == "integral of speed"
    view = port.open(OpenSession(num_envs=3, seed=4, autoreset_mode=mode))
    assert (view.observation_space.low[-1], view.observation_space.high[-1]) == (-1, 1)
    shown = port.reset(view.id).observation
    sums, begins, ends = np.zeros(3), False, 0
    for _ in range(2 * LIMIT):
        assert shown.shape == (3, 4)
        np.testing.assert_allclose(shown[:, 3], sums, atol=1e-6)
        result = port.step(view.id, np.zeros((3, 1)))
        shown, ended = result.observation, result.truncated.all()
        if begins:  # this step only began the next episode
            sums = np.zeros(3)
        elif ended and mode == "same_step":
            last = np.clip(sums + (result.final_observation[:, 2] - 2) / WIDTH, -1, 1)
            np.testing.assert_allclose(result.final_observation[:, 3], last, atol=1e-6)
            sums = np.zeros(3)
        else:
            sums = np.clip(sums + (shown[:, 2] - 2) / WIDTH, -1, 1)
        begins = ended and mode == "next_step"
        ends += bool(ended)
    assert ends == (2 if mode == "same_step" else 1)


def test_a_masked_reset_clears_the_integrals_of_these_lanes_alone(turning: LocalSurrogate) -> None:
    port = with_integrals(turning, ("speed",), {})
    session = port.open(OpenSession(num_envs=2, seed=4)).id
    port.reset(session)
    before = port.step(session, np.full((2, 1), 2.0)).observation[:, 3]
    after = port.reset(session, mask=np.array([True, False])).observation[:, 3]
    assert before.all()
    assert after.tolist() == [0, before[1]]


def test_a_real_episode_shows_the_policy_the_same_integrals(turning: LocalSurrogate) -> None:
    port, seen = with_integrals(turning, ("speed",), {}), []
    session = port.open(OpenSession(num_envs=1, seed=4)).id
    rows = [port.reset(session).observation, *(port.step(session, np.ones((1, 1))).observation for _ in range(4))]

    def policy(observation: np.ndarray) -> np.ndarray:
        seen.append(observation[0])
        return observation[:, :1]

    acting = acting_with_integrals(policy, turning.spec(), ("speed",), {})
    assert isinstance(acting, PerEpisode)
    for row in rows:
        acting.actions([7], row[:, :3])
    np.testing.assert_array_equal(seen, np.concatenate(rows))
    assert acting_with_integrals(policy, turning.spec(), (), {}) is policy


def test_a_policy_that_sees_an_integral_is_trained_and_its_card_names_it(turning: LocalSurrogate, tmp_path) -> None:
    settings = TrainSettings(algorithm="fastppo", total_steps=2_000, integral=("speed",))
    result = train(turning, tmp_path / "policy.zip", settings)
    policy = load_policy(result.path)
    assert isinstance(policy, Network)
    assert len(policy.mean) == 4
    assert read_card(result.path).integral == ("speed",)
    assert np.isfinite(imagined_returns(with_integrals(turning, ("speed",), {}), policy, 4, 0)).all()
    assert [lag.name for lag in controller_of(result.path, turning.spec()).lags] == ["integral of speed"]


@pytest.mark.parametrize(
    ("algorithm", "name", "said"),
    [
        ("fastppo", "theta", "expected a coordinate with one set point in a declared reward, 'speed', got 'theta'"),
        ("planner", "speed", "expected no integral, because a planner corrects lasting disturbances itself, got speed"),
    ],
)
def test_an_integral_that_can_not_be_had_is_refused_before_training(turning, tmp_path, algorithm, name, said) -> None:
    with pytest.raises(ValueError, match=said):
        train(turning, tmp_path / "policy.zip", TrainSettings(algorithm=algorithm, integral=(name,)))
    assert not list(tmp_path.iterdir())


def test_an_integral_needs_a_declared_reward_and_an_observation_of_the_coordinate() -> None:
    with pytest.raises(
        ValueError, match="one set point in a declared reward, which this reward does not have, got 'x'"
    ):
        errors_of(SPEC, ("x",), {})
    hidden = DECLARED.observation[0].model_copy(update={"term": Term.sin(x=1)})
    with pytest.raises(ValueError, match="expected a coordinate that an observation entry shows, got 'x'"):
        Integrals.of(DECLARED.model_copy(update={"observation": (hidden,)}), errors_of(DECLARED, ("x",), {}))
