"""Outputs that leave out the inputs that they do not read: chosen by evidence, and the same in every computation."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from support.models import gaussian_processes
from support.predictions import WAYS, check_compiled, check_processes
from support.real_steps import random_steps
from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.features import FeatureMap, features
from surrogym_server.environment.samples import Samples
from surrogym_server.errors import InvalidInput
from surrogym_server.gp import Hyperparameters, condition
from surrogym_server.models.files import from_bytes, to_bytes
from surrogym_server.models.gaussian_process.codec.outputs import require_output
from surrogym_server.models.gaussian_process.learning import dropping
from surrogym_server.models.gaussian_process.learning.output_learner import OutputLearner
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.settings import Settings
from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Term, Uniform

NAMES = tuple("abcdefghij")


def spec(high: float = 1.0, **model: object) -> EnvironmentSpec:
    """Ten tanks in a row, of which each gets what the one before it loses."""
    ranges = {name: Uniform(low=-1, high=high) for name in NAMES}
    made = EnvironmentSpec(
        coordinates=tuple(Coordinate(name=n, sampling=r) for n, r in ranges.items()),
        observation=tuple(ObservationEntry(name=n, term=Term.linear(**{n: 1})) for n in NAMES),
        action=BoxAction(low=(-1,), high=(1,)),
        start=ranges,
        time_limit=50,
    )
    design = made.design.model_validate({"model": {"name": "gaussian_process", "settings": model}})
    return made.model_copy(update={"design": design})


ROW = definition_from_spec(spec(high=1.5))  # a range that is not centred: no mirror image
ALONE = definition_from_spec(spec(high=1.5, repeated_parts=False))


def steps(count: int, seed: int, high: float = 1.5) -> Samples:
    p = torch.rand(count, 11, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    q, u = (1 + high) * p[:, :10] - 1, 2 * p[:, 10:] - 1
    flow = 0.1 * (q + q**3)
    gained = torch.cat([0.3 * u, flow[:, :-1]], 1)
    reward = -((q[:, 9] - 0.5) ** 2)
    return Samples(q, u, q + gained - flow, reward, torch.zeros(count, dtype=torch.bool))


def error(model: GaussianProcessModel, test: Samples) -> float:
    return float((model.transition(test.q, test.u).q_next - test.q_next).square().mean().sqrt())


def read(model: GaussianProcessModel, column: int) -> set[int]:
    """The entries of [q, u] that an output reads."""
    return {feature.entry for feature in features(model.definition, model.outputs[column].feature_map)}


@pytest.fixture(scope="module")
def model() -> GaussianProcessModel:
    return gaussian_processes(ROW, steps(40, 0))


@pytest.fixture(scope="module")
def points() -> tuple[Tensor, Tensor]:
    test = steps(50, 7)
    return test.q, test.u


def test_each_output_keeps_only_the_inputs_its_next_value_depends_on(model):
    for column in range(1, 10):
        assert read(model, column) == {column - 1, column}
    assert "without" in model.structures[1]
    assert any("without" in name for name, _ in model.transitions[1].scores)


def test_predictions_are_better_without_irrelevant_inputs(model):
    whole = gaussian_processes(definition_from_spec(spec(high=1.5, drop_inputs=False)), steps(40, 0))
    assert not any(output.feature_map.dropped for output in whole.outputs)
    assert error(model, steps(400, 9)) < 0.1 * error(whole, steps(400, 9))


def test_errors_of_a_model_with_dropped_inputs_are_within_its_deviations(model):
    test = steps(400, 9)
    moved = model.transition(test.q, test.u, stds=True)
    within = (moved.q_next - test.q_next).abs() <= 1.645 * moved.std + 1e-3
    assert float(within.double().mean()) > 0.85


def test_preset_paper_drops_no_inputs():
    paper = spec().model_copy(update={"design": spec().design.model_validate({"preset": "paper"})})
    learned = gaussian_processes(definition_from_spec(paper), steps(20, 0))
    assert not any(output.feature_map.dropped for output in learned.outputs)


def test_a_model_with_dropped_inputs_predicts_the_posteriors_of_its_gaussian_processes(model, points):
    check_processes(model, points)


@pytest.mark.parametrize("how", WAYS)
def test_compiled_steps_with_dropped_inputs_equal_the_model(model, points, how):
    check_compiled(model, points, how)


def test_drawn_functions_with_uncertain_hyperparameters_ignore_dropped_inputs(model, points):
    functions = model.uncertain_functions
    noise = torch.randn(50, functions.path_size, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    q, u = points[0].clone(), points[1].clone()
    paths = functions.draw(noise)
    before = functions.transition_along(paths, q, u).q_next[:, 3]
    q[:, 0], u[:] = 0.9, -0.9  # neither is read by the fourth tank
    torch.testing.assert_close(functions.transition_along(paths, q, u).q_next[:, 3], before)


def test_a_stored_model_keeps_which_inputs_each_output_drops(model, points):
    loaded = from_bytes(ROW, to_bytes(model))
    assert isinstance(loaded, GaussianProcessModel)
    assert [o.feature_map for o in loaded.outputs] == [o.feature_map for o in model.outputs]
    torch.testing.assert_close(loaded.transition(*points).q_next, model.transition(*points).q_next, rtol=0, atol=0)


@pytest.mark.parametrize("dropped", [(11,), (-1, 2), (2, 1), (1, 1), tuple(range(11))])
def test_a_malformed_list_of_dropped_inputs_is_refused(model, dropped):
    output = model.transitions[1]
    wrong = replace(output, feature_map=replace(output.feature_map, dropped=dropped))
    with pytest.raises(InvalidInput, match="`dropped`"):
        require_output(ROW, wrong)


def test_odd_processes_drop_irrelevant_inputs_too():
    model = gaussian_processes(definition_from_spec(spec()), steps(24, 0, high=1.0))
    assert model.transitions[1].feature_map.parity == "odd"
    assert read(model, 1) == {0, 1}


def test_inputs_dropped_by_a_subset_must_be_irrelevant_for_all_samples(monkeypatch):
    monkeypatch.setattr("surrogym_server.gp.subsets.FEW", 36)
    samples = steps(44, 0)
    model = gaussian_processes(ALONE, samples)
    assert read(model, 2) == {1, 2}
    assert len(model.transitions[2].posterior.y) == 44
    far = samples.q[:, 6] > 0.8
    samples.q_next[far, 2] += samples.q[far, 6] - 0.8
    monkeypatch.setattr(dropping, "spread", lambda *_: (~far).nonzero()[:, 0])
    assert 6 in read(gaussian_processes(ALONE, samples), 2)


@pytest.mark.parametrize("seed", range(3))
def test_with_few_samples_no_relevant_input_is_dropped(seed):
    """With two samples for each input, the evidence is always for fewer inputs, and often for the wrong ones."""
    model = gaussian_processes(ROW, steps(22, seed))
    for column in range(1, 10):
        assert read(model, column) in ({column - 1, column}, set(range(11)))


def test_below_the_minimum_number_of_samples_no_input_is_dropped():
    assert not any(o.feature_map.dropped for o in gaussian_processes(ROW, steps(dropping.FEWEST - 1, 0)).outputs)


def test_an_output_predicted_precisely_drops_no_inputs():
    model = gaussian_processes(definition_from_spec(pendulum()), random_steps(pendulum(), 20, seed=0))
    assert not any(output.feature_map.dropped for output in model.outputs)


def test_the_next_limited_speed_and_inputs_of_nonstationary_processes_are_never_dropped():
    """As long as no sample ends at the limit, the next value seems to say nothing new."""
    known = definition_from_spec(pendulum())
    output = gaussian_processes(known, random_steps(pendulum(), 4, seed=0)).transitions[0]
    learner = OutputLearner(known, Settings(), {}, {})
    for feature_map, places in ((FeatureMap(lead=True), [4]), (FeatureMap(rates=(0.0, 0.0, 0.7, 0.0)), [2])):
        names = [feature.function for feature in features(known, feature_map)]
        x = torch.randn(24, len(names), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        hyper = Hyperparameters(torch.ones(len(names), dtype=torch.float64), 1.0, 0.5, 0.0, 1e-2)
        unknown = replace(output, feature_map=feature_map, posterior=condition(hyper, x, x[:, 0]))
        kept = torch.ones(len(names), dtype=torch.bool)
        kept[places] = False
        assert torch.equal(dropping._may_be_dropped(learner, unknown), kept)


def test_a_feature_map_with_dropped_inputs_keeps_the_order_of_the_others():
    every = features(ROW, FeatureMap())
    left = features(ROW, FeatureMap(dropped=(1, 3), rates=(0.0, 0.5, *[0.0] * 7)))
    assert [f.entry for f in left] == [every[place].entry for place in (0, 2, 4, 5, 6, 7, 8, 9, 10)]
    assert math.isclose(left[1].rate, 0.5)
