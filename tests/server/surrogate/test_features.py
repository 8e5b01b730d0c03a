"""What the processes are shown: encodings of angles, actions, the lead and the paper's observation."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.real_steps import random_steps
from surrogym_client.original.classic import acrobot, cartpole, mountain_car_continuous, pendulum
from surrogym_client.original.mujoco_tasks import reacher
from surrogym_server.convert import definition_from_spec
from surrogym_server.surrogate.definition import ActionDefinition
from surrogym_server.surrogate.drift import drift_of
from surrogym_server.surrogate.features import (
    Encoder,
    FeatureMap,
    candidates,
    encode,
    leading,
    reflection,
    reward_candidates,
)
from surrogym_shared.spec import Design


def row(*values: float) -> torch.Tensor:
    return torch.tensor([values], dtype=torch.float64)


def assert_features(made: torch.Tensor, *expected: float) -> None:
    torch.testing.assert_close(made, row(*expected), rtol=1e-12, atol=1e-12)


def test_angles_speeds_and_torque_of_the_pendulum(pendulum_definition):
    q, u = row(2.0, 4.0), row(1.0)
    speed, torque, angle = 4 / (16 / math.sqrt(12)), 1 * math.sqrt(12) / 4, 2 * math.sqrt(3) / math.pi
    for state, expected in (
        ("cos_sin", [math.cos(2), math.sin(2), speed, torque]),
        ("wrapped", [angle, speed, torque]),
        ("both", [math.cos(2), math.sin(2), angle, speed, torque]),
    ):
        assert_features(encode(pendulum_definition, FeatureMap(state), q, u), *expected)


def test_the_papers_observation_is_shown_as_it_is():
    paper = definition_from_spec(pendulum().model_copy(update={"design": Design(preset="paper")}))
    made = encode(paper, FeatureMap("observation"), row(2.0, 4.0), row(1.0))
    assert_features(made, math.cos(2), math.sin(2), 4.0, math.sqrt(12) / 4)


def test_the_lead_is_one_more_input(pendulum_definition):
    made = encode(pendulum_definition, FeatureMap("wrapped", lead=True), row(0, 0), row(0), row(8.0))
    assert_features(made, 0, 0, 0, math.sqrt(3))


def test_a_full_turn_changes_no_feature(pendulum_definition):
    for state in ("cos_sin", "wrapped", "both"):
        near, far = (encode(pendulum_definition, FeatureMap(state), row(a, 1), row(1)) for a in (1, 1 + 2 * math.pi))
        torch.testing.assert_close(near, far)


@pytest.mark.parametrize("count", [2, 3, 7])
def test_discrete_actions_as_values_have_mean_zero_and_deviation_one(pendulum_definition, count):
    definition = replace(pendulum_definition, action=ActionDefinition("discrete", nvec=(count,)))
    u = torch.arange(count, dtype=torch.float64)[:, None]
    column = encode(definition, FeatureMap(), torch.zeros(count, 2, dtype=torch.float64), u)[:, -1]
    assert float(column.mean()) == pytest.approx(0, abs=1e-12)
    assert float(column.std(correction=0)) == pytest.approx(1)


def test_one_hot_actions(pendulum_definition):
    definition = replace(pendulum_definition, action=ActionDefinition("multi_discrete", nvec=(3, 2)))
    made = encode(definition, FeatureMap("wrapped", "one_hot"), row(0, 0), row(2, 1))
    assert_features(made, 0, 0, 0, 0, 1, 1)


def test_limited_speeds_lead_and_walls_do_not():
    assert leading(definition_from_spec(pendulum())) == (1,)
    assert leading(definition_from_spec(mountain_car_continuous())) == (1,)
    assert leading(definition_from_spec(acrobot())) == (2, 3)


def test_which_maps_are_compared(pendulum_definition, cartpole_definition):
    assert len(candidates(pendulum_definition, follows=True)) == 14
    assert len(candidates(pendulum_definition, follows=False)) == 6
    assert candidates(cartpole_definition, follows=True) == (FeatureMap(), FeatureMap(parity="odd"))
    three_actions = candidates(definition_from_spec(acrobot()), follows=False)
    assert {(m.action, m.parity) for m in three_actions} == {("value", ""), ("value", "odd"), ("one_hot", "")}
    paper = definition_from_spec(pendulum().model_copy(update={"design": Design(preset="paper")}))
    assert candidates(paper, follows=True) == (FeatureMap("observation"),)


@pytest.mark.parametrize("task", [pendulum, cartpole, acrobot])
def test_a_reflection_is_what_features_do_when_all_signs_change(task):
    definition = definition_from_spec(task())
    rng = torch.Generator().manual_seed(0)
    q = torch.randn(6, len(definition.coordinates), generator=rng, dtype=torch.float64)
    lead = torch.randn(6, len(leading(definition)), generator=rng, dtype=torch.float64)
    limits = definition.action.nvec[0] - 1 if definition.action.nvec else 0
    u = torch.randint(0, 2, (6, 1), generator=rng).double()
    drift = drift_of(definition, random_steps(task(), 20, seed=0))
    maps = candidates(definition, follows=True, drift=drift, parity="even")
    mirrored = [m for m in maps if m.parity]
    assert {m.state for m in mirrored} == {m.state for m in maps} >= {"cos_sin"}
    for feature_map in mirrored:
        found = reflection(definition, feature_map)
        assert found.parity == 1
        x = encode(definition, feature_map, q, u, lead)
        torch.testing.assert_close(encode(definition, feature_map, -q, limits - u, -lead), x * found.signs)


def test_what_has_no_mirror_image(pendulum_definition, mountain_car_definition):
    """A range that is not centred at 0 has none, nor a one-hot action, nor an observation."""
    assert not any(m.parity for m in candidates(mountain_car_definition, follows=False))
    assert reflection(pendulum_definition, FeatureMap()) is None
    assert reflection(pendulum_definition, FeatureMap("observation", parity="odd")) is None
    assert reflection(definition_from_spec(acrobot()), FeatureMap(action="one_hot", parity="odd")) is None


@pytest.mark.parametrize("task", [pendulum, acrobot, mountain_car_continuous])
def test_features_of_several_maps_at_once_are_those_of_each(task):
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


def test_a_reward_may_read_an_observation_that_combines_coordinates():
    """The way from a fingertip to its target says in two inputs what joints and target say in six."""
    combines, plain = definition_from_spec(reacher()), definition_from_spec(pendulum())
    assert FeatureMap("observation", after=True) in reward_candidates(combines)
    assert all(m.state != "observation" for m in reward_candidates(plain))
    assert all(m.state != "observation" for m in candidates(combines, follows=False))


def test_an_observation_is_standardised_over_the_sampling_range():
    definition = definition_from_spec(reacher())
    p = torch.from_numpy(np.random.default_rng(1).uniform(size=(2_000, 6)))
    q = torch.stack([c.sampling.quantile(p[:, i]) for i, c in enumerate(definition.coordinates)], -1)
    made = encode(definition, FeatureMap("observation"), q, torch.zeros(2_000, 2, dtype=torch.float64))[:, :10]
    torch.testing.assert_close(made.mean(0), torch.zeros(10, dtype=torch.float64), atol=0.1, rtol=0)
    torch.testing.assert_close(made.std(0), torch.ones(10, dtype=torch.float64), atol=0.1, rtol=0)
