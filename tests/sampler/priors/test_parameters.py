"""Parameters of a simulator: which ones there are, how they are changed, and how a range is written."""

from __future__ import annotations

import pytest

from support.hinge import Textbook, hinge_spec
from support.toys import Toy
from surrogym_sampler import original
from surrogym_sampler.original.errors import UnknownEnvironment
from surrogym_sampler.original.simulator import Simulated, Variable
from surrogym_sampler.priors.calibration import Parameter, adjustable, read_parameters


def test_numeric_attributes_of_a_simulator_are_its_parameters():
    plant, other = Textbook(), Textbook()
    found = adjustable(plant)
    assert found.parameters() == {"mass": 1.0, "length": 1.0, "friction": 0.2}
    found.set_parameters({"mass": 2.5})
    assert (plant.mass, other.mass) == (2.5, 1.0)


def test_parameter_methods_of_a_simulator_take_precedence_over_attributes():
    class Computing(Textbook):
        def parameters(self):
            return {"weight": self.mass * 9.81}

        def set_parameters(self, values):
            self.mass = values["weight"] / 9.81

    plant = Computing()
    adjustable(plant).set_parameters({"weight": 19.62})
    assert plant.mass == pytest.approx(2.0)


def test_simulator_parameters_can_be_set_under_a_replaced_specification():
    own = original.make("support.hinge:Textbook").spec()
    changed = own.model_copy(update={"time_limit": 7})
    environment = original.make("support.hinge:Textbook", spec=changed)
    before = environment.step_from((1.0, 0.0), (0.0,)).next_coordinates[1]
    adjustable(environment).set_parameters({"length": 0.5})
    assert environment.step_from((1.0, 0.0), (0.0,)).next_coordinates[1] == pytest.approx(2 * before)


def test_setting_a_gymnasium_parameter_updates_its_derived_constants():
    environment = original.make("CartPole-v1")
    before = environment.step_from((0.0, 0.0, 0.1, 0.0), (1,)).next_coordinates
    adjustable(environment).set_parameters({"masscart": 3.0})
    assert environment.step_from((0.0, 0.0, 0.1, 0.0), (1,)).next_coordinates[1] < before[1] / 2


def test_masses_and_damping_of_mujoco_parts_are_simulator_parameters():
    environment = original.make("InvertedPendulum-v5")
    found = adjustable(environment)
    assert {"mass.pole", "mass.cart", "damping.slider"} <= set(found.parameters())
    state, push = (0.0, 0.1, 0.5, 0.0), (1.0,)
    before = environment.step_from(state, push).next_coordinates
    found.set_parameters({"mass.cart": 5 * found.parameters()["mass.cart"]})
    after = environment.step_from(state, push).next_coordinates
    assert abs(after[2] - 0.5) < abs(before[2] - 0.5)
    found.set_parameters({"mass.cart": found.parameters()["mass.cart"] / 5})
    assert environment.step_from(state, push).next_coordinates == pytest.approx(before)


def test_an_adapters_simulator_without_physical_parameters_has_none_to_calibrate():
    class Hinge(Toy):
        variables = (Variable("angle"), Variable("speed"))
        power = 3.0

        def reset(self, seed: int | None):
            raise NotImplementedError

        step = reset

    plain = adjustable(Simulated(Hinge(), hinge_spec()))
    with pytest.raises(ValueError, match=r"of the simulator \(none\), got 'power'"):
        read_parameters(["power"], plain)


@pytest.mark.parametrize(
    ("text", "low", "high"), [("mass", 0.5, 2.0), ("mass=0.2..3", 0.2, 3.0), ("friction=-1..1e0", -1.0, 1.0)]
)
def test_a_parameter_range_is_parsed_or_chosen_around_the_current_value(text, low, high):
    found = Parameter.parse(text, {"mass": 1.0, "friction": 0.2})
    assert (found.low, found.high) == (low, high)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("weight", "friction, mass"),
        ("mass=1", "NAME=LOW..HIGH"),
        ("mass=a..b", "NAME=LOW..HIGH"),
        ("mass=2..1", "the smaller one first"),
        ("mass=nan..2", "finite"),
        ("mass=2..3", "own value 1"),
        ("friction", "own value is 0"),
    ],
)
def test_an_invalid_parameter_range_is_refused(text, words):
    with pytest.raises(ValueError, match=words):
        Parameter.parse(text, {"mass": 1.0, "friction": 0.0})


def test_a_simulator_parameter_named_twice_is_refused():
    with pytest.raises(ValueError, match="mass several times"):
        read_parameters(["mass", "mass=0.5..2"], adjustable(Textbook()))


def test_a_simulator_that_cannot_step_from_given_states_is_refused():
    with pytest.raises(UnknownEnvironment):
        adjustable(object())
