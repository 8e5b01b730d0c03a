"""A promise is for episodes in which constants stay. Episodes in which one changed neither keep nor break it."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from surrogym_sampler.original.episodes import open_episode
from surrogym_sampler.original.protocol import RealStep
from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, Fixed, ObservationEntry, Term, Uniform
from surrogym_trainer.evaluation.evaluator import Evaluation, EvaluationSettings, evaluate
from surrogym_trainer.evaluation.reporting import as_reported, is_promised

SETTINGS = EvaluationSettings(episodes=3)
SPEC = EnvironmentSpec(
    environment="a follower",
    coordinates=(
        Coordinate(name="x", sampling=Uniform(low=-1, high=1)),
        Coordinate(name="wanted", kind="constant", sampling=Uniform(low=-1, high=1)),
    ),
    observation=tuple(ObservationEntry(name=name, term=Term.linear(**{name: 1})) for name in ("x", "wanted")),
    action=BoxAction(low=(-1.0,), high=(1.0,)),
    start={"x": Fixed(value=0.0), "wanted": Fixed(value=0.5)},
    time_limit=6,
)


class Follower:
    """x' = x + u / 10; what is wanted moves by ``drift`` in the third step of an episode."""

    def __init__(self, drift: float) -> None:
        self._drift, self._steps, self._at = drift, 0, np.zeros(2)

    def spec(self) -> EnvironmentSpec:
        return SPEC

    def begin(self, seed: int | None = None) -> np.ndarray:
        del seed
        self._steps, self._at = 0, np.array([0.0, 0.5])
        return self._at

    def act(self, action: np.ndarray) -> RealStep:
        self._steps += 1
        before = self._at
        moved = (float(action[0]) / 10, self._drift * (self._steps == 3))
        self._at = before + np.array(moved)
        return RealStep(before, action, self._at, reward=-abs(float(before[0] - before[1])))

    def step_from(self, coordinates: np.ndarray, action: np.ndarray) -> RealStep:
        self._at = np.asarray(coordinates, dtype=np.float64)
        return self.act(action)

    def close(self) -> None:
        pass


def episodes(drift: float) -> Evaluation:
    opener = partial(open_episode, "a follower", SPEC, partial(Follower, drift))
    return evaluate(lambda observations: np.ones((len(observations), 1)), opener, SETTINGS)


@pytest.mark.parametrize(("drift", "names"), [(0.0, ()), (1e-9, ()), (-0.2, ("wanted",))])
def test_a_constant_that_changed_within_an_evaluation_episode_is_named(drift: float, names: tuple[str, ...]) -> None:
    result = episodes(drift)
    assert result.varied == names, "a change by rounding is none"
    assert result.summary()["varied"] == list(names)
    told = as_reported(result, SETTINGS, "a" * 32)
    assert told.declared is not bool(names), "the server judges a promise by declared episodes alone"
    assert ("wanted changed within episodes" in told.note) is bool(names)


RESET_ONLY = SPEC.model_copy(update={"query": "rollout"})


class Rig:
    """x' = x + u / 10 of a machine that ends each episode itself after ``length`` steps, or ignores its seed."""

    def __init__(self, length: int = 100, deaf: bool = False) -> None:
        self._length, self._deaf, self._steps, self._at = length, deaf, 0, np.zeros(2)

    def spec(self) -> EnvironmentSpec:
        return RESET_ONLY

    def begin(self, seed: int | None = None) -> np.ndarray:
        start = np.random.default_rng(None if self._deaf else seed).uniform(-1, 1)
        self._steps, self._at = 0, np.array([start, 0.5])
        return self._at

    def act(self, action: np.ndarray) -> RealStep:
        self._steps += 1
        before, self._at = self._at, self._at + np.array([float(action[0]) / 10, 0.0])
        return RealStep(before, action, self._at, reward=-1.0, truncated=self._steps >= self._length)

    def close(self) -> None:
        pass


def run(**options: Any) -> Evaluation:
    opener = partial(open_episode, "a rig", RESET_ONLY, partial(Rig, **options))
    return evaluate(lambda observations: np.ones((len(observations), 1)), opener, SETTINGS)


@pytest.mark.parametrize(("length", "limit"), [(100, 6), (6, 6), (4, 4)])
def test_episodes_that_the_environment_truncates_early_are_not_compared_with_the_promised_return(
    length: int, limit: int
) -> None:
    result = run(length=length)
    assert result.limit == limit
    assert is_promised(SETTINGS, result, SPEC) is (limit == SPEC.time_limit)
    told = as_reported(result, SETTINGS, "a" * 32, trained_for=SPEC)
    assert told.declared is (limit == SPEC.time_limit)
    assert ("at most 4 steps" in told.note) is (limit == 4)
    longer = SPEC.model_copy(update={"time_limit": 200})
    assert not is_promised(SETTINGS, result, longer), "the policy promised for longer episodes"


@pytest.mark.parametrize("deaf", [True, False])
def test_evaluation_notices_an_environment_that_ignores_its_seed(deaf: bool) -> None:
    result = run(deaf=deaf)
    assert result.seeded is not deaf
    told = as_reported(result, SETTINGS, "a" * 32)
    assert told.seeded is not deaf
    assert ("ignored" in told.note) is deaf
