"""Declared limits at which many samples end."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from support.exact_models import exact_pendulum
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.sampling.limits import MANY, reached_limits
from surrogym_shared.spec import Bounds


@pytest.fixture
def definition() -> EnvironmentDefinition:
    """The second coordinate is limited to -8 and 8."""
    whole = exact_pendulum().definition
    first, speed = whole.coordinates
    return replace(whole, coordinates=(first, speed.model_copy(update={"bounds": Bounds(low=-8.0, high=8.0)})))


def samples(*speeds: float) -> Samples:
    after = torch.tensor([[0.0, speed] for speed in speeds], dtype=torch.float64)
    count = len(after)
    return Samples(after * 0, torch.zeros(count, 1), after, torch.zeros(count), torch.zeros(count, dtype=torch.bool))


def test_coordinate_limits_reached_by_many_samples_are_listed_most_frequent_first(
    definition: EnvironmentDefinition,
) -> None:
    found = reached_limits(definition, samples(8, 8, 8, -8, -8, 0, 1, 2))
    assert [(one.coordinate, one.side, one.value, one.share) for one in found] == [
        (definition.coordinates[1].name, "upper", 8.0, 0.375),
        (definition.coordinates[1].name, "lower", -8.0, 0.25),
    ]


def test_a_limit_reached_by_few_samples_is_not_reported(definition: EnvironmentDefinition) -> None:
    assert MANY > 0.1
    assert reached_limits(definition, samples(8, *[0.0] * 9)) == reached_limits(definition, samples()) == ()


def test_a_coordinate_without_limits_is_never_reported_at_a_limit() -> None:
    whole = exact_pendulum().definition
    free = tuple(one.model_copy(update={"bounds": None}) for one in whole.coordinates)
    assert reached_limits(replace(whole, coordinates=free), samples(1e9, -1e9)) == ()
