"""``mujoco:FILE.xml``: a model file is stepped as MuJoCo steps it, alone or many steps at once; misfits are refused."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

import surrogym
from surrogym_sampler import original
from surrogym_sampler.original.describing import describe
from surrogym_sampler.original.errors import StepFailed, UnknownEnvironment
from surrogym_sampler.original.loading import is_known
from surrogym_server.errors import InvalidInput, PluginFailed
from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    DeclaredReward,
    EnvironmentSpec,
    ObservationEntry,
    RewardTerm,
    Term,
    Uniform,
)
from surrogym_trainer.evaluation import imagined_returns

mujoco = pytest.importorskip("mujoco")

NAMES = ("slide", "hinge", "slide_velocity", "hinge_velocity")
WORDS = ("cart", "pole", "cart_speed", "pole_speed")
NOTHING = DeclaredReward(kind="declared", terms=(RewardTerm(weight=0.0, shape="one"),))
FREE = 'contype="0" conaffinity="0"'
ACTUATOR = '<actuator><motor name="push" joint="slide" gear="5" ctrlrange="-1 1"/></actuator>'


def pole(folder: Path, actuator: str = ACTUATOR, mass: float = 0.2, timestep: float = 0.01) -> str:
    """A cart that is pushed, with a pole that hangs on it."""
    path = folder / "pole.xml"
    path.write_text(
        f'<mujoco><option timestep="{timestep}"/><worldbody><body name="cart">'
        f'<joint name="slide" type="slide" axis="1 0 0" damping="0.5"/><geom type="box" size=".2 .1 .1" {FREE}/>'
        f'<body name="pole"><joint name="hinge" axis="0 1 0" damping="0.02"/>'
        f'<geom type="capsule" fromto="0 0 0 0 0 -.6" size=".04" mass="{mass}" {FREE}/>'
        f"</body></body></worldbody>{actuator}</mujoco>"
    )
    return f"mujoco:{path}"


def spec_of(names: tuple[str, ...] = NAMES, **fields: object) -> EnvironmentSpec:
    made = EnvironmentSpec(
        environment="",
        coordinates=tuple(Coordinate(name=name, sampling=Uniform(low=-1, high=1)) for name in names),
        observation=tuple(ObservationEntry(name=name, term=Term.linear(**{name: 1})) for name in names),
        action=BoxAction(low=(-1,), high=(1,)),
        start={name: Uniform(low=-0.1, high=0.1) for name in names},
        time_limit=20,
        sampling_period=0.03,
        reward=NOTHING,
    )
    return EnvironmentSpec.model_validate({**made.model_dump(), **fields})


def drawn(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.uniform(-1, 1, (count, 4)), rng.uniform(-1, 1, (count, 1))


def test_a_step_holds_the_controls_for_the_declared_period(tmp_path):
    name = pole(tmp_path)
    environment, model = original.make(name, spec=spec_of()), mujoco.MjModel.from_xml_path(name.partition(":")[2])
    (q,), (u,) = drawn(1)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = q[:2], q[2:], u
    mujoco.mj_step(model, data, 3)
    step = environment.step_from(q, u)
    np.testing.assert_allclose(step.next_coordinates, [*data.qpos, *data.qvel], atol=1e-9)
    assert (step.reward, step.terminated) == (0.0, False)


def test_many_steps_at_once_equal_single_ones_and_one_that_diverges_is_no_number(tmp_path):
    environment = original.make(pole(tmp_path), spec=spec_of())
    q, u = drawn(20)
    single = [environment.step_from(*row).next_coordinates for row in zip(q, u, strict=True)]
    np.testing.assert_allclose(environment.steps_from(q, u), single, atol=1e-9)
    q[3, 2] = 1e12
    assert np.isnan(environment.steps_from(q, u)).any(1).nonzero()[0].tolist() == [3]
    with pytest.raises(StepFailed, match=r"diverged: use a smaller timestep in the file, or narrower sampling ranges"):
        environment.step_from(q[3], u[3])
    np.testing.assert_allclose(environment.step_from(q[4], u[4]).next_coordinates, single[4], atol=1e-9)
    environment.close()


@pytest.mark.parametrize("delay", ["", 'delay="0.005" nsample="4" interp="linear"'], ids=["prompt", "delayed"])
def test_many_steps_of_one_time_step_each_that_diverge_are_no_numbers_either(tmp_path, delay):
    """Earlier controls of an actuator with a delay have times of their own."""
    if delay and not hasattr(mujoco.MjModel, "nhistory"):
        pytest.skip("this version of MuJoCo has no delays")
    actuator = ACTUATOR.replace("/></actuator>", f" {delay}/></actuator>")
    environment, (q, u) = original.make(pole(tmp_path, actuator), spec=spec_of(sampling_period=0.01)), drawn(20)
    single = [environment.step_from(*row).next_coordinates for row in zip(q, u, strict=True)]
    np.testing.assert_allclose(environment.steps_from(q, u), single, atol=1e-9)
    q[3, 3] = 1e9
    assert np.isnan(environment.steps_from(q, u)).any(1).nonzero()[0].tolist() == [3]
    environment.close()


def test_coordinates_match_by_name_in_any_order_or_all_by_their_places(tmp_path):
    name, (q,), (u,) = pole(tmp_path), *drawn(1)
    turned = NAMES[::-1]
    plain, mixed, placed = (original.make(name, spec=spec_of(names)) for names in (NAMES, turned, WORDS))
    expected = plain.step_from(q, u).next_coordinates
    assert mixed.step_from(q[::-1], u).next_coordinates.tolist() == expected[::-1].tolist()
    assert placed.step_from(q, u).next_coordinates.tolist() == expected.tolist()
    assert placed.simulator.matched[:2] == ("cart = slide", "pole = hinge")


@pytest.mark.parametrize(
    ("names", "fields", "words"),
    [
        (WORDS[:3], {}, "slide, hinge, slide_velocity, hinge_velocity, or as many in this order, got cart, pole"),
        (("pole", "slide", "a", "b"), {}, "or as many in this order, got pole, slide, a, b: rename the joints"),
        (NAMES, {"sampling_period": None}, "with sampling_period, the seconds for which mujoco:"),
        (NAMES, {"sampling_period": 0.025}, "a whole number of the time steps of mujoco:.*, 0.01 s, got 0.025 s"),
        (NAMES, {"action": {"kind": "box", "low": (-1, -1), "high": (1, 1)}}, "takes a continuous action of 1 entry"),
        (NAMES, {"reward": {"timing": "after"}}, "has no reward of its own, got a learned reward"),
    ],
)
def test_a_specification_that_does_not_fit_the_file_is_refused(tmp_path, names, fields, words):
    with pytest.raises(UnknownEnvironment, match=words):
        original.make(pole(tmp_path), spec=spec_of(names, **fields))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "which is no file"),
        ("<mujoco><joint/></mujoco>", "expected a file that MuJoCo can load, .* correct the file"),
        ("<mujoco><worldbody/></mujoco>", "got 0 joints, 0 actuators and 0 mocap bodies"),
    ],
)
def test_a_file_without_a_model_that_can_be_driven_is_refused(tmp_path, text, words):
    path = tmp_path / "other.xml"
    if text:
        path.write_text(text)
    with pytest.raises(UnknownEnvironment, match=words):
        original.make(f"mujoco:{path}", spec=spec_of())


def test_a_file_is_described_but_never_opened_because_a_server_names_it(tmp_path):
    name = pole(tmp_path, ACTUATOR.replace(' ctrlrange="-1 1"', ""))
    described = describe(name, steps=40)
    assert described.spec.coordinate_names == NAMES
    assert described.spec.sampling_period == pytest.approx(0.02)
    assert "one without a ctrlrange is taken as -1 to 1" in " ".join(described.found)
    assert not described.pays
    assert not is_known(name)


class Plant:
    """A cart and pole of other masses, with a reward of its own."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self._inner = original.make(pole(folder, mass=0.3), spec=spec_of(WORDS))

    def spec(self) -> EnvironmentSpec:
        return spec_of(WORDS, reward={"timing": "after"}, design={"initial": 8, "budget": 12})

    def step_from(self, coordinates, action):
        step = self._inner.step_from(coordinates, action)
        return surrogym.RealStep(
            step.coordinates, step.action, step.next_coordinates, reward=math.cos(step.next_coordinates[1])
        )


def test_the_parameters_of_a_file_are_calibrated_as_a_prior_and_the_reward_is_learned_without_it(tmp_path):
    plant, seen = Plant(tmp_path / "plant"), []
    prior = surrogym.Prior(pole(tmp_path), plant.spec(), ["mass.pole", "gear.push"], steps=60)
    many = prior._steps_from
    prior._steps_from = lambda *given: seen.append(len(given[0])) or many(*given)  # type: ignore[assignment]
    design = surrogym.Design(plant.spec(), prior=prior)
    while (query := design.ask()) is not None:
        design.tell(query, plant.step_from(query.coordinates, query.action))
    assert prior.calibration is not None
    assert prior.calibration.values == pytest.approx({"mass.pole": 0.3, "gear.push": 5.0}, rel=1e-4)
    assert min(seen) == 8, "all real steps are repeated at once"
    assert prior.source.endswith(
        "pole.xml (cart = slide, pole = hinge, cart_speed = slide_velocity, pole_speed = hinge_velocity)"
    )
    structures = design.surrogate().model.structures
    assert all(one.startswith("prior + ") for one in structures[:4])
    assert not structures[4].startswith("prior + ")


def test_a_surrogate_may_step_the_calibrated_file_itself(tmp_path):
    spec = spec_of(reward=DeclaredReward(kind="declared", terms=(RewardTerm(weight=2.0, shape="one"),)))
    prior = surrogym.Prior(pole(tmp_path), spec, ["mass.pole"])
    (other := tmp_path / "other").mkdir()
    real, (q, u) = original.make(pole(other, mass=0.3), spec=spec), drawn(5)
    prior.calibrate([real.step_from(*row) for row in zip(q, u, strict=True)])
    moved = prior.stepped().model.transition(torch.from_numpy(q), torch.from_numpy(u), stds=True, reward_std=True)
    np.testing.assert_allclose(
        moved.q_next, [real.step_from(*row).next_coordinates for row in zip(q, u, strict=True)], atol=1e-7
    )
    assert moved.reward.tolist() == [2.0] * 5
    assert moved.std is not None
    assert not moved.std.any()
    returns = imagined_returns(prior.stepped(), lambda shown: np.zeros((len(shown), 1)), 3, seed=0)
    assert returns.tolist() == [2.0 * spec.time_limit] * 3


def test_values_that_one_simulator_was_calibrated_to_can_be_given_to_another_one(tmp_path):
    (other := tmp_path / "other").mkdir()
    prior = surrogym.Prior(pole(tmp_path), spec_of(), ["mass.pole"])
    prior.set_parameters({"mass.pole": 0.3})
    q, u = drawn(5)
    heavy = original.make(pole(other, mass=0.3), spec=spec_of())
    moved = prior.stepped().model.transition(torch.from_numpy(q), torch.from_numpy(u))
    np.testing.assert_allclose(
        moved.q_next, [heavy.step_from(*row).next_coordinates for row in zip(q, u, strict=True)], atol=1e-12
    )
    with pytest.raises(ValueError, match=r"expected values of mass\.pole, got one of mass\.cart"):
        prior.set_parameters({"mass.pole": 0.2, "mass.cart": 1.0})


def test_a_stepped_simulator_needs_a_reward_and_a_declared_termination(tmp_path):
    for fields, words in (
        ({"reward": {"timing": "after"}}, "a declared reward"),
        ({"termination": "learned"}, "termin"),
    ):
        with pytest.raises(InvalidInput, match=words):
            surrogym.Prior(pole(tmp_path), spec_of(**fields)).stepped()


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"mass.pole": 0.0}, r"expected mass\.pole above 0, got 0"),
        ({"mass.pole": -1.0}, r"expected mass\.pole above 0, got -1"),
        ({"mass.pole": math.nan}, r"expected a finite number for mass\.pole, got nan"),
        ({"mass.pole": "heavy"}, r"expected a finite number for mass\.pole, got 'heavy'"),
        ({"mass.pole": 0.3, "damping.hinge": -0.1}, r"expected damping\.hinge of at least 0, got -0\.1"),
    ],
)
def test_values_that_no_machine_can_have_are_refused_and_change_nothing(tmp_path, values, words):
    prior, (q, u) = surrogym.Prior(pole(tmp_path), spec_of(), ["mass.pole", "damping.hinge"]), drawn(5)
    before = prior.simulator.steps_from(q, u)  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match=words):
        prior.set_parameters(values)
    prior.set_parameters({"damping.hinge": 0.0})
    prior.set_parameters({"damping.hinge": 0.02})
    np.testing.assert_array_equal(prior.simulator.steps_from(q, u), before)  # type: ignore[attr-defined]


def test_a_calibration_with_a_range_of_values_that_no_machine_can_have_ends(tmp_path):
    (other := tmp_path / "other").mkdir()
    real, (q, u) = original.make(pole(other, mass=0.01), spec=spec_of()), drawn(20)
    prior = surrogym.Prior(pole(tmp_path), spec_of(), ["mass.pole=-1..1"])
    prior.calibrate([real.step_from(*row) for row in zip(q, u, strict=True)])
    assert prior.calibration is not None
    assert prior.calibration.values == pytest.approx({"mass.pole": 0.01}, rel=1e-3)


def test_a_training_in_a_file_that_diverges_ends_with_a_sentence(tmp_path):
    path = Path(pole(tmp_path, timestep=0.03).partition(":")[2])
    path.write_text(path.read_text().replace('type="slide"', 'type="slide" stiffness="1e6"'))
    prior = surrogym.Prior(f"mujoco:{path}", spec_of())
    with pytest.raises(PluginFailed, match=r"below 1e\+15 from the simulator, got larger ones or NaN"):
        imagined_returns(prior.stepped(), lambda shown: np.zeros((len(shown), 1)), 3, seed=0)


def test_an_opened_file_has_no_reward_either(tmp_path):
    spec = spec_of(reward={"timing": "after"})
    opened = surrogym.Prior(pole(tmp_path), spec).simulator
    with pytest.raises(InvalidInput, match=r"a declared reward, because mujoco:.* has none"):
        surrogym.Prior(opened, spec).stepped()
