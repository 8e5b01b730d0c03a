"""Calibration: the true parameters are found from few steps, with intervals that hold, and bad simulators are named."""

from __future__ import annotations

import numpy as np
import pytest

from support.hinge import Backwards, Broken, Real, Textbook, hinge_spec, steps_of
from surrogym_sampler.priors.calibration import Calibration, NotCalibrated, Parameter, RealTransitions, calibrate

RANGES = (Parameter("mass", 0.5, 2.0), Parameter("length", 0.5, 2.0), Parameter("friction", 0.1, 0.8))
TRUE = {"mass": Real.mass, "length": Real.length, "friction": Real.friction}


def calibrated(
    count: int, noise: float = 0.0, seed: int = 0, parameters: tuple[Parameter, ...] = RANGES, plant: type = Textbook
) -> Calibration:
    simulator, steps = plant(), steps_of(Real(), count, seed)
    q, u, q_next = (np.array([getattr(s, f) for s in steps]) for f in ("coordinates", "action", "next_coordinates"))
    q_next = q_next + noise * np.random.default_rng(seed).standard_normal(q_next.shape)

    def step(values, coordinates, action):
        for parameter, value in zip(parameters, values, strict=True):
            setattr(simulator, parameter.name, value)
        return simulator.step_from(coordinates, action).next_coordinates

    own = np.array([getattr(plant, parameter.name) for parameter in parameters])
    return calibrate(hinge_spec(), RealTransitions(q, u, q_next), parameters, own, step)


def test_four_noise_free_real_steps_determine_three_simulator_parameters():
    found = calibrated(4)
    assert found.values == pytest.approx(TRUE, rel=1e-5)
    assert found.error < 1e-6 < 0.01 < found.error_before
    assert all(one.determined and one.low <= TRUE[one.name] <= one.high for one in found.parameters)


def test_calibration_intervals_cover_the_true_parameters_in_90_percent_under_noise():
    runs = [calibrated(12, noise=0.02, seed=seed) for seed in range(30)]
    inside = [one.low <= TRUE[one.name] <= one.high for run in runs for one in run.parameters]
    assert 0.8 <= np.mean(inside) <= 0.99


@pytest.mark.parametrize("count", [5, 8, 25])
def test_calibration_intervals_cover_the_true_parameters_of_a_plant_with_friction_that_the_simulator_lacks(count):
    class WithoutFriction(Textbook):
        friction = 0.0

    runs = [calibrated(count, 0, seed, RANGES[:2], WithoutFriction) for seed in range(15)]
    inside = [one.low <= TRUE[one.name] <= one.high for run in runs for one in run.parameters]
    assert np.mean(inside) >= 0.85


def test_calibration_intervals_of_a_right_simulator_shrink_as_the_root_of_the_steps_under_noise():
    few, many = (
        np.median([[one.high - one.low for one in calibrated(n, 0.02, seed).parameters] for seed in range(9)], axis=0)
        for n in (15, 60)
    )
    assert (few / many > 1.6).all()


def test_a_simulator_parameter_without_effect_on_the_steps_keeps_its_value():
    class WithName(Textbook):
        spare = 3.0

    found = calibrated(8, parameters=(*RANGES, Parameter("spare", 1.0, 9.0)), plant=WithName)
    (spare,) = (one for one in found.parameters if one.name == "spare")
    assert not spare.determined
    assert spare.value == pytest.approx(3.0, rel=0.05)
    assert spare.high / spare.low > 3
    assert {name: value for name, value in found.values.items() if name != "spare"} == pytest.approx(TRUE, rel=1e-4)


def test_parameters_that_only_their_ratio_determines_have_wide_intervals():
    """Mass, friction and force of this hinge can all be doubled without an effect on any step."""

    class Geared(Textbook):
        gear = 1.0

        def step_from(self, coordinates, action):
            return super().step_from(coordinates, self.gear * np.asarray(action))

    scaled = (*RANGES, Parameter("gear", 0.5, 2.0))
    found = {one.name: one for one in calibrated(8, parameters=scaled, plant=Geared).parameters}
    assert found["length"].determined
    assert not found["mass"].determined
    assert not found["gear"].determined
    assert all(found[name].low <= value <= found[name].high for name, value in (TRUE | {"gear": 1.0}).items())


def test_calibration_without_parameters_only_measures_the_simulator_error():
    found = calibrated(5, parameters=())
    assert found.parameters == ()
    assert found.error == found.error_before > 0.01


def test_the_calibrated_simulator_of_another_plant_keeps_a_large_error():
    assert calibrated(12, plant=Backwards).error > 0.3


@pytest.mark.parametrize("count", [0, 1])
def test_calibration_with_too_few_real_steps_is_refused_with_the_needed_number(count):
    with pytest.raises(NotCalibrated, match="at least 2 real steps"):
        calibrated(count)


def test_calibrating_a_simulator_that_always_fails_is_refused_with_its_error():
    with pytest.raises(NotCalibrated, match="the solver diverged"):
        calibrated(6, plant=Broken)


def test_a_simulator_whose_steps_together_diverge_is_refused_with_that_reason():
    real = RealTransitions(np.zeros((3, 2)), np.zeros((3, 1)), np.ones((3, 2)))
    with pytest.raises(NotCalibrated, match=r"infinite or NaN.*smaller time step"):
        calibrate(hinge_spec(), real, (), np.zeros(0), lambda *_: np.zeros(2), lambda *_: np.full((3, 2), np.nan))
