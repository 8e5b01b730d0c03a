"""Candidates: where they come from, where their probability comes from, and what a query should be good for."""

import dataclasses

import numpy as np
import pytest
import torch

from support.models import learn
from support.real_steps import random_steps
from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples
from surrogym_server.plugins import Choice
from surrogym_server.sampling import candidates as candidates_room
from surrogym_server.sampling.candidates import OCCUPIED, candidates_of, input_probability
from surrogym_server.sampling.endings import ending
from surrogym_server.sampling.occupancy import log_occupancy
from surrogym_shared.spec import Design


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_without_visited_states_all_candidates_have_equal_probability(model, points):
    assert (input_probability(model, Points(*points), None) == 0).all()
    assert (input_probability(model, Points(*points), torch.zeros(0, 2).double()) == 0).all()


def test_candidates_are_weighted_by_the_density_of_visited_states(model, points, unseen):
    said = input_probability(model, Points(*points), unseen.q)
    torch.testing.assert_close(said, log_occupancy(model.definition, unseen.q, points[0]))


def test_preset_paper_weights_candidates_by_the_density_of_predicted_next_states(points):
    spec = pendulum().model_copy(update={"design": Design(preset="paper")})
    model = learn(definition_from_spec(spec), random_steps(spec, 12, seed=0)).model
    arrived = model.transition(*points).q_next
    expected = log_occupancy(model.definition, arrived, arrived, floor=1e-12)
    torch.testing.assert_close(input_probability(model, Points(*points), None), expected)
    assert float(expected.std()) > 0.05


@pytest.mark.parametrize("acquisition", ["uncertainty_index", "integrated_variance", "variance"])
def test_candidate_probabilities_are_computed_only_for_the_uncertainty_index(model, points, unseen, rng, acquisition):
    design = dataclasses.replace(model.definition.design, acquisition=Choice(acquisition))
    asked = dataclasses.replace(model, definition=dataclasses.replace(model.definition, design=design))
    made = candidates_of(asked, Points(*points), unseen.q, rng)
    reads = acquisition == "uncertainty_index"
    expected = input_probability(asked, made.points, unseen.q) if reads else torch.zeros(len(made.points)).double()
    torch.testing.assert_close(made.log_p, expected)


def test_without_visited_states_reference_points_cover_the_sampling_range_equally(model, points, rng):
    made = candidates_of(model, Points(*points), None, rng)
    assert torch.equal(made.points.q, points[0])
    assert torch.equal(made.reference.q, points[0])
    torch.testing.assert_close(made.weights, torch.full((60,), 1 / 60, dtype=torch.float64))


def test_visited_states_outside_the_sampling_range_are_never_queried(model, points, unseen, rng):
    visited, away = unseen.q[:7], torch.tensor([[0.0, 8.5], [3.0, -400.0]], dtype=torch.float64)
    made = candidates_of(model, Points(*points), torch.cat([away, visited]), rng)
    assert float(made.points.q[:, 1].abs().max()) <= 8
    assert float(made.reference.q[:, 1].abs().max()) <= 8
    none = candidates_of(model, Points(*points), away, rng)
    assert torch.equal(none.points.q, points[0])
    assert torch.equal(none.weights, torch.full_like(none.weights, 1 / len(none.weights)))


def test_visited_states_become_query_candidates_and_reference_points(model, points, unseen, rng):
    visited = unseen.q[:7]
    made = candidates_of(model, Points(*points), visited, rng)
    assert torch.equal(made.points.q[:60], points[0])
    assert all(bool((q == visited).all(1).any()) for q in made.points.q[60:])
    of_policies = torch.stack([(q == visited).all(1).any() for q in made.reference.q])
    assert float(made.weights.sum()) == pytest.approx(1)
    assert float(made.weights[of_policies].sum()) == pytest.approx(OCCUPIED)


def test_candidates_and_reference_points_are_limited_in_number(model, points, rng, monkeypatch):
    monkeypatch.setattr(candidates_room, "MAX_CANDIDATES", 20)
    monkeypatch.setattr(candidates_room, "REFERENCE", 10)
    made = candidates_of(model, Points(*points), None, rng)
    assert (len(made.points), len(made.log_p), len(made.reference), len(made.weights)) == (20, 20, 10, 10)


def test_query_candidates_that_end_the_episode_have_priority_until_a_termination_was_sampled():
    spec = cartpole()
    steps = random_steps(spec, 60, seed=0)
    going = Samples(*(getattr(steps, n)[~steps.terminated] for n in steps.__dataclass_fields__))
    model = learn(definition_from_spec(spec), going).model
    points = Points(steps.q, steps.u)
    reserved = ending(model, going, points)
    assert bool(model.terminated(model.transition(*steps_of(points, reserved)).q_next).all())
    assert ending(model, steps, points) is None
    assert ending(model, going, Points(0 * steps.q, steps.u)) is None


def steps_of(points: Points, chosen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    return points.q[chosen], points.u[chosen]
