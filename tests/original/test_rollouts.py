"""Environments that can only be reset and acted on: each step begins where the one before ended, and ends are told."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from support.rail import DiesRight, HangsRight, Rail, RaisesRight
from surrogym_sampler import original
from surrogym_sampler.original.episodes import RolloutEpisode, open_episode
from surrogym_sampler.original.errors import EnvironmentDied, NotSettable, StepFailed, StepTimedOut, UnknownEnvironment
from surrogym_sampler.original.isolated import IsolatedEnvironment
from surrogym_sampler.original.protocol import OriginalEnvironment, RolloutEnvironment
from surrogym_sampler.original.rollouts import FromReset, answering

RIGHT, LEFT = np.array([1.0]), np.array([-1.0])


@pytest.mark.parametrize("name", ["Pendulum-v1", "CartPole-v1", "Acrobot-v1", "InvertedPendulum-v5"])
def test_rollouts_of_a_built_in_environment_equal_gymnasiums(name):
    import gymnasium

    environment = original.make(name, access="reset")
    native = gymnasium.make(name).unwrapped
    assert environment.spec().query == "rollout"
    assert isinstance(environment, RolloutEnvironment)
    at = environment.begin(seed=5)
    native.reset(seed=5)
    action = np.zeros(environment.spec().action.size)
    for _ in range(4):
        step = environment.act(action)
        _, reward, terminated, _, _ = native.step(action.astype(np.float32) if name[0] in "PI" else 0)
        np.testing.assert_array_equal(step.coordinates, at)
        assert (step.reward, step.terminated) == (float(reward), terminated)
        at = np.asarray(step.next_coordinates)
    environment.close()


def test_a_class_with_reset_step_and_coordinates_can_be_rolled_out():
    environment = answering(Rail())
    assert isinstance(environment, FromReset)
    start = environment.begin(seed=3)
    np.testing.assert_array_equal(start, environment.begin(seed=3))
    one, two = environment.act(RIGHT), environment.act(LEFT)
    np.testing.assert_array_equal(one.coordinates, start)
    np.testing.assert_array_equal(two.coordinates, one.next_coordinates)
    assert np.asarray(one.action).shape == (1,)


def test_a_rollout_step_before_a_reset_or_after_termination_is_refused():
    environment = answering(Rail())
    with pytest.raises(StepFailed, match="running episode"):
        environment.act(RIGHT)
    environment.begin()
    while not (step := environment.act(RIGHT)).terminated:
        pass
    assert np.asarray(step.next_coordinates)[0] >= 1
    with pytest.raises(StepFailed, match="running episode"):
        environment.act(RIGHT)


def test_an_old_style_reset_or_wrongly_sized_coordinates_are_refused():
    class Old(Rail):
        def reset(self, *, seed=None):
            return super().reset(seed=seed)[0]

    class Wide(Rail):
        def coordinates(self, observation):
            return observation

    with pytest.raises(StepFailed, match=r"reset to return \(observation, info\), got a ndarray"):
        answering(Old()).begin()
    with pytest.raises(StepFailed, match=r"to return \(x\), got an array of shape \(2,\)"):
        answering(Wide()).begin()


def test_a_class_without_the_methods_its_specification_needs_is_refused():
    class Says(Rail):
        def spec(self):
            return super().spec().model_copy(update={"query": "step"})

    with pytest.raises(UnknownEnvironment, match="query='step', which needs step_from"):
        answering(Says())
    with pytest.raises(UnknownEnvironment, match="reset, step, coordinates and close, got a int"):
        answering(3)


@pytest.mark.parametrize(
    ("factory", "error"), [(RaisesRight, StepFailed), (HangsRight, StepTimedOut), (DiesRight, EnvironmentDied)]
)
def test_an_isolated_rollout_that_fails_must_be_reset_before_the_next_step(factory, error):
    with IsolatedEnvironment(factory, step_limit=1.0) as environment:
        environment.begin(seed=0)
        environment.act(LEFT)
        with pytest.raises(error):
            environment.act(RIGHT)
        with pytest.raises(StepFailed, match="running episode"):
            environment.act(LEFT)
        environment.begin(seed=0)
        environment.act(LEFT)


def test_the_error_for_an_unknown_environment_module_names_it_without_traceback():
    environment = IsolatedEnvironment(partial(original.make, "nomod:F"))
    with pytest.raises(UnknownEnvironment) as told:
        environment.spec()
    assert str(told.value) == "expected package.module:factory, got 'nomod:F': No module named 'nomod'"


def test_evaluating_a_reset_only_class_uses_resets_and_refuses_set_states():
    episode = open_episode("rail:Rail", None, Rail)
    assert isinstance(episode, RolloutEpisode)
    start = episode.reset(10_000)
    moment = episode.step(RIGHT)
    assert moment.coordinates[0] > start.coordinates[0]
    with pytest.raises(NotSettable, match="only be reset"):
        episode.place(np.zeros(1))
    episode.close()


def test_a_class_that_supports_set_states_and_rollouts_can_be_used_for_both():
    class Both(Rail):
        def spec(self):
            return super().spec().model_copy(update={"query": "step", "max_rollout": None})

        def step_from(self, coordinates, action):
            raise NotImplementedError

    assert isinstance(answering(Both()), OriginalEnvironment)
    assert isinstance(answering(Both()), Both)
    assert isinstance(answering(Rail()), FromReset)


@pytest.mark.parametrize(
    ("methods", "lacking"),
    [
        (("spec", "step_from"), "close"),
        (("spec", "reset", "step", "close"), "coordinates"),
        (("step_from",), "spec and close"),
    ],
)
def test_an_environment_class_that_lacks_methods_is_refused_with_their_names(
    methods: tuple[str, ...], lacking: str
) -> None:
    made = type("Plant", (), {name: lambda *_: None for name in methods})()
    if "spec" in methods:
        made.spec = Rail().spec
    with pytest.raises(UnknownEnvironment, match=rf"got a Plant without {lacking}$"):
        answering(made)
