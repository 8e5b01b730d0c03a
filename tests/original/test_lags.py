"""What an environment reads becomes coordinates with their past."""

from __future__ import annotations

import math

import numpy as np
import pytest

from support.rail import SPEC, Rail
from support.rated import RATED, RatedRail
from surrogym_sampler.original.errors import StepFailed, UnknownEnvironment
from surrogym_sampler.original.protocol import RolloutEnvironment
from surrogym_sampler.original.rollouts import FromReset, answering
from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    DiscreteAction,
    EnvironmentSpec,
    ObservationEntry,
    Term,
    Uniform,
    with_history,
)
from surrogym_shared.terms import observe

RIGHT, LEFT = np.array([1.0]), np.array([-0.5])
CIRCLE = Uniform(low=-math.pi, high=math.pi)
HAND = EnvironmentSpec(
    coordinates=(Coordinate(name="hand", kind="angle", sampling=CIRCLE),),
    observation=(ObservationEntry(name="sin", term=Term.sin(hand=1)),),
    action=BoxAction(low=(1.0,), high=(4.0,)),
    start={"hand": CIRCLE},
    query="rollout",
)


class WithPast(Rail):
    def spec(self):
        return with_history(SPEC, changes=2, actions=2, largest={"x": 0.1})


class Moving(Rail):
    def spec(self):
        return with_history(SPEC, changes=2, largest={"x": 0.1}, at_start={"x": 0.05})


class Clock:
    """A hand that turns by the action, and is read without whole turns being taken off."""

    hand = 0.0

    def spec(self):
        return with_history(HAND, changes=1, actions=1, largest={"hand": 4.0})

    def reset(self, *, seed=None):
        self.hand = 3.0
        return self.hand, {}

    def step(self, action):
        self.hand += float(action[0])
        return self.hand, 0.0, False, False, {}

    def coordinates(self, observation):
        return [observation]

    def save(self):
        return str(self.hand).encode()

    def restore(self, snapshot):
        self.hand = float(snapshot)
        return self.hand

    def close(self):
        pass


def rolled(environment: RolloutEnvironment) -> list[np.ndarray]:
    """Coordinates after a reset, and after each of three steps."""
    return [environment.begin(seed=0), *(environment.act(u).next_coordinates for u in (RIGHT, LEFT, RIGHT))]


def test_lagged_coordinates_contain_earlier_changes_and_actions():
    environment = answering(WithPast())
    start, one, two, three = rolled(environment)
    assert environment.spec().coordinate_names == ("x", "x.change1", "x.change2", "action0.lag1", "action0.lag2")
    np.testing.assert_array_equal(start[1:], 0.0)
    np.testing.assert_allclose(one[1:], [0.1, 0.0, 1.0, 0.0])
    np.testing.assert_allclose(two[1:], [-0.05, 0.1, -0.5, 1.0])
    np.testing.assert_allclose(three[1:], [0.1, -0.05, 1.0, -0.5])


def test_lagged_coordinates_are_zero_at_the_start_of_an_episode():
    environment = answering(WithPast())
    rolled(environment)
    np.testing.assert_array_equal(environment.begin(seed=0)[1:], 0.0)


def test_a_policy_observes_the_lagged_coordinates():
    environment = answering(WithPast())
    shown = observe(environment.spec(), np.stack(rolled(environment)))
    np.testing.assert_allclose(shown[:, 1:], np.stack(rolled(environment))[:, 1:])


def test_the_lagged_change_of_an_angle_takes_the_shorter_direction():
    environment = answering(Clock())
    np.testing.assert_allclose(environment.begin(), [3.0, 0.0, 1.0])  # the action nearest to 0
    step = environment.act(np.array([1.5]))
    np.testing.assert_allclose(step.next_coordinates, [4.5 - 2 * math.pi, 1.5, 1.5])
    step = environment.act(np.array([4.0]))
    np.testing.assert_allclose(step.next_coordinates, [8.5 - 2 * math.pi, 4.0 - 2 * math.pi, 4.0])


def test_logged_start_states_get_lags_of_a_system_at_rest():
    spec = EnvironmentSpec.model_validate(HAND.model_dump() | {"starts": [[1.0], [2.0]]})
    assert with_history(spec, actions=1).starts == ((1.0, 1.0), (2.0, 1.0))


def test_the_lagged_coordinate_of_a_discrete_action_ranges_over_action_numbers():
    spec = EnvironmentSpec.model_validate(SPEC.model_dump() | {"action": DiscreteAction(n=3)})
    assert with_history(spec, actions=1).coordinates[-1].settable == (0.0, 2.0)


def test_an_environment_class_that_returns_lags_itself_is_refused():
    class Reads(WithPast):
        def coordinates(self, observation):
            return [observation[0], 0, 0, 0, 0]

    with pytest.raises(StepFailed, match=r"to return \(x\), got an array of shape \(5,\)"):
        answering(Reads()).begin()


@pytest.mark.parametrize(
    ("history", "message"),
    [
        ({"changes": 1}, r"expected the largest change in one step of \['x'\], got none"),
        ({"changes": -1}, "expected 0 or more for changes and actions, got -1 and 0"),
        ({"changes": 1, "largest": {"y": 1.0}}, r"history: largest names unknown \['y'\]: expected some of \['x'\]"),
        ({"actions": 20}, "looks 20 steps back: expected fewer than an episode's 20"),
    ],
)
def test_lags_that_do_not_fit_the_specification_are_refused(history, message):
    with pytest.raises(ValueError, match=message):
        with_history(SPEC, **history)


def test_a_declared_history_for_an_environment_with_settable_states_is_refused():
    settable = SPEC.model_copy(update={"query": "step"})
    with pytest.raises(ValueError, match="lags need one that can only be reset"):
        with_history(settable, actions=1)


def test_a_further_coordinate_counts_the_steps_since_reset_whose_past_is_unknown():
    environment = answering(Moving())
    spec, counts = environment.spec(), [q[-1] for q in rolled(environment)]
    assert counts == [0, 1, 2, 2]
    assert [spec.known(q) for q in rolled(environment)] == [False, False, True, True]
    assert spec.unknown_steps == 2


def test_a_policy_does_not_observe_the_steps_since_reset():
    assert Moving().spec().observation_names == ("x", "x.change1", "x.change2")


def test_the_declared_start_of_an_environment_with_lags_is_a_state_whose_lags_are_known():
    start = Moving().spec().start
    assert (start["steps since reset"].value, start["x.change2"].high) == (2, 0.05)


def test_a_design_with_fewer_initial_steps_than_steps_with_unknown_past_is_refused():
    fields = Moving().spec().model_dump()
    with pytest.raises(ValueError, match="expected initial of more than 3, got 3"):
        EnvironmentSpec.model_validate(fields | {"design": {"initial": 3}})


def test_a_snapshot_keeps_the_lagged_coordinates():
    environment = answering(Clock())
    assert isinstance(environment, FromReset)
    environment.begin()
    environment.act(np.array([1.5]))
    saved = environment.save()
    one = environment.act(np.array([2.0]))
    np.testing.assert_array_equal(environment.restore(saved), one.coordinates)
    two = environment.act(np.array([2.0]))
    np.testing.assert_array_equal(two.coordinates, one.coordinates)
    np.testing.assert_array_equal(two.next_coordinates, one.next_coordinates)


def test_a_snapshot_too_short_to_contain_its_lagged_values_is_refused():
    environment = answering(Clock())
    with pytest.raises(StepFailed, match="at least 24 bytes"):
        environment.restore(b"3.0")
    with pytest.raises(StepFailed, match="got none: reset"):
        environment.save()


def test_a_machine_gets_and_the_sample_has_the_nearest_action_that_the_rate_of_change_allows():
    rail = RatedRail()
    environment = answering(rail)
    environment.begin(0)
    steps = [environment.act(np.array([asked])) for asked in (1.0, 1.0, -1.0, -0.2)]
    assert rail.pushes == pytest.approx([0.5, 1.0, 0.5, 0.0])
    assert [float(step.action[0]) for step in steps] == pytest.approx(rail.pushes)
    environment.begin(0)
    assert environment.act(np.array([-1.0])).action == pytest.approx([-0.5]), "a reset forgets the last action"


def test_a_rate_of_action_change_is_refused_for_a_class_that_implements_begin_and_act():
    class Stepping:
        def spec(self):
            return RATED

        def begin(self, seed=None):
            raise AssertionError

        def act(self, action):
            raise AssertionError

        def close(self):
            pass

    with pytest.raises(UnknownEnvironment, match="reset, step and coordinates"):
        answering(Stepping())
