"""The detector keeps its rate of false alarms without a change, and finds a change within few steps."""

from __future__ import annotations

import numpy as np
import pytest

from surrogym_trainer.watching.detector import Detector, Drift

CLAIMED, TOLERANCE = np.array([1.0, 0.02]), np.array([0.5, 0.01])
KNOWN = 0.2 * CLAIMED  # deviations of the model
FALSE_ALARM_STEPS = 10_000


def first(errors: np.ndarray, false_alarm_steps: float = FALSE_ALARM_STEPS) -> tuple[int, Drift] | None:
    """The number of steps up to the first alarm, and the alarm."""
    detector = Detector(CLAIMED, TOLERANCE, false_alarm_steps)
    for count, error in enumerate(errors, start=1):
        if (found := detector.step(error, KNOWN)) is not None:
            return count, found
    return None


def noise(count: int, seed: int) -> np.ndarray:
    return CLAIMED * np.random.default_rng(seed).standard_normal((count, 2))


def changed(seed: int, shift: float = 0.0, scale: float = 1.0, healthy: int = 200) -> tuple[int, Drift] | None:
    """Steps from a change of the second output, in units of its noise, up to the alarm."""
    errors = noise(healthy + 200, seed)
    errors[healthy:, 1] = CLAIMED[1] * shift + scale * errors[healthy:, 1]
    found = first(errors)
    return None if found is None else (found[0] - healthy, found[1])


def test_the_drift_detectors_false_alarm_rate_is_below_the_stated_one():
    """Both halves: at most the stated rate, and yet the rate is what is asked for, and not a constant."""
    steps, alarms = 0, {100.0: 0, 1e9: 0}
    for seed in range(40):
        errors = noise(400, seed)
        steps += 400
        for rate in alarms:
            alarms[rate] += first(errors, rate) is not None
    assert 0 < alarms[100.0] <= 1.2 * steps / 100.0
    assert alarms[1e9] == 0


@pytest.mark.parametrize("width", [0.25, 1.0])
def test_the_drift_detector_raises_no_false_alarm_in_a_long_unchanged_stream(width: float):
    """Also if the noise where the policy goes is much smaller than over the whole range."""
    assert first(width * noise(4_000, 7)) is None


def test_errors_within_the_predicted_deviation_are_not_reported_as_drift():
    """A right model errs in the same way again and again where a policy spends its time."""
    assert first(0.1 * noise(4_000, 8) + 0.2 * CLAIMED) is None


@pytest.mark.parametrize(("shift", "scale", "within"), [(4.0, 1.0, 8), (-1.5, 1.0, 30), (0.0, 4.0, 30)])
def test_drift_is_detected_soon_with_its_output_and_kind(shift: float, scale: float, within: int):
    found = [changed(seed, shift, scale) for seed in range(100, 108)]
    delays = [one[0] for one in found if one is not None]
    assert len(delays) == 8
    assert 2 < np.median(delays) <= within
    for _, drift in (one for one in found if one is not None):
        assert (drift.output, drift.shifted or shift == 0) == (1, True)
        assert drift.steps <= 2 * within


def test_drift_before_the_first_step_is_detected():
    """The errors of a plant that was changed from the beginning are not taken for its usual ones."""
    found = changed(3, shift=3.0, healthy=0)
    assert found is not None
    assert found[0] <= 30


def test_slow_drift_is_detected():
    errors = noise(3_000, 9)
    errors[1_000:, 0] += 0.01 * np.arange(2_000)
    found = first(errors)
    assert found is not None
    assert 1_000 < found[0] < 1_400


def test_single_spikes_are_not_reported_as_drift():
    errors = noise(2_000, 10)
    errors[::200] *= 1e6
    assert first(errors) is None


@pytest.mark.parametrize("kind", ["laplace", "outliers"])
def test_heavy_tailed_noise_is_not_reported_as_drift(kind: str):
    """Bets on larger errors win often in such noise. What they won before counts against them."""
    rng, alarms = np.random.default_rng(5), 0
    errors = noise(8_000, 12) * np.where(rng.random((8_000, 2)) < 0.01, 20, 1)
    if kind == "laplace":
        errors = CLAIMED * rng.laplace(size=(8_000, 2)) / np.sqrt(2)
    while (found := first(errors)) is not None:
        alarms, errors = alarms + 1, errors[found[0] :]
    assert alarms <= 3  # 0.8 are expected at the stated rate


def test_errors_far_below_the_tolerance_are_not_reported_as_drift():
    """An output that the model knows by a formula errs by rounding alone."""
    detector = Detector(np.array([1e-12]), np.array([1.0]), FALSE_ALARM_STEPS)
    rng = np.random.default_rng(0)
    for error in 1e-6 * rng.standard_normal(500) ** 3:
        assert detector.step(np.array([error]), np.zeros(1)) is None


def test_a_step_without_information_on_an_output_does_not_change_its_drift_evidence():
    errors = noise(1_000, 11)
    errors[:, 1] = np.nan
    assert first(errors) is None
