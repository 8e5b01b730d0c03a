"""Occupancy (eq. 11) is a density: it integrates to one, knows that angles are periodic, and gives up no region."""

import math

import numpy as np
import pytest
import torch
from scipy.stats import norm, vonmises

from surrogym_server.sampling.occupancy import FLOOR, log_occupancy


def visited(angle: float, count: int = 50) -> torch.Tensor:
    """States near an angle, at speeds well inside the sampling range."""
    rng = np.random.default_rng(0)
    angles = (angle + 0.4 * rng.normal(size=count) + math.pi) % (2 * math.pi) - math.pi
    return torch.tensor(np.stack([angles, rng.uniform(-2, 3, count)], 1))


@pytest.mark.parametrize("angle", [0.0, math.pi])
def test_the_density_of_visited_states_integrates_to_one(definition, angle):
    side = (torch.arange(120, dtype=torch.float64) + 0.5) / 60 - 1
    grid = torch.cartesian_prod(math.pi * side, 8 * side)
    ratio = log_occupancy(definition, visited(angle), grid).exp()
    assert float(ratio.mean()) == pytest.approx(1, abs=1e-3)
    assert float(ratio.min()) >= FLOOR - 1e-12


def test_the_density_of_visited_states_equals_von_mises_and_normal_kernels(definition):
    states = torch.tensor([[3.0, -1.0], [-3.0, 1.0], [2.8, 0.5]], dtype=torch.float64)
    at = torch.tensor([[math.pi, 0.0], [1.0, 2.0]], dtype=torch.float64)
    h = 3 ** (-1 / 6)
    resultant = np.abs(np.mean(np.exp(1j * states[:, 0].numpy())))
    kappa = 1 / (h * math.sqrt(-2 * math.log(resultant))) ** 2
    width = h * states[:, 1].numpy().std()
    expected = []
    for angle, speed in at.tolist():
        kernels = [vonmises.pdf(angle, kappa, loc=a) * norm.pdf(speed, s, width) for a, s in states.tolist()]
        expected.append((1 - FLOOR) * np.mean(kernels) * 2 * math.pi * 16 + FLOOR)
    np.testing.assert_allclose(log_occupancy(definition, states, at).exp().numpy(), expected, rtol=1e-9)


def test_the_density_of_visited_states_is_periodic_in_angles(definition):
    q = torch.tensor([[math.pi - 0.05, 0.0], [0.05 - math.pi, 0.0]], dtype=torch.float64)
    states = torch.tensor([[math.pi - 0.3, 0.5], [0.3 - math.pi, -0.5]], dtype=torch.float64)
    near, across = log_occupancy(definition, states, q).tolist()
    assert near == pytest.approx(across)
    assert near > 0, "more likely than under the uniform density"


def test_the_density_far_from_all_visited_states_equals_its_floor(definition):
    far = log_occupancy(definition, visited(0.0), torch.tensor([[3.1, -8.0]], dtype=torch.float64))
    assert float(far) == pytest.approx(math.log(0.1), abs=1e-6)


def test_the_density_stays_finite_if_one_state_is_visited_repeatedly(definition):
    states = torch.tensor([[0.5, 1.0]], dtype=torch.float64).repeat(30, 1)
    at = torch.tensor([[0.5, 1.0], [-2.0, -5.0]], dtype=torch.float64)
    here, far = log_occupancy(definition, states, at).tolist()
    assert math.isfinite(here)
    assert here > far == pytest.approx(math.log(0.1))


def test_the_density_of_visited_states_does_not_depend_on_the_block_size(definition, monkeypatch):
    q = visited(1.0)
    whole = log_occupancy(definition, visited(0.0), q)
    monkeypatch.setattr("surrogym_server.sampling.occupancy.BLOCK", 7)
    torch.testing.assert_close(log_occupancy(definition, visited(0.0), q), whole)
