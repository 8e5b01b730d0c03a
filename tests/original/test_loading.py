"""Names become environments, or one clear sentence."""

import sys
import textwrap

import numpy as np
import pytest

from surrogym_sampler import original
from surrogym_sampler.original.describing import describe
from surrogym_sampler.original.episodes import open_episode
from surrogym_sampler.original.errors import UnknownEnvironment
from surrogym_sampler.original.loading import is_known
from surrogym_shared.spec import BoxAction, DiscreteAction, Reward

OWN = textwrap.dedent(
    """
    from surrogym_sampler.original import RealStep
    from surrogym_shared.spec import *

    class Cart:
        def spec(self):
            return EnvironmentSpec(
                environment="a cart",
                coordinates=(Coordinate(name="x", sampling=Uniform(low=-1, high=1)),),
                observation=(ObservationEntry(name="x", term=Term.linear(x=1)),),
                action=BoxAction(low=(-1.0,), high=(1.0,)),
                start={"x": Uniform(low=-0.5, high=0.5)},
            )

        def step_from(self, coordinates, action):
            return RealStep(coordinates, action, coordinates + 0.1 * action, reward=-abs(coordinates[0]))

        def close(self):
            pass

    class NoEnvironment:
        pass

    a_number = 3
    """
)


@pytest.fixture
def own_module(tmp_path, monkeypatch):
    (tmp_path / "own_cart.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    return "own_cart"


def test_design_options_reach_the_specification_of_a_built_in_environment():
    spec = original.make("Pendulum-v1", budget=30, initial=10, target=0.99, seed=7, bins=5).spec()
    assert (spec.design.budget, spec.design.initial, spec.design.target, spec.design.seed) == (30, 10, 0.99, 7)
    assert spec.action.bins == (5,)


def test_a_given_specification_replaces_the_built_in_one():
    spec = original.make("Pendulum-v1", budget=17).spec()
    assert original.make("Pendulum-v1", spec=spec).spec() == spec


def test_a_specification_of_another_environment_is_refused():
    """Otherwise the wrong --env would be ignored, or answer from the wrong machine."""
    pendulum = original.make("Pendulum-v1").spec()
    with pytest.raises(UnknownEnvironment, match=r"expected a specification of CartPole-v1, got one of Pendulum-v1"):
        original.make("CartPole-v1", spec=pendulum)
    nameless = pendulum.model_copy(update={"environment": ""})
    assert original.make("Pendulum-v1", spec=nameless).spec() == pendulum


@pytest.mark.parametrize("name", ["Pendulum-v1", "Acrobot-v1", "MountainCar-v0"])
def test_a_built_in_task_can_be_opened_by_its_described_specification(name):
    """Its coordinates are those of a simulator. The task's own class answered with an observation of its own, and the
    server refused every step."""
    machine = original.make(name, spec=describe(name, 40).spec)
    spec = machine.spec()
    assert spec.coordinate_names[0] == "state0"
    start = machine.begin(3)
    taken = machine.act(np.array([0.0]))
    again = machine.step_from(np.asarray(taken.coordinates), np.array([0.0]))
    np.testing.assert_allclose(taken.coordinates, start)
    np.testing.assert_allclose(again.next_coordinates, taken.next_coordinates, atol=1e-6)
    assert taken.next_observation is None, "the server calculates the declared one"
    episode = open_episode(name, spec, lambda: machine)
    assert episode.reset(3).observation.shape == (len(spec.observation),)
    assert episode.place(start).coordinates == pytest.approx(start)
    episode.close()


def test_the_terminating_step_of_a_described_cart_pole_pays_the_same_each_time():
    """CartPole pays nothing for steps after the end of an episode, and a query may follow a fall."""
    machine = original.make("CartPole-v1", spec=describe("CartPole-v1", 40).spec)
    falls = [machine.step_from(np.array([0, 0, 0.2, 2.0]), np.array([1])) for _ in range(2)]
    assert [(step.terminated, step.reward) for step in falls] == [(True, 1.0)] * 2
    machine.close()


def test_a_built_in_task_returns_observations_only_if_every_entry_is_declared():
    spec = original.make("Pendulum-v1").spec()
    fewer = spec.model_copy(update={"observation": spec.observation[:2]})
    at, force = np.array([0.1, 0.2]), np.array([0.5])
    assert original.make("Pendulum-v1", spec=fewer).step_from(at, force).next_observation is None
    assert len(original.make("Pendulum-v1", spec=spec).step_from(at, force).next_observation) == 3


def test_a_specification_with_reordered_coordinates_of_a_built_in_task_is_refused():
    """They were taken by their place: an angle was set as a speed."""
    spec = original.make("Pendulum-v1").spec()
    turned = spec.model_copy(update={"coordinates": spec.coordinates[::-1]})
    with pytest.raises(UnknownEnvironment, match=r".'state0', 'state1'., .* built-in task, theta, speed, in"):
        original.make("Pendulum-v1", spec=turned)


@pytest.mark.parametrize(
    ("name", "action", "said"),
    [
        ("Pendulum-v1", DiscreteAction(n=3), "a discrete action of 3 values, but Pendulum-v1 takes a continuous"),
        ("Pendulum-v1", BoxAction(low=(-1.0, -1.0), high=(1.0, 1.0)), "declares a continuous action of 2 entries, but"),
        ("CartPole-v1", DiscreteAction(n=3), "action of 3 values, but CartPole-v1 takes a discrete action of 2 values"),
    ],
)
@pytest.mark.parametrize("described", [True, False])
def test_a_specification_with_an_action_the_environment_cannot_take_is_refused(name, action, said, described):
    """Numbers of discrete actions were applied as torques, and a second entry was ignored."""
    spec = describe(name, 40).spec if described else original.make(name).spec()
    with pytest.raises(UnknownEnvironment, match=said):
        original.make(name, spec=spec.model_copy(update={"action": action, "reward": Reward()}))


def test_a_specification_with_narrower_action_bounds_is_accepted():
    spec = original.make("Pendulum-v1").spec()
    weak = spec.model_copy(update={"action": BoxAction(low=(-0.5,), high=(0.5,), bins=(3,))})
    assert original.make("Pendulum-v1", spec=weak).spec() == weak


def test_contradicting_design_options_are_refused():
    with pytest.raises(ValueError, match="initial 20 exceeds the budget 10"):
        original.make("Pendulum-v1", budget=10, initial=20)
    with pytest.raises(ValueError, match="bins need a continuous action, got a discrete one"):
        original.make("CartPole-v1", bins=3)


def test_a_user_defined_environment_class_is_loaded_by_module_and_name(own_module):
    environment = original.make(f"{own_module}:Cart", budget=12)
    assert environment.spec().design.budget == 12
    assert environment.spec().environment == "a cart"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Nowhere-v3", "Nowhere-v3 can't be made: Environment .Nowhere. doesn't exist"),
        ("nowhere", "no adapter knows the environment 'nowhere': expected one of Pendulum-v1"),
        ("own_cart:Missing", "expected package.module:factory, got 'own_cart:Missing'"),
        ("no_such_module:x", "No module named 'no_such_module'"),
        (":x", "expected package.module:factory, got ':x'"),
        ("own_cart.py:Cart", "'own_cart' is not a package; did you mean own_cart:Cart?"),
        ("own_cart:a_number", "to be callable, got a int"),
        ("own_cart:NoEnvironment", "reset, step, coordinates and close, got a NoEnvironment"),
    ],
)
def test_environment_names_that_cannot_be_loaded_are_refused(own_module, name, message):
    with pytest.raises(UnknownEnvironment, match=message):
        original.make(name)


@pytest.mark.parametrize(
    ("code", "message"),
    [
        (
            "import sys; sys.exit('no licence')",
            r"ends called sys.exit while it was imported: SystemExit: no licence \(ends.py:1",
        ),
        ("def f(:", r"ends can't be imported: SyntaxError: .* \(ends.py, line 1\); correct it$"),
        ("import sys; Cart = sys.exit", "ends:Cart called sys.exit while it was made: SystemExit"),
    ],
)
def test_the_error_for_an_environment_module_that_calls_exit_or_is_no_python_names_it(
    tmp_path, monkeypatch, code, message
):
    """The command ended without a word."""
    (tmp_path / "ends.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "ends", raising=False)
    with pytest.raises(UnknownEnvironment, match=message):
        original.make("ends:Cart")


BROKEN = """
import own_cart
class Mute(Exception):
    def __str__(self): raise RuntimeError("no words")
class Made(own_cart.Cart):
    def __init__(self): raise ValueError("no licence")
class Specified(own_cart.Cart):
    def spec(self): raise Mute()
class Misspelt(own_cart.Cart):
    def spec(self):
        from surrogym_shared.spec import Coordinate, Uniform
        return Coordinate(nam="x", sampling=Uniform(low=-1, high=1))
class Open:
    spec, step_from = own_cart.Cart.spec, own_cart.Cart.step_from
"""


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Made", r"broken:Made failed while it was made: ValueError: no licence \(broken.py:6\)"),
        ("Specified", r"spec\(\) of broken:Specified failed: Mute: its message can't be read"),
        (
            "Misspelt",
            r"spec\(\) of broken:Misspelt failed: Coordinate: nam: unknown entry; expected some of name, .*"
            r"did you mean 'name'\?; correct it",
        ),
        ("Open", r"expected an object with spec, step_from and close, .* got a Open without close$"),
    ],
)
def test_the_error_for_a_broken_environment_class_names_the_fault(own_module, tmp_path, monkeypatch, name, message):
    """The command ended in a traceback of Surrogym."""
    (tmp_path / "broken.py").write_text(BROKEN)
    for module in ("broken", own_module):
        monkeypatch.delitem(sys.modules, module, raising=False)
    with pytest.raises(UnknownEnvironment, match=message):
        original.make(f"broken:{name}")


def test_the_error_for_an_incomplete_class_names_it_also_if_its_specification_is_replaced(
    own_module, tmp_path, monkeypatch
):
    (tmp_path / "broken.py").write_text(BROKEN)
    for module in ("broken", own_module):
        monkeypatch.delitem(sys.modules, module, raising=False)
    other = original.make(f"{own_module}:Cart").spec().model_copy(update={"time_limit": 7})
    with pytest.raises(UnknownEnvironment, match=r"got a Open without close$"):
        original.make("broken:Open", spec=other)


def test_a_specification_from_a_server_can_only_open_built_in_environments():
    assert is_known("Pendulum-v1")
    assert is_known("Hopper-v5")
    assert not is_known("own_cart:Cart")
    assert not is_known("own_cart:Env-v0")
    assert not is_known("pcgym:plant.json")
    assert not is_known("dm_control:../x-y")
    assert is_known("dm_control:cartpole-swingup")
    assert not is_known("a robot")


def test_the_error_for_an_environment_without_specification_recommends_describe():
    pytest.importorskip("mujoco")
    with pytest.raises(UnknownEnvironment, match=r"Hopper-v5 has no built-in specification .*surrogym describe Hopper"):
        original.make("Hopper-v5")
