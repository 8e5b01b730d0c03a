"""A description finds rewards of two values that change at a level or an ellipsoid of what is observed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from support.simulators import Register, Spiral, installed
from surrogym_sampler.original.describing import describe
from surrogym_sampler.original.describing.rewarding import (
    BATCH,
    ENOUGH,
    HALVINGS,
    POINTS,
    SEEK,
    Paid,
    regions,
    threshold_reward,
)
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
)

RANGES = {"x": (-2.0, 1.0), "y": (-1.0, 2.0), "turn": (-np.pi, np.pi)}
LOW, HIGH = np.array(list(RANGES.values())).T

Formula = Callable[[np.ndarray], np.ndarray]


def spec() -> EnvironmentSpec:
    starts = {name: Uniform(low=low, high=high) for name, (low, high) in RANGES.items()}
    shown = {"x": Term.linear(x=1), "y": Term.linear(y=1), "height": Term.cos(turn=1)}
    return EnvironmentSpec(
        coordinates=tuple(
            Coordinate(name=name, kind="angle" if name == "turn" else "linear", sampling=sampling)
            for name, sampling in starts.items()
        ),
        observation=tuple(ObservationEntry(name=name, term=term) for name, term in shown.items()),
        action=BoxAction(low=(-1,), high=(1,)),
        start=starts,
        reward=Reward(timing="auto"),
        time_limit=10,
    )


class Machine:
    """Steps of a tenth of the action, in the second coordinate backwards, with a reward before or after them."""

    def __init__(self, reward: Formula, timing: str, seed: int = 0) -> None:
        self._reward, self._timing, self._rng = reward, timing, np.random.default_rng(seed)
        self.steps = 0

    def step(self, q: np.ndarray, u: np.ndarray) -> Paid:
        self.steps += len(q)
        q_next = q + u * np.array([0.1, -0.1, 0.1])
        return Paid(q, u, q_next, self._reward(q_next if self._timing == "after" else q).astype(float))

    def draw(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        return self._rng.uniform(LOW, HIGH, (count, 3)), self._rng.uniform(-1, 1, (count, 1))

    def found(self) -> DeclaredReward | None:
        seen = self.step(*self.draw(100))
        return threshold_reward(spec(), seen, self.step, self.draw)


FORMULAS: dict[str, Formula] = {
    "a height": lambda q: np.cos(q[:, 2]) > 0.9,
    "a fine below a level": lambda q: -1 + 0.5 * (q[:, 0] > -1.3),
    "a band": lambda q: np.abs(q[:, 1] - 0.4) < 0.3,
    "a disc": lambda q: np.hypot(q[:, 0], q[:, 1]) < 0.6,
    "outside of a ball": lambda q: 3.0 * (q[:, 0] ** 2 + (q[:, 1] - 0.5) ** 2 + np.cos(q[:, 2]) ** 2 > 0.5),
    "a distance between entries": lambda q: np.abs(q[:, 0] - q[:, 1]) < 0.2,
    "a box": lambda q: (np.abs(q[:, 0] + 0.5) < 0.6) & (np.abs(q[:, 1] - 0.5) < 0.5),
    "a box that moves": lambda q: (np.abs(q[:, 0] - q[:, 1]) < 0.7) & (np.cos(q[:, 2]) > 0.1),
    "outside of a corner": lambda q: -2.0 * ~((q[:, 0] > -0.5) & (q[:, 1] > 0.3)),
}


@pytest.mark.parametrize("timing", ["before", "after"])
@pytest.mark.parametrize("reward", FORMULAS.values(), ids=FORMULAS)
def test_a_two_valued_reward_is_found_from_samples_and_exact_on_new_ones(reward: Formula, timing: str):
    found = Machine(reward, timing).found()
    assert found is not None
    assert found.timing == timing
    other = Machine(reward, timing, seed=1)
    steps = other.step(*other.draw(5_000))
    declared = spec().model_copy(update={"reward": found})
    computed = declared_reward(declared, steps.q, steps.u, steps.q_next, np.zeros(len(steps), dtype=bool))
    np.testing.assert_allclose(computed, steps.reward, atol=1e-9)


OTHERS: dict[str, Formula] = {
    "a diamond": lambda q: np.abs(q[:, 0]) + np.abs(q[:, 1]) < 0.6,
    "two discs": lambda q: (np.hypot(q[:, 0], q[:, 1]) < 0.5) | (np.hypot(q[:, 0] + 1.5, q[:, 1] - 1.5) < 0.4),
    "the same everywhere": lambda q: np.ones(len(q)),
    "three values": lambda q: np.round(np.cos(q[:, 2])),
    "noise": lambda q: np.random.default_rng(5).random(len(q)) < 0.5,
}


@pytest.mark.parametrize("reward", OTHERS.values(), ids=OTHERS)
def test_a_reward_without_a_threshold_is_not_declared_as_two_valued(reward: Formula):
    machine = Machine(reward, "after")
    assert machine.found() is None
    assert machine.steps <= 100 + SEEK + 6 * POINTS * (HALVINGS + 1)


def test_a_box_shaped_reward_is_found_although_states_jump_at_contacts():
    """At a contact the next state jumps, so some points of the boundary lie on no face."""
    machine = Machine(FORMULAS["a box"], "after")

    def step(q: np.ndarray, u: np.ndarray) -> Paid:
        steps = machine.step(q, u)
        jump = np.where(q[:, 2] > 2.5, 1.0, 0.0)[:, None] * np.array([1.3, 0.0, 0.0])
        after = steps.q_next + jump
        return Paid(q, u, after, FORMULAS["a box"](after).astype(float))

    found = threshold_reward(spec(), step(*machine.draw(100)), step, machine.draw)
    assert found is not None
    assert sorted(round(one.value, 4) for one in found.terms[0].when) == [-1.1, 0.0, 0.1, 1.0]


def test_a_ball_shaped_reward_is_found_from_one_pass_through_it():
    """All paid steps of an episode may lie near one place of the boundary, which alone does not tell its form."""
    machine = Machine(FORMULAS["a disc"], "after")
    towards = np.column_stack([np.linspace(1, 0.5, 100), np.zeros(100), np.zeros(100)])
    seen = machine.step(towards, 0.1 * machine.draw(100)[1])
    assert seen.reward.sum() >= ENOUGH, "no further step is needed to meet both values"
    found = threshold_reward(spec(), seen, machine.step, machine.draw)
    assert found is not None
    assert found.terms[0].shape == "ball"
    assert machine.steps <= 100 + BATCH + POINTS * HALVINGS


def test_an_identity_that_always_holds_is_not_taken_for_a_reward_boundary():
    """The squares of a cosine and a sine add up to 1 in every state: rounding would decide who is inside."""
    turning, shown = spec(), (Term.cos(turn=1), Term.sin(turn=1))
    q, _ = Machine(FORMULAS["a disc"], "after").draw(100)
    assert not list(regions(turning, shown, q[:POINTS], q))
    edge = q[:POINTS].copy()
    edge[:, 0] = np.sin(edge[:, 2])
    assert [term.shape for term in regions(turning, (Term.cos(turn=1), Term.linear(x=1)), edge, q)] == ["ball"], (
        "x equals a sine on this boundary alone"
    )


def test_two_boundary_points_do_not_determine_an_ellipsoidal_reward():
    """Two places of an angle, met again and again: many ellipsoids go through them, and pay differently elsewhere."""
    q, _ = Machine(FORMULAS["a height"], "after").draw(100)
    edge = q[:POINTS].copy()
    edge[:, 2] = np.where(np.arange(POINTS) % 2, 0.14, -0.14)
    cos, sin = Term.cos(turn=1), Term.sin(turn=1)
    for group in [(sin, cos + (-1.0) * sin), (Term.linear(turn=1), sin)]:
        assert not list(regions(spec(), group, edge, q))
    assert [term.shape for term in regions(spec(), (cos,), edge, q)] == ["one"]


def test_the_function_describe_declares_a_bonus_reward_near_a_goal(registered: Register):
    def step(self: Spiral, action: np.ndarray):
        shown, _, ended, cut, info = Spiral.step(self, action)
        return shown, float(np.hypot(*self.state) < 0.3), ended, cut, info

    found = describe(registered("Spiral-v2", {"step": step}), steps=60)
    assert isinstance(found.spec.reward, DeclaredReward)
    assert found.spec.reward.terms[0].shape == "ball"
    assert any("ellipsoid" in line for line in found.found)
    assert found.steps > 60, "the further steps are counted"


@installed("dm_control")
@pytest.mark.parametrize(
    ("task", "seed", "shape"),
    [
        ("reacher-easy", 0, "ball"),
        ("reacher-easy", 51, "ball"),
        ("pendulum-swingup", 0, "one"),
        ("ball_in_cup-catch", 1, "one"),
    ],
)
def test_the_function_describe_finds_the_two_valued_rewards_of_dm_control_tasks(task: str, seed: int, shape: str):
    found = describe(f"dm_control:{task}", seed=seed)
    assert isinstance(found.spec.reward, DeclaredReward)
    [term] = found.spec.reward.terms
    assert (term.shape, term.weight, found.spec.reward.timing) == (shape, pytest.approx(1), "after")
