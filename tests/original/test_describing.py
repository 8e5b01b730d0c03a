"""What ``describe`` finds of an environment is true of it, its steps are counted, and the rest is asked for."""

from __future__ import annotations

import json
from functools import partial
from types import SimpleNamespace
from typing import NamedTuple

import gymnasium
import numpy as np
import pytest

import surrogym
from support.simulators import CASES, Register, Spiral, installed
from surrogym_sampler import original
from surrogym_sampler.original.describing import Description, describe
from surrogym_sampler.original.simulator import Simulated
from surrogym_sampler.original.state_parts import Attribute, holds_numbers
from surrogym_shared import terms
from surrogym_shared.spec import EnvironmentSpec, limits

STEPS = 80


def kinds(description: Description) -> dict[str, str]:
    return {c.name: c.kind for c in description.spec.coordinates}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", CASES)
def test_a_described_environment_steps_from_its_coordinates_as_in_an_episode(name: str) -> None:
    description = describe(name, STEPS)
    environment = original.make(name, spec=description.spec)
    assert isinstance(environment, Simulated)
    spec, rng = environment.spec(), np.random.default_rng(0)
    environment.begin(1)
    for _ in range(3):
        step = environment.act(rng.uniform(spec.action.low, spec.action.high))
    again = environment.step_from(np.asarray(step.coordinates), np.asarray(step.action))
    np.testing.assert_allclose(again.next_coordinates, step.next_coordinates, atol=1e-6)
    assert again.reward == pytest.approx(step.reward, abs=1e-6)
    environment.close()


def test_setting_a_state_keeps_its_current_python_type() -> None:
    """MountainCar's state is an array after a reset and a tuple after a step."""
    owner = SimpleNamespace(state=np.zeros(2))
    part = Attribute(owner, "state")
    owner.state = (1.0, 2.0)
    part.write(np.array([3.0, 4.0]))
    assert owner.state == (3.0, 4.0)


@installed("mujoco")
def test_a_design_can_sample_a_described_environment() -> None:
    machine = original.make("Swimmer-v5", spec=describe("Swimmer-v5", STEPS).spec, budget=4, initial=4)
    design = surrogym.Design(machine.spec())
    while (query := design.ask()) is not None:
        design.tell(query, machine.step_from(np.array(query.coordinates), np.array(query.action)))
    assert (design.steps, design.phase) == (4, "over_budget")
    machine.close()


@installed("mujoco")
def test_the_function_describe_drops_the_swimmers_position_and_finds_its_angle() -> None:
    found = describe("Swimmer-v5", STEPS)
    assert "slider1" not in kinds(found)
    assert kinds(found)["free_body_rot"] == "angle"
    assert {"cos_free_body_rot", "sin_free_body_rot"} <= set(found.spec.observation_names)
    assert found.spec.time_limit == 1000


@installed("mujoco")
def test_the_function_describe_keeps_the_cheetahs_height_and_drops_its_position() -> None:
    found = kinds(describe("HalfCheetah-v5", STEPS))
    assert "rootx" not in found
    assert found["rootz"] == "linear"


@installed("mujoco")
def test_the_described_observation_equals_that_of_the_environment() -> None:
    name = "Reacher-v5"
    found = describe(name, STEPS)
    environment = original.make(name, spec=found.spec)
    names = list(found.spec.observation_names)
    for seed in range(5):
        shown = terms.observe(found.spec, environment.begin(seed)[None])[0]
        own = environment.simulator.observe()  # cos, cos, sin, sin, target, speeds, to the target
        ours = [shown[names.index(n)] for n in ("cos_joint0", "cos_joint1", "sin_joint0", "sin_joint1")]
        np.testing.assert_allclose(ours, own[:4], atol=1e-9)
        np.testing.assert_allclose(shown[[names.index("o8"), names.index("o9")]], own[8:10], atol=1e-9)


@installed("mujoco")
def test_observation_entries_that_cannot_be_expressed_are_replaced_by_coordinates() -> None:
    found = describe("Pusher-v5", STEPS)
    assert any("of 1, q, sin(q) and cos(q)" in line for line in found.found)
    shown = {name for entry in found.spec.observation for part in entry.term.parts for name in part.weights}
    assert shown == set(found.spec.coordinate_names)
    assert any("obj_slidey, obj_slidex: no random action moved it" in line for line in found.asked)


@installed("mujoco")
def test_describing_an_environment_that_terminates_declares_a_learned_termination() -> None:
    found = describe("Hopper-v5", STEPS)
    assert found.spec.termination == "learned"
    assert any(line.startswith("termination:") for line in found.asked)


def test_the_function_describe_finds_angles_and_observes_them_by_cosine_and_sine() -> None:
    """Both tasks show single precision, whose rounding errors are no part of a term."""
    found = describe("Acrobot-v1", STEPS)
    assert kinds(found) == {"state0": "angle", "state1": "angle", "state2": "linear", "state3": "linear"}
    shown = ("cos_state0", "sin_state0", "cos_state1", "sin_state1", "state2", "state3")
    assert found.spec.observation_names == shown
    assert kinds(describe("Pendulum-v1", STEPS)) == {"state0": "angle", "state1": "linear"}


class Wheel(gymnasium.Env):
    """A wheel that turns freely, on a wagon at a place on which nothing depends."""

    action_space = gymnasium.spaces.Box(-1, 1, (1,))
    observation_space = gymnasium.spaces.Box(-10, 10, (4,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.np_random.uniform(-1, 1, 3)
        return self._get_obs(), {}

    def step(self, action):
        place, angle, speed = self.state
        self.state = np.array([place + 0.1, angle + 0.1 * speed, speed + 0.1 * action[0]])
        return self._get_obs(), -float(speed**2), False, False, {}

    def _get_obs(self):
        place, angle, speed = self.state
        return np.array([place, np.cos(angle), np.sin(angle), speed])


def test_the_function_describe_does_not_take_an_irrelevant_position_for_an_angle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(gymnasium.registry, "Wheel-v0", gymnasium.envs.registration.EnvSpec("Wheel-v0", Wheel))
    assert kinds(describe("Wheel-v0", STEPS)) == {"state0": "linear", "state1": "angle", "state2": "linear"}
    assert set(kinds(describe("CartPole-v1", STEPS)).values()) == {"linear"}


@pytest.fixture
def listed(monkeypatch: pytest.MonkeyPatch):
    """Registers a class as Own-v0."""

    def register(kind: type[gymnasium.Env]) -> str:
        monkeypatch.setitem(gymnasium.registry, "Own-v0", gymnasium.envs.registration.EnvSpec("Own-v0", kind))
        return "Own-v0"

    return register


class Remembering(Wheel):
    """The last force is part of the state, and nothing depends on it."""

    def step(self, action):
        place, speed, _ = self.state
        self.state = np.array([0.9 * place + 0.1 * speed, 0.9 * speed + action[0], 10.0 * action[0]])
        return self._get_obs(), -float(place**2), False, False, {}

    def _get_obs(self):
        return np.array([*self.state, 0.0])


def test_the_function_describe_does_not_take_a_memoryless_variable_for_an_angle(listed) -> None:
    """Without whole turns, its next value is the same after any shift."""
    assert set(kinds(describe(listed(Remembering), STEPS)).values()) == {"linear"}


class Hanging(Wheel):
    """It begins near half a turn, where its angle is read with a jump."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.array([0.0, np.pi + self.np_random.uniform(-0.1, 0.1), 0.0])
        self.state[1] = (self.state[1] + np.pi) % (2 * np.pi) - np.pi
        return self._get_obs(), {}


def test_start_angles_on_both_sides_of_pi_are_described_as_one_arc(listed) -> None:
    """They were the whole circle."""
    low, high = limits(describe(listed(Hanging), STEPS).spec.start["state1"])
    assert np.pi - 0.12 < low < np.pi - 0.05
    assert np.pi + 0.05 < high < np.pi + 0.12


def test_a_described_sampling_range_ends_at_the_clipping_limits() -> None:
    """Pendulum's speed is clipped at 8 rad/s; a quarter of the range was added on each side."""
    spec = describe("Pendulum-v1").spec
    assert limits(spec.coordinates[1].sampling) == (-8, 8)


def test_a_described_reward_has_no_rounding_terms_and_no_cancelling_terms() -> None:
    """Squares of cosine and sine came with a constant that cancels them."""
    terms = describe("Pendulum-v1").spec.reward.terms
    assert sorted(round(term.weight, 6) for term in terms) == [-1, -0.1, -0.001]
    assert {term.shape for term in terms} == {"square"}


class Pair(NamedTuple):
    x: float
    number: int


@pytest.mark.parametrize(
    ("state", "written"),
    [((0.5, 2), (1.5, 3)), ([0.5, 2], [1.5, 3]), (Pair(0.5, 2), Pair(1.5, 3)), (np.array([0.5, 2]), None)],
)
def test_setting_a_state_keeps_its_container_type_and_integers(state, written) -> None:
    """A named tuple ended in an error, and a whole number that the environment used as an index became a fraction."""
    owner = SimpleNamespace(state=state)
    assert holds_numbers(owner, "state")
    Attribute(owner, "state").write(np.array([1.5, 3.0]))
    assert type(owner.state) is type(state)
    if written is not None:
        assert owner.state == written
        assert type(owner.state[1]) is int


def test_a_read_only_or_nested_state_attribute_is_not_used_as_state() -> None:
    class Fixed:
        @property
        def state(self) -> np.ndarray:
            return np.zeros(2)

    assert not holds_numbers(Fixed(), "state")
    assert not holds_numbers(SimpleNamespace(state=[[0.0, 1.0], [2.0, 3.0]]), "state")


@installed("pcgym")
def test_the_function_describe_declares_a_setpoint_as_constant_over_its_whole_range() -> None:
    spec = describe("pcgym:cstr", STEPS).spec
    setpoint = spec.coordinates[2]
    assert (setpoint.name, setpoint.kind, limits(setpoint.sampling)) == ("Ca_setpoint", "constant", (0.8, 0.9))


@installed("pcgym")
def test_described_start_setpoints_are_those_of_the_schedule() -> None:
    found = describe("pcgym:cstr", STEPS)
    assert limits(found.spec.start["Ca_setpoint"]) == (0.85, 0.9), "others can't all be reached, and would cost much"
    assert any(line.startswith("start of Ca_setpoint: a schedule sets it") for line in found.asked)


def test_the_function_describe_counts_every_real_step(registered: Register) -> None:
    name = registered("Spiral-v0")
    taken: list[int] = []
    made = gymnasium.registry[name].entry_point()
    step = made.step
    made.step = lambda action: (taken.append(1), step(action))[1]
    gymnasium.registry[name].entry_point = lambda: made
    assert describe(name, 50).steps == len(taken) > 50


def test_the_function_describe_declares_an_environment_with_hidden_memory_reset_only(registered: Register) -> None:
    found = describe(registered("Worn-v0", wear=0.01), 60)
    assert found.spec.query == "rollout"
    assert any("has memory that can't be set" in line for line in found.found)


def test_the_function_describe_uses_the_observation_if_the_state_is_unreadable(registered: Register) -> None:
    found = describe(registered("Hidden-v0", attribute="_hidden"), 60)
    assert (found.spec.query, found.spec.coordinate_names) == ("rollout", ("o0", "o1"))


def test_the_function_describe_warns_about_a_reward_that_random_steps_rarely_change(registered: Register) -> None:
    def step(self, action):
        shown, _, *rest = Spiral.step(self, action)
        return shown, float(np.abs(shown).sum() < 0.1), *rest

    found = describe(registered("Sparse-v0", space={"step": step}), 60)
    assert any("random steps paid exactly 0. A design with few real steps may see" in line for line in found.asked)
    assert not any("paid exactly" in line for line in describe(registered("Spiral-v0"), 60).asked)


def test_the_description_file_contains_findings_and_specification(registered: Register) -> None:
    found = describe(registered("Spiral-v0"), 60)
    read = json.loads(found.text())
    assert read["real_steps"] == found.steps
    assert read["asked"] == list(found.asked)
    assert EnvironmentSpec.model_validate_json(json.dumps(read["specification"])) == found.spec


def test_the_function_describe_replaces_a_too_long_observation_by_the_coordinates(registered: Register) -> None:
    """It was refused after all real steps: a specification has at most 64 entries."""
    weights = np.random.default_rng(0).normal(size=(200, 2))
    space = {"_get_obs": lambda self: weights @ self.state}
    found = describe(registered("Spiral-v0", space=space), 60)
    assert found.spec.observation_names == ("state0", "state1")
    assert "the observation has 200 entries, more than 64: the policy observes the coordinates instead" in found.found


class Counting(gymnasium.Env):
    """A mass on a spring whose episodes a counter of its own ends: after ``length`` steps, or at random."""

    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    observation_space = gymnasium.spaces.Box(-10, 10, (2,), np.float64)

    def __init__(self, length: int | None, terminates: bool) -> None:
        self._length, self._terminates = length, terminates

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._s, self._left = self.np_random.uniform(-1, 1, 2), self._length or int(self.np_random.integers(5, 30))
        return self._s.copy(), {}

    def step(self, action):
        x, v = self._s
        self._s = np.array([x + 0.1 * v, v + 0.1 * (float(action[0]) - x - 0.2 * v)])
        self._left -= 1
        over = self._left == 0
        return self._s.copy(), float(x), over and self._terminates, over and not self._terminates, {}


@pytest.mark.parametrize("terminates", [True, False])
def test_the_function_describe_takes_a_common_episode_length_as_time_limit(listed, terminates: bool) -> None:
    found = describe(listed(partial(Counting, 20, terminates)), STEPS)
    assert found.spec.time_limit == 20
    assert found.spec.termination == ()
    assert any("exactly 20 steps" in line for line in found.asked)


def test_the_function_describe_finds_no_time_limit_in_episodes_of_different_lengths(listed) -> None:
    found = describe(listed(partial(Counting, None, True)), STEPS)
    assert found.spec.time_limit == 200
    assert found.spec.termination == "learned"
