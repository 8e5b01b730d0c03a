"""Thresholds found from labelled states: which axes, from which side, and how far they are known."""

import numpy as np
import pytest
import torch

from support.real_steps import random_steps
from surrogym_sampler.original.classic import mountain_car_continuous
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.models.gaussian_process.learning.thresholds import explain, log_probability, thresholds
from surrogym_server.models.gaussian_process.prediction.regions import Thresholds
from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Term, Uniform

PLANE = {"x": Uniform(low=-1, high=1), "y": Uniform(low=-1, high=1)}


@pytest.fixture(scope="module")
def plane() -> EnvironmentDefinition:
    """Two coordinates, and their sum as the observation."""
    spec = EnvironmentSpec(
        coordinates=tuple(Coordinate(name=n, sampling=r) for n, r in PLANE.items()),
        observation=(ObservationEntry(name="sum", term=Term.linear(x=1, y=1)),),
        action=BoxAction(low=(-1,), high=(1,)),
        start=PLANE,
    )
    return definition_from_spec(spec)


def points(count: int, seed: int = 0) -> torch.Tensor:
    return 2 * torch.rand(count, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 1


def words(form: Thresholds) -> list[set[str]]:
    """The axes of each rule: ``x >`` for x > 0.3."""
    return [{cut["rule"].rsplit(" ", 1)[0] for cut in rule} for rule in form.description["rules"]]


@pytest.mark.parametrize(
    ("inside", "rules"),
    [
        (lambda q: q[:, 0] > 0.6, [{"x >"}]),
        (lambda q: q[:, 0] < -0.6, [{"x <"}]),
        (lambda q: q[:, 1].abs() > 0.7, [{"|y| >"}]),
        (lambda q: q.sum(1) > 0.8, [{"sum >"}]),
        (lambda q: (q[:, 0] > 0.7) | (q[:, 1] < -0.7), [{"x >"}, {"y <"}]),
    ],
)
def test_thresholds_find_the_coordinates_that_determine_termination(plane, inside, rules):
    q = points(200)
    (form, score), *_ = thresholds(plane, q, inside(q))
    assert not form.complement
    assert sorted(words(form), key=str) == sorted(rules, key=str)
    assert score > -0.05 * len(q)
    unseen = points(1000, seed=1)
    assert float(((form.probability(unseen) > 0.5) != inside(unseen)).double().mean()) < 0.02


def test_conditions_that_must_hold_together_are_learned_as_complement_of_a_union(plane):
    q = points(200)
    box = (q[:, 0] > 0.2) & (q[:, 1].abs() < 0.5)
    (form, _), *others = thresholds(plane, q, box)
    assert form.complement
    assert not others, "no union of half planes is a box"
    unseen = points(1000, seed=1)
    expected = (unseen[:, 0] > 0.2) & (unseen[:, 1].abs() < 0.5)
    assert float(((form.probability(unseen) > 0.5) != expected).double().mean()) < 0.03


def test_a_learned_threshold_lies_midway_between_the_nearest_samples(plane):
    q = torch.tensor([[-0.5, 0.1], [0.2, -0.4], [0.0, 0.9], [0.6, 0.2], [0.9, -0.3]], dtype=torch.float64)
    rules = explain(np.stack([q[:, 0].numpy(), -q[:, 0].numpy()], 1), np.array([False, False, False, True, True]))
    ((cut,),) = rules
    assert (cut.axis, cut.outside, cut.inside, cut.weight) == (0, 0.2, 0.6, 1.0)
    at = torch.tensor([[0.1, 0.0], [0.3, 0.0], [0.4, 0.0], [0.7, 0.0]], dtype=torch.float64)
    assert Thresholds(plane, rules).probability(at).tolist() == pytest.approx([0, 0.25, 0.5, 1])


def test_equally_good_threshold_coordinates_are_kept_until_a_sample_decides(plane):
    q = torch.tensor([[0.0, 0.0], [-0.8, -0.8], [0.2, -0.8], [-0.8, 0.2], [0.8, 0.8]], dtype=torch.float64)
    ended = torch.arange(5) == 4
    (form, _), *_ = thresholds(plane, q, ended)
    (rivals,) = words(form)
    assert rivals == {"x >", "y >", "sum >"}
    doubtful = form.probability(torch.tensor([[0.8, 0.0], [0.8, 0.8]], dtype=torch.float64))
    assert 0.1 < float(doubtful[0]) < 0.9
    assert float(doubtful[1]) == pytest.approx(1)
    told = torch.cat([q, torch.tensor([[0.8, -0.8]], dtype=torch.float64)])
    (form, _), *_ = thresholds(plane, told, torch.arange(6) >= 4)
    assert words(form) == [{"x >"}]


def test_no_threshold_is_learned_for_labels_it_cannot_separate(plane):
    q = points(100)
    ring = (q.square().sum(1) > 0.2) & (q.square().sum(1) < 0.5)
    assert thresholds(plane, q, ring) == []


@pytest.mark.parametrize("label", [False, True])
def test_no_threshold_is_learned_from_equal_labels(plane, label):
    assert thresholds(plane, points(10), torch.full((10,), label)) == []


def test_the_learned_goal_of_mountain_car_is_a_position_and_velocity_threshold():
    steps = random_steps(mountain_car_continuous(), 400, seed=1)
    definition = definition_from_spec(mountain_car_continuous())
    best, _ = max(thresholds(definition, steps.q_next, steps.terminated), key=lambda pair: pair[1])
    assert best.complement
    assert sorted(words(best), key=str) == [{"position <"}, {"velocity <"}]


def test_certain_threshold_labels_are_scored_by_the_rule_of_succession():
    inside = torch.tensor([True, False])
    assert log_probability(torch.tensor([1.0, 1.0], dtype=torch.float64), inside) == pytest.approx(-np.log(4))
