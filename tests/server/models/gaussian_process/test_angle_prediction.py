"""Where an angle turns to by itself is learned, offered to the speeds, and stored with the model."""

import math
from dataclasses import replace

import pytest
import torch

from support.models import learn
from support.real_steps import random_steps
from surrogym_sampler.original.classic import acrobot, cartpole
from surrogym_sampler.original.swingup import swing_up
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.features import FeatureMap, encode
from surrogym_server.environment.samples import Samples, increments
from surrogym_server.errors import InvalidInput
from surrogym_server.models.files import from_bytes, to_bytes
from surrogym_server.models.gaussian_process.feature_maps import candidates
from surrogym_server.models.gaussian_process.learning.angle_prediction import learn_drift


@pytest.fixture(scope="module")
def definition():
    return definition_from_spec(swing_up())


@pytest.fixture(scope="module")
def model(definition):
    return learn(definition, random_steps(swing_up(), 40, seed=0)).model


def test_the_learned_angle_drift_is_speed_times_step_duration(definition):
    ((x, velocity, angle, omega),) = learn_drift(definition, random_steps(swing_up(), 200, seed=0))
    assert omega == pytest.approx(0.1, rel=0.05)
    assert (abs(x) + abs(velocity) + abs(angle)) < 0.02


def test_the_angle_drift_is_learned_from_turns_of_more_than_half_a_circle(definition):
    samples = random_steps(swing_up(), 100, seed=0)
    fast = samples.q.clone()
    fast[:, 3] *= 1.5
    angle = fast[:, 2] + 0.25 * fast[:, 3]
    moved = fast.clone()
    moved[:, 2] = torch.atan2(angle.sin(), angle.cos())
    assert (0.25 * fast[:, 3]).abs().max() > math.pi
    ((*_, omega),) = learn_drift(definition, Samples(fast, samples.u, moved, samples.reward, samples.terminated))
    assert omega == pytest.approx(0.25, rel=1e-6)


def test_no_angle_drift_is_learned_without_angles_or_with_too_few_samples(definition):
    assert learn_drift(definition_from_spec(cartpole()), random_steps(cartpole(), 40, seed=0)) == ()
    assert learn_drift(definition, random_steps(swing_up(), 11, seed=0)) == ()


def test_cosine_and_sine_of_the_predicted_next_angle_can_be_model_inputs():
    definition = definition_from_spec(acrobot())
    drift = ((0.0, 0.0, 0.2, 0.0), (0.0, 0.0, 0.0, 0.3))
    q, u = torch.tensor([[0.5, -1.0, 2.0, -3.0]], dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64)
    plain, drifted = (encode(definition, m, q, u)[0].tolist() for m in (FeatureMap(), FeatureMap(drift=drift)))
    turned = [math.cos(0.9), math.sin(0.9), math.cos(-1.9), math.sin(-1.9)]
    assert sorted(drifted) == pytest.approx(sorted(plain + turned))
    assert FeatureMap(drift=drift) in candidates(definition, follows=False, drift=drift)


def test_the_predicted_next_angle_is_selected_as_input_for_a_fast_pole_and_lowers_the_error(definition, model):
    omega = model.transitions[3]
    assert omega.feature_map.drift
    test = random_steps(swing_up(), 300, seed=1)
    error = (model.means(test.q, test.u)[:, :4] - increments(definition, test)).square().mean(0).sqrt()
    assert error[3] / omega.scale < 0.3  # 0.36 without


def test_a_stored_model_keeps_whether_the_predicted_next_angle_is_an_input(definition, model):
    loaded = from_bytes(definition, to_bytes(model))
    assert loaded.transitions[3].feature_map == model.transitions[3].feature_map


@pytest.mark.parametrize("drift", [((0.1, 0.1),), ((0.0, 0.0, 0.0, math.inf),), ((0.0,) * 4,) * 2])
def test_a_stored_angle_drift_of_wrong_shape_is_refused(definition, model, drift):
    changed = [
        replace(o, feature_map=replace(o.feature_map, drift=drift)) if o.feature_map.drift else o
        for o in model.transitions
    ]
    data = to_bytes(replace(model, transitions=tuple(changed)))
    with pytest.raises(InvalidInput, match="expected the drift as"):
        from_bytes(definition, data)
