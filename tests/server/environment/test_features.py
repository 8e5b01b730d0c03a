"""What the processes are shown: encodings of angles, actions, the lead and the paper's observation."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from surrogym_sampler.original.classic import acrobot, mountain_car_continuous, pendulum
from surrogym_sampler.original.mujoco_tasks import reacher
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.distributions import quantiles
from surrogym_server.environment.features import Encoder, FeatureMap, encode, leading
from surrogym_server.models.gaussian_process.feature_maps import candidates
from surrogym_shared.spec import Design, DiscreteAction, MultiDiscreteAction


def row(*values: float) -> torch.Tensor:
    return torch.tensor([values], dtype=torch.float64)


def assert_features(made: torch.Tensor, *expected: float) -> None:
    torch.testing.assert_close(made, row(*expected), rtol=1e-12, atol=1e-12)


def test_pendulum_features_are_scaled_angle_speed_and_torque(pendulum_definition):
    q, u = row(2.0, 4.0), row(1.0)
    speed, torque, angle = 4 / (16 / math.sqrt(12)), 1 * math.sqrt(12) / 4, 2 * math.sqrt(3) / math.pi
    for state, expected in (
        ("cos_sin", [math.cos(2), math.sin(2), speed, torque]),
        ("wrapped", [angle, speed, torque]),
        ("both", [math.cos(2), math.sin(2), angle, speed, torque]),
    ):
        assert_features(encode(pendulum_definition, FeatureMap(state), q, u), *expected)


def test_with_preset_paper_the_features_are_the_observation():
    paper = definition_from_spec(pendulum().model_copy(update={"design": Design(preset="paper")}))
    made = encode(paper, FeatureMap("observation"), row(2.0, 4.0), row(1.0))
    assert_features(made, math.cos(2), math.sin(2), 4.0, math.sqrt(12) / 4)


def test_the_predicted_next_speed_can_be_an_additional_input(pendulum_definition):
    made = encode(pendulum_definition, FeatureMap("wrapped", lead=True), row(0, 0), row(0), row(8.0))
    assert_features(made, 0, 0, 0, math.sqrt(3))


def test_turning_an_angle_by_a_full_turn_changes_no_feature(pendulum_definition):
    for state in ("cos_sin", "wrapped", "both"):
        near, far = (encode(pendulum_definition, FeatureMap(state), row(a, 1), row(1)) for a in (1, 1 + 2 * math.pi))
        torch.testing.assert_close(near, far)


@pytest.mark.parametrize("count", [2, 3, 7])
def test_discrete_actions_as_values_have_mean_zero_and_deviation_one(pendulum_definition, count):
    definition = replace(pendulum_definition, action=DiscreteAction(n=count))
    u = torch.arange(count, dtype=torch.float64)[:, None]
    column = encode(definition, FeatureMap(), torch.zeros(count, 2, dtype=torch.float64), u)[:, -1]
    assert float(column.mean()) == pytest.approx(0, abs=1e-12)
    assert float(column.std(correction=0)) == pytest.approx(1)


def test_discrete_actions_can_be_encoded_one_hot(pendulum_definition):
    definition = replace(pendulum_definition, action=MultiDiscreteAction(nvec=(3, 2)))
    made = encode(definition, FeatureMap("wrapped", "one_hot"), row(0, 0), row(2, 1))
    assert_features(made, 0, 0, 0, 0, 1, 1)


def test_next_speeds_are_offered_as_inputs_only_for_speeds_with_limits():
    assert leading(definition_from_spec(pendulum())) == (1,)
    assert leading(definition_from_spec(mountain_car_continuous())) == (1,)
    assert leading(definition_from_spec(acrobot())) == (2, 3)


@pytest.mark.parametrize("task", [pendulum, acrobot, mountain_car_continuous])
def test_encoding_several_feature_maps_at_once_equals_encoding_each_alone(task):
    definition = definition_from_spec(task())
    maps = candidates(definition, follows=True)
    rng = torch.Generator().manual_seed(0)
    q = torch.randn(6, len(definition.coordinates), generator=rng, dtype=torch.float64)
    u = torch.randint(0, 2, (6, definition.action.size), generator=rng).double()
    lead = torch.randn(6, len(leading(definition)), generator=rng, dtype=torch.float64)
    encoder = Encoder.of(definition, maps)
    x = encoder(q, u)
    every = encoder.with_lead(x, lead)
    assert (x.shape[1], every.shape[1]) == (encoder.width(False), encoder.width(True))
    assert len(every.T.unique(dim=0)) == every.shape[1], "no feature is computed twice"
    for feature_map in maps:
        columns = list(encoder.inputs(feature_map))
        assert torch.equal(every[:, columns], encode(definition, feature_map, q, u, lead))


def test_an_observation_is_standardised_over_the_sampling_range():
    definition = definition_from_spec(reacher())
    p = torch.from_numpy(np.random.default_rng(1).uniform(size=(2_000, 6)))
    q = quantiles([c.sampling for c in definition.coordinates], p)
    made = encode(definition, FeatureMap("observation"), q, torch.zeros(2_000, 2, dtype=torch.float64))[:, :10]
    torch.testing.assert_close(made.mean(0), torch.zeros(10, dtype=torch.float64), atol=0.1, rtol=0)
    torch.testing.assert_close(made.std(0), torch.ones(10, dtype=torch.float64), atol=0.1, rtol=0)
