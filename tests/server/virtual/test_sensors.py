"""Noise of the sensors is seen, and does not move the state."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from support.exact_models import ExactModel
from surrogym_server.errors import InvalidInput
from surrogym_server.models.abilities import LearnedNoise
from surrogym_server.virtual import step
from surrogym_server.virtual.sensors import check

LANES = 2_000


@dataclass(frozen=True)
class Noisy(ExactModel, LearnedNoise):
    @property
    def noise_stds(self) -> tuple[float, ...]:
        return (*(self.process_std for _ in self.definition.moving), 0.0)


@pytest.fixture
def model(pendulum_model: ExactModel) -> Noisy:
    return Noisy(pendulum_model.definition, pendulum_model.move, pendulum_model.pay, process_std=0.1)


def speed_name(model: ExactModel) -> str:
    return model.definition.coordinate_names[1]


def test_sensor_noise_changes_observations_but_not_the_state(model: Noisy, started) -> None:
    settings, lanes = started(model, LANES, sensor_noise=((speed_name(model), 0.3),))
    exact = replace(settings, sensor_noise=())
    after, seen = step(model, settings, lanes, np.zeros((LANES, 1)))
    still, true = step(model, exact, lanes, np.zeros((LANES, 1)))
    assert torch.equal(after.q, still.q), "the state does not feel it"
    error = seen.observation - true.observation
    assert np.abs(error[:, :2]).max() == 0
    assert error[:, 2].std() == pytest.approx(0.3, rel=0.1)
    _, again = step(model, settings, after, np.zeros((LANES, 1)))
    _, true_again = step(model, exact, after, np.zeros((LANES, 1)))
    later = (again.observation - true_again.observation)[:, 2]
    assert abs(np.corrcoef(error[:, 2], later)[0, 1]) < 0.1, "each step has an error of its own"


@pytest.mark.parametrize(("sensor", "left"), [(0.1, 0.0), (0.05, 0.5**0.5 * 0.1), (0.0, 0.1)])
def test_process_noise_is_reduced_by_the_sensors_share_of_the_learned_noise(
    model: Noisy, started, sensor: float, left: float
) -> None:
    settings, lanes = started(model, LANES, process_noise=True, sensor_noise=((speed_name(model), sensor),))
    after, _ = step(model, settings, lanes, np.zeros((LANES, 1)))
    still, _ = step(model, replace(settings, process_noise=False), lanes, np.zeros((LANES, 1)))
    moved = after.q - still.q
    assert float(moved[:, 1].std()) == pytest.approx(left, rel=0.1)
    assert float(moved[:, 0].sin().std()) == pytest.approx(0.1, rel=0.1), "the angle's noise is the process's"


def test_sensor_noise_for_an_unknown_coordinate_is_refused(model: Noisy) -> None:
    with pytest.raises(InvalidInput, match="sensor_noise: expected names of coordinates that change"):
        check(model.definition, (("height", 1.0),))
