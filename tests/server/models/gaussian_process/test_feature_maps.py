"""Which feature maps are compared, and the mirror image of each."""

import pytest
import torch

from support.real_steps import random_steps
from surrogym_sampler.original.classic import acrobot, cartpole, pendulum
from surrogym_sampler.original.mujoco_tasks import reacher
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.features import FeatureMap, encode, leading
from surrogym_server.models.gaussian_process.feature_maps import candidates, reflection, reward_candidates
from surrogym_server.models.gaussian_process.learning.angle_prediction import learn_drift
from surrogym_shared.spec import Design


def test_each_environment_has_its_expected_candidate_feature_maps(pendulum_definition, cartpole_definition):
    assert len(candidates(pendulum_definition, follows=True)) == 10
    assert len(candidates(pendulum_definition, follows=False)) == 4
    assert candidates(cartpole_definition, follows=True) == (FeatureMap(), FeatureMap(parity="odd"))
    three_actions = candidates(definition_from_spec(acrobot()), follows=False)
    assert {(m.action, m.parity) for m in three_actions} == {("value", ""), ("value", "odd"), ("one_hot", "")}
    paper = definition_from_spec(pendulum().model_copy(update={"design": Design(preset="paper")}))
    assert candidates(paper, follows=True) == (FeatureMap("observation"),)


@pytest.mark.parametrize("task", [pendulum, cartpole, acrobot])
def test_mirroring_the_input_features_equals_encoding_the_negated_state_and_action(task):
    definition = definition_from_spec(task())
    rng = torch.Generator().manual_seed(0)
    q = torch.randn(6, len(definition.coordinates), generator=rng, dtype=torch.float64)
    lead = torch.randn(6, len(leading(definition)), generator=rng, dtype=torch.float64)
    limits = definition.action.nvec[0] - 1 if definition.action.nvec else 0
    u = torch.randint(0, 2, (6, 1), generator=rng).double()
    drift = learn_drift(definition, random_steps(task(), 20, seed=0))
    maps = candidates(definition, follows=True, drift=drift, parity="even")
    mirrored = [m for m in maps if m.parity]
    assert {m.state for m in mirrored} == {m.state for m in maps} >= {"cos_sin"}
    for feature_map in mirrored:
        found = reflection(definition, feature_map)
        assert found.parity == 1
        x = encode(definition, feature_map, q, u, lead)
        torch.testing.assert_close(encode(definition, feature_map, -q, limits - u, -lead), x * found.signs)


def test_no_mirror_symmetry_is_tried_with_uncentred_ranges_observation_inputs_or_one_hot_actions(
    pendulum_definition, mountain_car_definition
):
    """A range that is not centred at 0 has none, nor a one-hot action, nor an observation."""
    assert not any(m.parity for m in candidates(mountain_car_definition, follows=False))
    assert reflection(pendulum_definition, FeatureMap()) is None
    assert reflection(pendulum_definition, FeatureMap("observation", parity="odd")) is None
    assert reflection(definition_from_spec(acrobot()), FeatureMap(action="one_hot", parity="odd")) is None


def test_observations_that_combine_coordinates_are_candidate_inputs_of_the_reward_only():
    """The way from a fingertip to its target says in two inputs what joints and target say in six."""
    combines, plain = definition_from_spec(reacher()), definition_from_spec(pendulum())
    assert FeatureMap("observation", after=True) in reward_candidates(combines)
    assert all(m.state != "observation" for m in reward_candidates(plain))
    assert all(m.state != "observation" for m in candidates(combines, follows=False))
