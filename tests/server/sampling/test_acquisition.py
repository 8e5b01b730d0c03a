"""Candidates: where their probability comes from, what an assumed answer changes, and what all but repeats a point."""

from dataclasses import replace

import torch

from support.real_steps import random_steps
from surrogym_client.original.classic import cartpole, pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.sampling.acquisition import NEAR, candidates_of, condition_on, near
from surrogym_server.sampling.confidence import deviations
from surrogym_server.sampling.occupancy import log_occupancy
from surrogym_server.surrogate.learn import learn
from surrogym_shared.spec import Design


def test_without_visited_states_every_state_is_as_likely(model, points):
    assert (candidates_of(model, *points, states=None).log_p == 0).all()
    assert (candidates_of(model, *points, states=torch.zeros(0, 2).double()).log_p == 0).all()


def test_visited_states_are_what_is_weighed_by(model, points, unseen):
    made = candidates_of(model, *points, unseen.q)
    torch.testing.assert_close(made.log_p, log_occupancy(model.definition, unseen.q, points[0]))


def test_the_paper_takes_the_density_of_predicted_next_states(points):
    spec = pendulum().model_copy(update={"design": Design(preset="paper")})
    model = learn(definition_from_spec(spec), random_steps(spec, 12, seed=0)).model
    arrived = model.transition(*points).q_next
    expected = log_occupancy(model.definition, arrived, arrived, floor=1e-12)
    torch.testing.assert_close(candidates_of(model, *points, states=None).log_p, expected)
    assert float(expected.std()) > 0.05


def test_an_assumed_answer_shrinks_deviations_and_moves_no_mean(model, points):
    q, u = points
    assumed = condition_on(model, q[0], u[0])
    before, after = deviations(model, q, u), deviations(assumed, q, u)
    assert torch.all(after <= before * (1 + 1e-6) + 1e-9)
    assert torch.all(after[0] < 0.1 * before[0].clamp_min(1e-3))
    torch.testing.assert_close(assumed.means(q, u), model.means(q, u), rtol=0, atol=1e-5)
    assert [len(o.posterior.y) for o in model.transitions] == [len(o.posterior.y) - 1 for o in assumed.transitions]


def test_an_assumed_answer_leaves_constant_outputs_alone():
    model = learn(definition_from_spec(cartpole()), random_steps(cartpole(), 8, seed=0)).model
    assumed = condition_on(model, torch.zeros(4).double(), torch.ones(1).double())
    assert assumed.reward is model.reward


def test_near_is_measured_in_deviations_of_the_sampling_range(definition):
    taken_q, taken_u = torch.tensor([[3.14, 1.0]]).double(), torch.tensor([[0.5]]).double()
    deviation = 16 / 12**0.5
    q = torch.tensor([[3.14, 1.0]] * 2).double()
    q[0, 1] += 0.9 * NEAR * deviation
    q[1, 1] += 1.1 * NEAR * deviation
    assert near(definition, q, taken_u.expand(2, 1), taken_q, taken_u).tolist() == [True, False]
    turned = torch.tensor([[3.14 - 2 * torch.pi, 1.0]]).double()
    assert near(definition, turned, taken_u, taken_q, taken_u).tolist() == [True]
    assert near(definition, taken_q, taken_u + 0.5, taken_q, taken_u).tolist() == [False]
    nothing = torch.zeros(0, 2).double(), torch.zeros(0, 1).double()
    assert near(definition, q, taken_u.expand(2, 1), *nothing).tolist() == [False, False]


def test_another_discrete_action_is_another_query(definition):
    discrete = replace(definition, action=definition_from_spec(cartpole()).action)
    q, left, right = torch.zeros(1, 2).double(), torch.zeros(1, 1).double(), torch.ones(1, 1).double()
    assert near(discrete, q, left, q, right).tolist() == [False]
