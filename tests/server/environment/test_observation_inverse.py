"""Reading coordinates back from an observation, and refusing where it does not determine them."""

import math

import pytest
import torch

from surrogym_sampler.original.classic import acrobot, cartpole_of_the_paper, pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.observation_inverse import ObservationInverse
from surrogym_server.errors import InvalidSpec
from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    Design,
    EnvironmentSpec,
    Fixed,
    ObservationEntry,
    Term,
    Uniform,
)

PAPER = Design(preset="paper")


@pytest.mark.parametrize("task", [pendulum, cartpole_of_the_paper, acrobot])
def test_coordinates_are_recovered_from_their_observation(task):
    definition = definition_from_spec(task().model_copy(update={"design": PAPER}))
    q = torch.rand(20, len(definition.coordinates), generator=torch.manual_seed(0), dtype=torch.float64) * 3 - 1.5
    recovered = ObservationInverse.of(definition)(definition.observe(q), torch.zeros_like(q))
    torch.testing.assert_close(recovered, q, rtol=0, atol=1e-12)


def test_an_angle_is_recovered_from_a_cosine_and_sine_off_the_unit_circle():
    inverse = ObservationInverse.of(definition_from_spec(pendulum()))
    o = torch.tensor([[0.3, 0.3, 1.0], [-2.0, 0.0, 1.0]], dtype=torch.float64)
    angles = inverse(o, torch.zeros(2, 2, dtype=torch.float64))[:, 0]
    torch.testing.assert_close(angles, torch.tensor([math.pi / 4, math.pi], dtype=torch.float64))


def reacher(*observed: ObservationEntry) -> EnvironmentSpec:
    circle = Uniform(low=-math.pi, high=math.pi)
    return EnvironmentSpec(
        coordinates=(
            Coordinate(name="joint", kind="angle", sampling=circle),
            Coordinate(name="target", kind="constant", sampling=Uniform(low=0, high=1)),
        ),
        observation=observed,
        action=BoxAction(low=(-1.0,), high=(1.0,)),
        start={"joint": circle, "target": Fixed(value=0.5)},
        design=PAPER,
    )


def test_an_observation_clipped_beyond_its_range_can_be_inverted():
    clipped = ObservationEntry(name="o", term=Term.linear(joint=1).clipped(-4, 4))
    inverse = ObservationInverse.of(definition_from_spec(reacher(clipped)))
    assert inverse.sources == ((0, (0,)),)


def test_constant_coordinates_keep_their_value_and_need_not_be_observed():
    observed = (
        ObservationEntry(name="sin", term=Term.sin(joint=1)),
        ObservationEntry(name="cos", term=Term.cos(joint=1)),
    )
    inverse = ObservationInverse.of(definition_from_spec(reacher(*observed)))
    o, q = torch.tensor([[1.0, 0.0]], dtype=torch.float64), torch.tensor([[0.0, 0.7]], dtype=torch.float64)
    torch.testing.assert_close(inverse(o, q), torch.tensor([[math.pi / 2, 0.7]], dtype=torch.float64))


@pytest.mark.parametrize(
    "term",
    [Term.cos(joint=1), 2 * Term.linear(joint=1), Term.linear(joint=1, target=1), Term.linear(joint=1).clipped(-1, 1)],
    ids=["cosine alone", "scaled", "mixed", "clipped"],
)
def test_an_observation_that_does_not_determine_a_coordinate_is_refused(term):
    with pytest.raises(InvalidSpec, match="'joint' can't be computed"):
        definition_from_spec(reacher(ObservationEntry(name="o", term=term)))
