"""A description finds rewards that are quadratic in coordinates and actions, and no other ones."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from support.simulators import Register, Spiral, installed
from surrogym_sampler.original.describing import describe
from surrogym_sampler.original.describing.rewarding import Paid, may_be_quadratic, quadratic_reward
from surrogym_shared.logs.rewards import declared_reward
from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    DeclaredReward,
    EnvironmentSpec,
    ObservationEntry,
    Reward,
    Term,
    Uniform,
    limits,
)

RANGES = {"level": (0.7, 1.0), "heat": (300.0, 350.0), "turn": (-np.pi, np.pi)}
COUNT = 120

Formula = Callable[[np.ndarray, np.ndarray], np.ndarray]


def spec() -> EnvironmentSpec:
    return EnvironmentSpec(
        coordinates=tuple(
            Coordinate(name=n, kind="angle" if n == "turn" else "linear", sampling=Uniform(low=low, high=high))
            for n, (low, high) in RANGES.items()
        ),
        observation=(ObservationEntry(name="level", term=Term.linear(level=1)),),
        action=BoxAction(low=(-1, 0), high=(1, 5)),
        start={n: Uniform(low=low, high=high) for n, (low, high) in RANGES.items()},
        reward=Reward(timing="auto"),
        time_limit=10,
    )


def steps(reward: Formula, timing: str, count: int = COUNT, seed: int = 0) -> Paid:
    rng, (low, high) = np.random.default_rng(seed), np.array(list(RANGES.values())).T
    q, q_next = rng.uniform(low, high, (2, count, 3))
    u = rng.uniform([-1, 0], [1, 5], (count, 2))
    return Paid(q, u, q_next, reward(q_next if timing == "after" else q, u))


FORMULAS: dict[str, Formula] = {
    "a setpoint": lambda q, _: -((q[:, 0] - 0.85) ** 2),
    "a setpoint among large numbers": lambda q, u: -1e-3 * (q[:, 1] - 325) ** 2 - 0.1 * u[:, 1] ** 2,
    "a product": lambda q, u: q[:, 0] * u[:, 0] + 2,
    "a cosine": lambda q, u: np.cos(q[:, 2]) - 0.01 * u[:, 0] ** 2,
    "an angle": lambda q, u: -(q[:, 2] ** 2) - 0.001 * u[:, 0] ** 2,
    "a linear one": lambda q, u: 3 * q[:, 0] - u[:, 1],
}


@pytest.mark.parametrize("timing", ["before", "after"])
@pytest.mark.parametrize("reward", FORMULAS.values(), ids=FORMULAS)
def test_a_quadratic_reward_is_found_from_samples_and_exact_on_new_ones(reward: Formula, timing: str):
    found = quadratic_reward(spec(), steps(reward, timing), steps(reward, timing, seed=1))
    assert found is not None
    assert found.timing == timing
    other = steps(reward, timing, seed=2)
    paid = spec().model_copy(update={"reward": found})
    computed = declared_reward(paid, other.q, other.u, other.q_next, np.zeros(COUNT, dtype=bool))
    np.testing.assert_allclose(computed, other.reward, atol=1e-6 * np.ptp(other.reward))


OTHERS: dict[str, Formula] = {
    "a cube": lambda q, _: q[:, 0] ** 3,
    "a distance": lambda q, _: -np.abs(q[:, 0] - 0.85),
    "a bonus in one place": lambda q, _: (q[:, 0] > 0.95).astype(float),
    "the same everywhere": lambda q, _: np.ones(len(q)),
    "noise": lambda q, _: np.random.default_rng(5).normal(size=len(q)),
}


@pytest.mark.parametrize("reward", OTHERS.values(), ids=OTHERS)
def test_a_non_quadratic_reward_is_not_declared_as_quadratic(reward: Formula):
    assert quadratic_reward(spec(), steps(reward, "after"), steps(reward, "after", seed=1)) is None
    assert not may_be_quadratic(spec(), steps(reward, "after"))


def test_no_quadratic_reward_is_declared_from_too_few_steps():
    reward = FORMULAS["a setpoint"]
    assert quadratic_reward(spec(), steps(reward, "after", 30), steps(reward, "after", seed=1)) is None


def test_a_few_deviating_rewards_do_not_yet_exclude_a_quadratic_form():
    paid = steps(FORMULAS["a setpoint"], "after")
    paid.reward[[3, 40, 77]] -= 0.002
    assert may_be_quadratic(spec(), paid)
    assert quadratic_reward(spec(), paid, paid) is None, "but every step of the decision counts"


def test_the_function_describe_declares_the_quadratic_reward_of_an_environment(registered: Register):
    found = describe(registered("Spiral-v0"), steps=60)
    assert isinstance(found.spec.reward, DeclaredReward)
    assert any("quadratic" in line for line in found.found)
    assert not any(line.startswith("reward:") for line in found.asked)
    assert found.steps > 60, "the steps of the check are counted"


def test_the_function_describe_leaves_a_non_quadratic_reward_to_be_learned(registered: Register):
    def step(self: Spiral, action: np.ndarray):
        shown, _, ended, cut, info = Spiral.step(self, action)
        return shown, float(np.exp(-(shown[0] ** 2))), ended, cut, info

    assert describe(registered("Spiral-v1", {"step": step}), steps=60).spec.reward == Reward(timing="auto")


@installed("pcgym")
def test_the_function_describe_finds_the_setpoint_reward_of_the_stirred_tank():
    found = describe("pcgym:cstr")
    [term] = found.spec.reward.terms
    assert (term.shape, term.weight) == ("square", pytest.approx(-1))
    assert limits(found.spec.coordinates[1].sampling)[1] < 345, "hotter, the reaction runs away"
