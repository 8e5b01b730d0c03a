"""Criteria against their definitions, and batches: distinct, greedy, and ended where nothing is left."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import norm

from surrogym_sampler.original.classic import cartpole
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.points import Points
from surrogym_server.errors import ChoiceFailed
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.plugins import Choice
from surrogym_server.sampling.acquisition import ACQUISITIONS, PathView, Variance, acquisition_of, path_value_of
from surrogym_server.sampling.batch import NEAR, candidate_view, choose, nearest
from surrogym_server.sampling.candidates import Candidates
from surrogym_server.sampling.confidence import stds
from surrogym_server.sampling.lookahead import outlook_of
from surrogym_server.sampling.rollouts import Aim, path_values, predict_paths

TOLERANCES = (0.01, 0.02, 0.1)
CRITERIA = ("uncertainty_index", "variance", "integrated_variance")


def by(model: GaussianProcessModel, criterion: str) -> GaussianProcessModel:
    design = replace(model.definition.design, acquisition=Choice(criterion))
    return replace(model, definition=replace(model.definition, design=design))


@pytest.fixture
def candidates(points) -> Candidates:
    log_p = torch.linspace(-3, 0, len(points[0]), dtype=torch.float64)
    weights = torch.full((60,), 1 / 60, dtype=torch.float64)
    return Candidates(Points(*points), log_p, Points(*points), weights)


def value(model: GaussianProcessModel, candidates: Candidates, criterion: str, column: int) -> torch.Tensor:
    points = candidates.points
    outlook = outlook_of(model, points, candidates.reference, points[:0])
    distance = torch.ones(len(points), dtype=torch.float64)
    output = outlook[column]
    assert output is not None
    view = candidate_view(model, candidates, column, output, TOLERANCES[column], distance)
    return acquisition_of(Choice(criterion)).value(view)


@pytest.mark.parametrize("name", ACQUISITIONS.names)
def test_every_acquisition_function_is_pure_finite_and_monotone_along_paths(model, candidates, name):
    """Pure, one finite value for each candidate and beginning of a path, no decrease along a path."""
    kept = candidates.points.q.clone()
    first, again = (value(model, candidates, name, 1) for _ in range(2))
    assert first.shape == (len(kept),)
    assert bool(first.isfinite().all())
    assert torch.equal(first, again)
    assert torch.equal(candidates.points.q, kept)
    asking, actions = by(model, name), candidates.points.u[:5][None]
    paths = predict_paths(asking, kept[:1], actions)
    along = path_values(asking, Aim((0, 1), TOLERANCES, longest=5), paths)
    assert along.shape == (1, 5)
    assert bool(along.isfinite().all())
    assert bool((along.diff(dim=1) >= -1e-9).all())


def test_the_uncertainty_index_is_uncertainty_times_probability(model, candidates):
    sigma = stds(model, candidates.points.q, candidates.points.u)[:, 1].numpy()
    expected = norm.sf(0.02 / sigma) * np.exp(candidates.log_p.numpy())
    np.testing.assert_allclose(value(model, candidates, "uncertainty_index", 1).exp().numpy(), expected, rtol=1e-4)


def test_the_variance_acquisition_equals_the_predictive_deviation(model, candidates):
    said = value(model, candidates, "variance", 2)
    torch.testing.assert_close(said, stds(model, candidates.points.q, candidates.points.u)[:, 2], rtol=1e-6, atol=0)


def test_integrated_variance_prefers_queries_that_inform_many_points(model, candidates):
    """A candidate far from the reference, and from its mirror image, lowers nothing there, however uncertain it is."""
    here = (candidates.points.q[:, 1].abs() > 4).double()
    only_here = replace(candidates, weights=here / here.sum())
    pick = int(value(model, only_here, "integrated_variance", 1).argmax())
    assert here[pick]
    only_there = replace(candidates, weights=(1 - here) / (1 - here).sum())
    assert not here[int(value(model, only_there, "integrated_variance", 1).argmax())]


@pytest.mark.parametrize("criterion", CRITERIA)
def test_choosing_a_batch_of_queries_equals_choosing_them_one_by_one(model, candidates, criterion):
    """Choosing three at once is choosing one three times, with those before assumed."""
    points, nothing = candidates.points, candidates.points[:0]
    model = by(model, criterion)
    batch = choose(model, candidates, nothing, nothing, [2, 1, 2], TOLERANCES)
    picks: list[int] = []
    for column in (2, 1, 2):
        picks += choose(model, candidates, points[picks], points[picks], [column], TOLERANCES)
    assert batch == picks
    assert len(set(batch)) == 3


def test_the_design_chooses_no_query_that_was_already_asked(model, candidates):
    points = candidates.points
    all_but_two = points[: len(points) - 2]
    assert set(choose(model, candidates, all_but_two, points[:0], [0, 1, 2, 0, 1], TOLERANCES)) == {58, 59}


def test_if_some_candidates_have_priority_the_first_query_of_a_batch_is_one_of_them(model, candidates):
    reserved = torch.zeros(60, dtype=torch.bool)
    reserved[[7, 31]] = True
    nothing = candidates.points[:0]
    batch = choose(model, replace(candidates, reserved=reserved), nothing, nothing, [0, 0, 0], TOLERANCES)
    assert batch[0] in (7, 31)
    assert len(batch) == 3


def test_a_constant_output_is_queried_far_from_earlier_queries(model, candidates):
    """It has no deviation to choose by, and only something unlike the samples could prove it wrong."""
    constant = replace(model, reward=replace(model.reward, posterior=None))
    taken = candidates.points[:30]
    (pick,) = choose(constant, candidates, taken, taken[:0], [2], TOLERANCES)
    assert pick == int(nearest(model.definition, candidates.points, taken).argmax())


def test_the_distance_between_queries_is_standardised_by_the_sampling_range(definition):
    taken = Points(torch.tensor([[3.14, 1.0]]).double(), torch.tensor([[0.5]]).double())
    std = 16 / 12**0.5
    q = torch.tensor([[3.14, 1.0]] * 2).double()
    q[0, 1] += 0.9 * NEAR * std
    q[1, 1] += 1.1 * NEAR * std
    assert (nearest(definition, Points(q, taken.u.expand(2, 1)), taken) / NEAR).tolist() == pytest.approx([0.9, 1.1])
    turned = Points(torch.tensor([[3.14 - 2 * torch.pi, 1.0]]).double(), taken.u)
    assert nearest(definition, turned, taken).tolist() == pytest.approx([0], abs=1e-6)
    assert nearest(definition, Points(taken.q, taken.u + 0.5), taken)[0] > NEAR
    assert torch.isinf(nearest(definition, taken, taken[:0])).all()


def test_queries_with_different_discrete_actions_are_not_near_duplicates(definition):
    discrete = replace(definition, action=definition_from_spec(cartpole()).action)
    q, left, right = torch.zeros(1, 2).double(), torch.zeros(1, 1).double(), torch.ones(1, 1).double()
    assert nearest(discrete, Points(q, left), Points(q, right))[0] > NEAR


def leave(_: torch.Tensor) -> object:
    raise SystemExit("no licence")


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (lambda std: std.sum(), r"expected a tensor of shape \(60,\), got \(\)"),
        (lambda std: std[:7], r"expected a tensor of shape \(60,\), got \(7,\)"),
        (lambda std: std[:, None], r"expected a tensor of shape \(60,\), got \(60, 1\)"),
        (lambda std: std.numpy(), r"expected a tensor of shape \(60,\), got ndarray"),
        (lambda std: std * torch.nan, "expected finite values, got 60 of 60 that are infinite or NaN"),
        (lambda _: ("angle", "speed").index("x"), r"ValueError: tuple.index\(x\): x not in tuple"),
        (leave, "SystemExit: no licence"),
    ],
)
def test_invalid_acquisition_values_raise_an_error_that_names_the_acquisition(
    model, candidates, monkeypatch, answer, said
):
    """By its values the design spends real steps; argmax of NaN or of a scalar would choose without a word."""
    monkeypatch.setattr(Variance, "value", lambda _, view: answer(view.std))
    nothing = candidates.points[:0]
    expected = f"^the choice of the next queries failed: acquisition variance: {said}"
    with pytest.raises(ChoiceFailed, match=expected):
        choose(by(model, "variance"), candidates, nothing, nothing, [0], TOLERANCES)


def test_invalid_acquisition_values_along_a_path_raise_an_error(monkeypatch):
    weight = torch.ones(2, 3)
    paths = PathView(0.1, weight, lambda: weight, lambda: weight)
    monkeypatch.setattr(Variance, "path_value", lambda _, view: view.weight / 0)
    with pytest.raises(ChoiceFailed, match="acquisition variance: expected finite values, got 6 of 6"):
        path_value_of(Choice("variance"), paths)
