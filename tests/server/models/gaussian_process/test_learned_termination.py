"""Learned termination: found from samples that ended, stored and served as any other part of a model."""

import json
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load

from support.models import header_of, learn
from support.real_steps import random_steps
from surrogym_sampler.original.classic import acrobot, cartpole
from surrogym_server.convert import definition_from_spec
from surrogym_server.errors import InvalidInput
from surrogym_server.models.files import from_bytes, to_bytes, with_checksum
from surrogym_server.models.gaussian_process.learning.output_learner import OutputLearner
from surrogym_server.models.gaussian_process.learning.region import learn_termination
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.regions import Classifier, Thresholds
from surrogym_server.models.gaussian_process.settings import Settings
from surrogym_server.sampling.endings import unexplored
from surrogym_server.virtual.single_step import predict_points
from surrogym_shared.spec import EnvironmentSpec

CARTPOLE = cartpole().model_copy(update={"termination": "learned"})
ACROBOT = acrobot().model_copy(update={"termination": "learned"})


def learned_from(spec: EnvironmentSpec, count: int, seed: int = 1) -> GaussianProcessModel:
    return learn(definition_from_spec(spec), random_steps(spec, count, seed)).model


@pytest.fixture(scope="module")
def model() -> GaussianProcessModel:
    return learned_from(CARTPOLE, 60, seed=0)


def test_the_learned_termination_of_cart_pole_depends_on_the_pole_angle(model):
    _, form = max(model.ending.forms, key=lambda pair: pair[0])
    assert isinstance(form, Thresholds)
    assert any("pole" in cut["rule"] for rule in form.description["rules"] for cut in rule)
    unseen = random_steps(CARTPOLE, 500, seed=20_000)
    wrong = (model.terminated(unseen.q_next) != unseen.terminated).double().mean()
    assert float(wrong) < 0.5 * float(unseen.terminated.double().mean())
    assert float((model.termination_probability(unseen.q_next) > 0.5).double().mean()) > 0


def test_a_classifier_is_learned_if_no_threshold_separates_terminal_states():
    spec, steps = ACROBOT, random_steps(ACROBOT, 150, seed=1)
    region = learn_termination(OutputLearner(definition_from_spec(spec), Settings(), {}, {}), steps)
    assert isinstance(region.forms[0][1], Classifier)
    unseen = random_steps(ACROBOT, 500, seed=20_000)
    wrong = ((region.probability(unseen.q_next) > 0.5) != unseen.terminated).double().mean()
    assert float(wrong) < 0.4 * float(unseen.terminated.double().mean())


def test_without_terminated_samples_no_state_is_predicted_terminal(model):
    definition = model.definition
    steps = random_steps(CARTPOLE, 12, seed=0)
    going = learn(definition, replace(steps, terminated=torch.zeros_like(steps.terminated))).model
    assert not bool(going.terminated(10 * steps.q).any())
    always = learn(definition, replace(steps, terminated=torch.ones_like(steps.terminated))).model
    assert bool(always.terminated(steps.q).all())


def test_states_outside_the_range_of_the_samples_count_as_unexplored(model):
    seen = torch.tensor([[0.0, 0, 0, 0], [1, 1, 1, 1]], dtype=torch.float64)
    at = torch.tensor([[0.5, 0.5, 0.5, 0.5], [1.25, 0.5, 0.5, 0.5], [-0.5, 1.5, 0.5, 9]], dtype=torch.float64)
    assert unexplored(model.definition, seen, at).tolist() == [0, 0.25, 2]
    assert unexplored(model.definition, seen[:0], at).tolist() == [1, 1, 1]


def test_the_predictions_for_requested_points_use_the_learned_termination(model):
    q = torch.tensor([[0, 0, 0.2, 3.0], [0, 0, 0, 0]], dtype=torch.float64)
    assert predict_points(model, q.numpy(), torch.ones(2, 1).double().numpy()).terminated.tolist() == [True, False]


@pytest.mark.parametrize(("spec", "count"), [(CARTPOLE, 60), (ACROBOT, 25)])
def test_a_learned_termination_survives_storage_bit_equal(spec, count):
    model = learned_from(spec, count)
    loaded = from_bytes(model.definition, to_bytes(model))
    q = random_steps(spec, 50, seed=3).q_next
    assert torch.equal(loaded.termination_probability(q), model.termination_probability(q))
    assert loaded.description == model.description
    json.dumps(loaded.description, allow_nan=False)


def test_loading_a_model_whose_termination_kind_differs_from_the_specification_is_refused(model, cartpole_model):
    with pytest.raises(InvalidInput, match="termination is declared, got one whose termination is learned"):
        from_bytes(cartpole_model.definition, to_bytes(model))
    with pytest.raises(InvalidInput, match="termination is learned, got one whose termination is declared"):
        from_bytes(model.definition, to_bytes(cartpole_model))


@pytest.mark.parametrize(
    "rules",
    [
        [],
        [[]],
        [[[99, 0.1, 0.2, 1.0]]],
        [[[-1, 0.1, 0.2, 1.0]]],
        [[[0, 0.2, 0.1, 1.0]]],
        [[[0, 0.1, float("nan"), 1.0]]],
        [[[float("inf"), 0.1, 0.2, 1.0]]],
        [[[0, 0.1, 0.2, 2.0]]],
        [[[0, 0.1, 0.2]]],
        [[["__import__('os')", 0.1, 0.2, 1.0]]],
    ],
)
def test_a_stored_model_with_invalid_termination_thresholds_is_refused(model, rules):
    data = to_bytes(model)
    header = header_of(data)
    header["termination"]["forms"] = [[1.0, {"rules": rules, "complement": False}]]
    with pytest.raises(InvalidInput):
        from_bytes(model.definition, with_checksum(header, load(data)))


@pytest.mark.parametrize("weight", [0.0, 0.5, -1.0, float("nan")])
def test_stored_termination_weights_that_do_not_sum_to_one_are_refused(model, weight):
    bad = replace(model, ending=replace(model.ending, forms=((weight, model.ending.forms[0][1]),)))
    with pytest.raises(InvalidInput, match="weights"):
        from_bytes(model.definition, to_bytes(bad))
