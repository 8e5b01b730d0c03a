"""Where an output is in doubt is said by one range of one input, if there is one."""

import pytest
import torch

from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.points import Points
from surrogym_server.sampling.regions import regions_of

DEFINITION = definition_from_spec(pendulum())
GENERATOR = torch.Generator().manual_seed(0)
POINTS = Points(
    torch.rand(2_000, 2, generator=GENERATOR, dtype=torch.float64) * torch.tensor([6.28, 16.0])
    - torch.tensor([3.14, 8]),
    torch.rand(2_000, 1, generator=GENERATOR, dtype=torch.float64) * 4 - 2,
)
SPEED, TORQUE = POINTS.q[:, 1], POINTS.u[:, 0]


def region(doubtful: torch.Tensor):
    (found,) = regions_of(DEFINITION, POINTS, doubtful.double()[:, None])
    return found


@pytest.mark.parametrize(
    ("doubtful", "name", "low", "high", "outside"),
    [
        (SPEED > 5, "speed", 5, None, False),
        (SPEED < -6, "speed", None, -6, False),
        ((SPEED > -1) & (SPEED < 2), "speed", -1, 2, False),
        (SPEED.abs() > 6, "speed", -6, 6, True),
        (TORQUE > 1.5, "action", 1.5, None, False),
    ],
    ids=["above", "below", "between", "on both sides", "of an action"],
)
def test_the_input_range_of_uncertain_predictions_is_found(doubtful, name, low, high, outside):
    found = region(doubtful)
    assert (found.input, found.outside) == (name, outside)
    assert found.share == pytest.approx(1.0)
    for end, expected in ((found.low, low), (found.high, high)):
        assert end == (None if expected is None else pytest.approx(expected, abs=0.05))


def test_slight_uncertainty_elsewhere_does_not_change_the_uncertain_range():
    found = region((SPEED > 5).double() + 0.02)
    assert found.low == pytest.approx(5, abs=0.05)
    assert 0.85 < found.share < 0.95


@pytest.mark.parametrize("doubt", [torch.zeros(2_000), torch.ones(2_000), torch.rand(2_000, generator=GENERATOR)])
def test_no_uncertain_range_is_reported_if_nothing_or_everything_is_uncertain(doubt):
    assert region(doubt) is None


def test_equal_input_values_are_not_split_by_an_uncertain_range():
    steps = Points(POINTS.q, POINTS.u.round())
    (found,) = regions_of(DEFINITION, steps, (steps.u > 0.5).double())
    assert (found.input, found.low) == ("action", 0.5)
