"""Outputs that change the faster the further along an input: chosen by evidence, and the same in every computation."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from support.models import gaussian_processes, learn
from support.predictions import WAYS, check_compiled, check_processes
from support.real_steps import random_steps
from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.features import FeatureMap, encode
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples
from surrogym_server.errors import InvalidInput
from surrogym_server.gp import Hyperparameters, condition
from surrogym_server.models.abilities import PredictedSteps
from surrogym_server.models.files import from_bytes, to_bytes
from surrogym_server.models.gaussian_process.codec.outputs import require_output
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.lookahead import process_inputs
from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Term, Uniform

RANGES = {"amount": Uniform(low=0, high=1), "heat": Uniform(low=-2, high=2)}


def spec(**model: object) -> EnvironmentSpec:
    """An amount that reacts the faster the hotter it is, and a heat that follows the action alone."""
    made = EnvironmentSpec(
        coordinates=tuple(Coordinate(name=n, sampling=r) for n, r in RANGES.items()),
        observation=tuple(ObservationEntry(name=n, term=Term.linear(**{n: 1})) for n in RANGES),
        action=BoxAction(low=(-1,), high=(1,)),
        start=RANGES,
        time_limit=50,
    )
    if not model:
        return made
    design = made.design.model_validate({"model": {"name": "gaussian_process", "settings": model}})
    return made.model_copy(update={"design": design})


REACTION = definition_from_spec(spec())


def steps(count: int, seed: int) -> Samples:
    p = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    q, u = torch.stack([p[:, 0], 4 * p[:, 1] - 2], 1), 2 * p[:, 2:] - 1
    rate = 0.02 * (2 * q[:, 1]).exp() * (1 + 0.2 * u[:, 0])
    q_next = torch.stack([q[:, 0] * (-rate).exp(), 0.9 * q[:, 1] + 0.2 * u[:, 0]], 1)
    reward = torch.zeros(count, dtype=torch.float64)
    return Samples(q, u, q_next, reward, reward.bool())


def amount_error(model: GaussianProcessModel, test: Samples) -> float:
    """Median error of the amount where it is cold."""
    cold = test.q[:, 1] < 0
    off = model.transition(test.q, test.u).q_next - test.q_next
    return float(off[cold, 0].abs().median())


@pytest.fixture(scope="module")
def model() -> GaussianProcessModel:
    return gaussian_processes(REACTION, steps(60, 0))


@pytest.fixture(scope="module")
def points() -> tuple[Tensor, Tensor]:
    test = steps(50, 7)
    return test.q, test.u


def test_an_output_gets_a_nonstationary_process_only_if_the_evidence_favours_it(model):
    amount, heat = model.transitions
    assert amount.feature_map.rates[1] > 0.3  # along the heat
    assert heat.feature_map.rates == ()
    assert "rates" in model.structures[0]
    assert any("rates" in name for name, _ in amount.scores)


def test_small_changes_are_predicted_better_by_a_nonstationary_process(model):
    without = gaussian_processes(definition_from_spec(spec(rates=False)), steps(60, 0))
    assert without.transitions[0].feature_map.rates == ()
    assert amount_error(model, steps(400, 9)) < 0.5 * amount_error(without, steps(400, 9))


def test_a_model_with_nonstationary_processes_predicts_their_posteriors(model, points):
    check_processes(model, points)


@pytest.mark.parametrize("how", WAYS)
def test_compiled_steps_of_a_model_with_nonstationary_processes_equal_the_model(model, points, how):
    check_compiled(model, points, how)


@pytest.fixture(scope="module")
def beside(model) -> GaussianProcessModel:
    """The model as the difference from a prior model of few samples."""
    outputs = tuple(replace(output, size_with_prior=1.0) for output in model.transitions)
    return replace(model, transitions=outputs, prior=gaussian_processes(REACTION, steps(12, 5)))


@pytest.mark.parametrize("how", [how for how in WAYS if how != "in C"])
def test_compiled_steps_of_nonstationary_processes_with_a_prior_equal_the_model(beside, points, how):
    check_compiled(beside, points, how)


def test_a_prior_model_adds_at_most_its_own_uncertainty_where_an_output_grows(beside, points):
    hotter = (points[0] + torch.tensor([0.0, 3.0]), points[1])
    own, known = (one.transition(*hotter, stds=True).std for one in (replace(beside, prior=None), beside.prior))
    found = beside.transition(*hotter, stds=True).std
    assert (found[:, 0] > own[:, 0]).all()
    assert (found[:, 0].square() <= 1.1 * (own[:, 0].square() + known[:, 0].square())).all()


def test_functions_drawn_from_nonstationary_processes_have_the_predicted_deviations(model, points):
    count = 2_000
    noise = torch.randn(count, model.path_size, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    functions = model.draw(noise)
    for row in (0, 11, 23):
        q, u = (p[row].expand(count, -1) for p in points)
        spread = model.transition_along(functions, q, u).q_next.std(0)
        said = model.transition(q[:1], u[:1], stds=True).std[0]
        torch.testing.assert_close(spread, said, rtol=0.25, atol=1e-5)


def test_the_expected_deviations_after_a_query_equal_those_of_conditioning_on_it(model, points):
    candidates = Points(*(p[:20] for p in points))
    outlook = model.outlook(candidates, candidates[:5], candidates[:0])[0]
    output = model.transitions[0]
    x = process_inputs(model.definition, output, PredictedSteps(candidates.q, candidates.u, candidates.q))
    torch.testing.assert_close(outlook.std, output.mean_and_std(x)[1], rtol=1e-4, atol=1e-7)
    posterior = output.posterior
    hyper = posterior.hyper
    answered = condition(hyper, torch.cat([posterior.x, x[3:4]]), torch.cat([posterior.y, posterior.y[:1]]))
    after = replace(output, posterior=answered).mean_and_std(x)[1]
    torch.testing.assert_close(outlook.observe(3).std, after, rtol=1e-3, atol=1e-6)


def test_leave_one_out_errors_of_a_nonstationary_process_equal_conditioning_without_the_point(model):
    output = model.transitions[0]
    posterior = output.posterior
    squares = []
    for row in range(len(posterior.y)):
        others = torch.arange(len(posterior.y)) != row
        without = replace(output, posterior=condition(posterior.hyper, posterior.x[others], posterior.y[others]))
        x = posterior.x[row : row + 1]
        truth = replace(output, posterior=posterior).centre + output.scale * output.amplitude(x) * posterior.y[row]
        squares.append(float((without.mean(x) - truth).square()))
    assert output.leave_one_out().error == pytest.approx((sum(squares) / len(squares)) ** 0.5, rel=1e-3)


def test_nonstationary_processes_survive_storage_of_the_model(model, points):
    loaded = from_bytes(REACTION, to_bytes(model))
    assert isinstance(loaded, GaussianProcessModel)
    assert loaded.transitions[0].feature_map == model.transitions[0].feature_map
    torch.testing.assert_close(loaded.transition(*points).q_next, model.transition(*points).q_next, rtol=0, atol=0)


@pytest.mark.parametrize(
    "rates", [(0.1,), (0.1, float("nan"), 0.0), (0.1, 0.2, 0.3, 0.4), (0.0, 2.1, 0.0), (-2.0, -2.0, 2.0)]
)
def test_a_stored_model_with_malformed_nonstationary_processes_is_refused(model, rates):
    output = model.transitions[0]
    wrong = replace(output, feature_map=replace(output.feature_map, rates=rates))
    with pytest.raises(InvalidInput, match=r"rate|amplitude"):
        require_output(REACTION, wrong)


def test_with_few_samples_every_output_gets_a_stationary_process():
    assert not gaussian_processes(REACTION, steps(20, 0)).transitions[0].feature_map.rates


def test_a_process_is_not_nonstationary_along_an_input_with_an_outlying_sample():
    samples = steps(60, 0)
    samples.q[0, 1] = -40.0
    assert not any(
        rates[1] for o in gaussian_processes(REACTION, samples).transitions if (rates := o.feature_map.rates)
    )


def test_an_outlying_sample_makes_a_warm_started_nonstationary_process_stationary():
    """Once a sample is far out, its input may have no rate any more. The earlier rates are then no start."""
    warm = learn(REACTION, steps(60, 0)).warm
    assert any("rates" in name for name in warm)
    samples = steps(60, 0)
    samples.q[0, 1] = -40.0
    assert learn(REACTION, samples, warm).model.transitions[0].feature_map.rates[1:2] in ((), (0.0,))


def test_predictions_of_nonstationary_processes_far_from_the_samples_are_finite(model):
    q = torch.tensor([[0.5, 1e6], [0.5, -1e6], [1e6, 0.0]], dtype=torch.float64)
    moved = model.transition(q, torch.zeros(3, 1, dtype=torch.float64), stds=True)
    assert bool(torch.isfinite(moved.q_next).all())
    assert bool(torch.isfinite(moved.std).all())


def test_no_nonstationary_process_is_tried_for_a_precisely_predicted_output():
    learned = learn(definition_from_spec(pendulum()), random_steps(pendulum(), 20, seed=0))
    assert not any("rates" in name for name in learned.warm)


def test_with_many_samples_a_nonstationary_process_is_chosen_on_a_subset(monkeypatch):
    monkeypatch.setattr("surrogym_server.gp.subsets.FEW", 48)
    model = gaussian_processes(REACTION, steps(56, 0))
    assert model.transitions[0].feature_map.rates[1] > 0.3
    assert len(model.transitions[0].posterior.y) == 56
    assert amount_error(model, steps(400, 9)) < 0.005


def test_compiled_steps_with_nonstationary_processes_and_predicted_angles_equal_the_model():
    """Turned angles read all coordinates, and are computed after the inputs with rates."""
    known, samples = definition_from_spec(pendulum()), random_steps(pendulum(), 12, seed=0)
    feature_map = FeatureMap(drift=((0.02, 0.05),), rates=(0.0, 0.0, 0.7, 0.0, 0.0, -0.4))
    x = encode(known, feature_map, samples.q, samples.u)
    hyper = Hyperparameters(torch.full((6,), 2.0, dtype=torch.float64), 1.0, 0.5, 0.0, 1e-6)
    posterior = condition(hyper, x, torch.sin(x.sum(1)))
    plain = gaussian_processes(known, samples)
    outputs = tuple(replace(o, feature_map=feature_map, posterior=posterior) for o in plain.transitions)
    model = replace(plain, transitions=outputs)
    if (compiled := model.compiled()) is None:
        pytest.skip("steps can't be compiled here")
    ours = model.transition(samples.q, samples.u).q_next
    theirs = compiled(
        samples.q.numpy(),
        samples.u.numpy(),
        noise=None,
        process=None,
        paths=None,
        stds=False,
        reward_std=False,
    )
    torch.testing.assert_close(torch.from_numpy(theirs.q_next), ours, rtol=1e-7, atol=1e-8)
