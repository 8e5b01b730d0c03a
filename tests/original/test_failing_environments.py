"""An environment that fails, or returns something else than Gymnasium expects, is described by one sentence."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete, Space

from support.simulators import Register, Spiral
from surrogym_sampler.original.adapters import open_simulator
from surrogym_sampler.original.describing import describe
from surrogym_sampler.original.errors import StepFailed, UnknownEnvironment, sentence

STEPS = 60


def raises_late(self, action):
    self.taken = getattr(self, "taken", 0) + 1
    if self.taken > 50:
        raise ZeroDivisionError("valve stuck")
    return Spiral.step(self, action)


def exits_late(self, action):
    try:
        return raises_late(self, action)
    except ZeroDivisionError:
        sys.exit("the licence has expired")


def grows(self, action):
    shown, *rest = Spiral.step(self, action)
    self.state = np.zeros(3)
    return shown, *rest


def paying(reward):
    def step(self, action):
        shown, _, *rest = Spiral.step(self, action)
        return shown, reward, *rest

    return step


@pytest.mark.parametrize(
    ("step", "message"),
    [
        (raises_late, r"Fails-v0 failed after 50 real steps: ZeroDivisionError: valve stuck \(test_failing"),
        (
            exits_late,
            r"Fails-v0 failed after 50 real steps: SystemExit: the licence has expired \(test_failing",
        ),
        (
            lambda self, action: Spiral.step(self, action)[:4],
            r"Fails-v0 failed after 0 real steps: expected the environment's step to return 5 values \(.* got 4 values",
        ),
        (
            paying("ten"),
            "Fails-v0 failed after 0 real steps: expected the environment's reward to be a number, got 'ten'",
        ),
        (paying(None), "expected the environment's reward to be a number, got None"),
        (paying(np.ones(2)), "expected the environment's reward to be a number, got array"),
        (grows, "expected the state to have 2 numbers, as after the first reset, got 3"),
    ],
)
def test_a_step_failing_during_describe_reports_the_real_steps_before_it(
    registered: Register, step: object, message: str
) -> None:
    name = registered("Fails-v0", space={"step": step})
    with pytest.raises(StepFailed, match=message):
        describe(name, STEPS)


def fails_at_once(self, *, seed=None, options=None):
    raise OSError("no device")


@pytest.mark.parametrize(
    ("space", "message"),
    [
        ({"reset": fails_at_once}, "Fails-v0 can't be opened: OSError: no device"),
        ({"reset": lambda self: Spiral.reset(self)}, "Fails-v0 can't be opened: TypeError: .*'seed'"),
        ({"__init__": lambda _: 1 / 0}, "Fails-v0 can't be opened: ZeroDivisionError"),
        ({"__init__": lambda _: sys.exit(3)}, r"Fails-v0 can't be opened: SystemExit: 3 \(test_failing"),
        ({"reset": lambda _, **__: sys.exit()}, r"Fails-v0 can't be opened: SystemExit \(test_failing"),
    ],
)
def test_describing_an_environment_that_cannot_be_opened_gives_the_reason(
    registered: Register, space: dict[str, object], message: str
) -> None:
    with pytest.raises(UnknownEnvironment, match=message):
        open_simulator(registered("Fails-v0", space=space))


def shown_once(self):
    """An observation that can be read in the episodes, and not where the state was set without a step."""
    if not self.stepped:
        raise OSError("no picture")
    return np.zeros(2)


def test_a_failure_between_steps_of_describe_reports_the_real_steps(registered: Register) -> None:
    """The observation of a state that was set was read outside of all counts: it ended in a traceback."""
    name = registered("Fails-v0", space={"_get_obs": shown_once, "stepped": False})
    with pytest.raises(StepFailed, match=r"Fails-v0 failed after \d+ real steps: OSError: no picture") as failed:
        describe(name, STEPS)
    assert int(str(failed.value).split()[5]) > STEPS


def test_the_function_describe_returns_its_result_although_the_environment_fails_to_close(registered: Register) -> None:
    """Its real steps were taken, and nobody could use them."""
    found = describe(registered("Fails-v0", space={"close": lambda _: sys.exit(4)}), STEPS)
    assert found.found[-1].startswith("Fails-v0 could not be closed: SystemExit: 4 (test_failing")
    assert found.steps >= STEPS


def test_the_function_describe_refuses_nan_start_states_before_any_real_step(registered: Register) -> None:
    """Nor do they raise a warning of NumPy, which is an error here."""
    resets = iter(range(1_000))

    def reset(self, *, seed=None, options=None):
        Spiral.reset(self, seed=seed)
        if next(resets) > 5:  # the first ones open it
            self.state = np.full(2, np.inf)
        return self.state, {}

    with pytest.raises(UnknownEnvironment, match="reached states with infinite values or NaN") as refused:
        describe(registered("Fails-v0", space={"reset": reset}), STEPS)
    assert "real steps" not in str(refused.value)


def test_a_refusal_by_describe_reports_its_real_steps(registered: Register) -> None:
    with pytest.raises(UnknownEnvironment, match=f"infinite rewards or NaN .*; this took {STEPS} real steps"):
        describe(registered("Fails-v0", space={"step": paying(float("inf"))}), STEPS)


def test_an_old_style_gym_reset_is_refused(registered: Register) -> None:
    def reset(self, *, seed=None, options=None):
        return Spiral.reset(self, seed=seed)[0]  # two numbers, not two values

    message = r"Old-v0 can't be opened: .* reset to return 2 values \(observation, info\), got a ndarray"
    with pytest.raises(UnknownEnvironment, match=message):
        open_simulator(registered("Old-v0", space={"reset": reset}))


def test_a_reward_array_of_one_entry_is_accepted(registered: Register) -> None:
    simulator = open_simulator(registered("Row-v0", space={"step": paying(np.array([2.0]))}))
    assert simulator.step(np.zeros(1)).reward == 2.0


@pytest.mark.parametrize("reward", [float("inf"), float("nan")])
def test_the_function_describe_refuses_rewards_that_are_not_finite_numbers(registered: Register, reward: float) -> None:
    with pytest.raises(UnknownEnvironment, match="Fails-v0 gave infinite rewards or NaN"):
        describe(registered("Fails-v0", space={"step": paying(reward)}), STEPS)


def test_the_function_describe_leaves_out_a_variable_that_moves_only_by_rounding(registered: Register) -> None:
    def reset(self, *, seed=None, options=None):
        Spiral.reset(self, seed=seed)
        self.state[1] = 300.0
        return self.state, {}

    def step(self, action):
        x = self.state[0]
        self.state = np.array([0.9 * x + 0.1 * action[0], 300.0 + self.np_random.normal() * 1e-13])
        return self.state, -float(x * x), False, False, {}

    found = describe(registered("Rounds-v0", space={"reset": reset, "step": step}), STEPS)
    assert found.spec.coordinate_names == ("state0",)
    assert found.spec.query == "step", "an error of a rounding does not tell of hidden memory"


@pytest.mark.parametrize("name", ["own_cart:Cart", "my.plants:make", "exec:./plant"])
def test_describing_a_factory_with_its_own_specification_is_refused_with_the_reason(name: str) -> None:
    with pytest.raises(UnknownEnvironment, match="gives its own specification: there is nothing to describe"):
        describe(name, STEPS)


@pytest.mark.parametrize("name", ["nowhere", "", ":", "own_cart:", "../x:y"])
def test_the_error_for_a_name_that_cannot_be_described_lists_the_valid_forms(name: str) -> None:
    with pytest.raises(UnknownEnvironment, match=r"no adapter knows .* expected a Gymnasium id such as") as refused:
        describe(name, STEPS)
    assert "factory" not in str(refused.value), "a factory is no environment to describe"


@pytest.mark.parametrize("space", [Box(1, 1, (1,)), Box(-1e30, 1e30, (1,), np.float64), Discrete(1)])
def test_the_function_describe_refuses_unsupported_action_spaces_in_one_line(
    registered: Register, space: Space
) -> None:
    with pytest.raises(UnknownEnvironment, match=r"\AFails-v0 does not fit into a specification: .+\Z") as refused:
        open_simulator(registered("Fails-v0", space={"action_space": space}))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("size", [0, 65, 500])
def test_the_function_describe_refuses_an_action_with_none_or_too_many_entries_with_a_remedy(
    registered: Register, size: int
) -> None:
    """The words were Python's: Tuple should have at least 1 item after validation, not 0."""
    message = f"Fails-v0 has an action of {size} entries: expected 1 to 64; write a wrapper class"
    with pytest.raises(UnknownEnvironment, match=message):
        open_simulator(registered("Fails-v0", space={"action_space": Box(-1, 1, (size,))}))


def sized(size):
    """Methods of an environment whose state has this many numbers."""

    def reset(self, *, seed=None, options=None):
        Spiral.reset(self, seed=seed)
        self.state = self.np_random.uniform(-1, 1, size)
        return self.state, {}

    def step(self, action):
        self.taken = getattr(self, "taken", 0) + 1
        self.state = 0.9 * self.state
        return self.state, 0.0, False, False, {}

    return {"reset": reset, "step": step, "observation_space": Box(-1, 1, (size,))}


@pytest.mark.parametrize(
    ("size", "message"),
    [
        (
            0,
            "Fails-v0 has no state that can be read, and its observation is empty: expected a state of 1 to 64 "
            "numbers; declare them in a",
        ),
        (65, "Fails-v0 has 65 variables that move: expected at most 64; choose those .* in a class of your own"),
        (5_000, "Fails-v0 has 5000 variables that move: expected at most 64"),
    ],
)
def test_the_function_describe_refuses_an_empty_or_too_large_state_before_any_real_step(
    registered: Register, size: int, message: str
) -> None:
    """An empty one was refused in words of Python, and a large one after 400 real steps."""
    with pytest.raises(UnknownEnvironment, match=message) as refused:
        describe(registered("Fails-v0", space=sized(size)), STEPS)
    assert "real steps" not in str(refused.value)


def test_describing_an_environment_in_which_nothing_moves_is_refused_with_a_remedy(registered: Register) -> None:
    def reset(self, *, seed=None, options=None):
        Spiral.reset(self, seed=seed)
        self.state = np.ones(2)
        return self.state, {}

    space = {"reset": reset, "step": lambda self, _: (self.state, 0.0, False, False, {})}
    message = rf"no variable of Fails-v0 differed between resets or moved in {STEPS} random steps: .* \(--steps\), or"
    with pytest.raises(UnknownEnvironment, match=message):
        describe(registered("Fails-v0", space=space), STEPS)


class Mute(Exception):
    """An error whose message can't be read."""

    def __str__(self) -> str:
        raise RuntimeError("no words")


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ValueError("valve \ud800 stuck"), r"ValueError: valve \ud800 stuck"),
        (ValueError("valve\0 stuck"), r"ValueError: valve\x00 stuck"),
        (Mute(), "its message can't be read"),
    ],
)
def test_any_environment_error_becomes_text_that_can_be_sent(error: Exception, said: str):
    for described in (sentence(error), sentence(StepFailed(str(error))) if error.args else said):
        assert said.partition(": ")[2] in described
        described.encode()


def test_a_very_long_environment_error_is_cut():
    """Three megabytes were printed for each query."""
    said = sentence(ValueError("y" * 3_000_000))
    assert said.endswith("y ... (of 3000000 characters)")
    assert len(said) < 2_100
