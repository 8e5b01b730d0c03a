"""Queries for the sake of the episodes' end, and a whole design that finds it by itself."""

import pytest
import torch

from support.models import learn
from support.plane import drifting, plane
from support.real_steps import answer, arrays, join, random_steps
from surrogym_sampler.original.classic import cartpole
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples
from surrogym_server.sampling.design import advance, initial_queries
from surrogym_server.sampling.endings import ending, in_doubt
from surrogym_server.sampling.state import DesignState, Request
from surrogym_server.virtual.environment import VirtualSettings, create, reset, step

LEARNED = cartpole().model_copy(update={"termination": "learned"})


@pytest.fixture(scope="module")
def steps() -> Samples:
    return random_steps(LEARNED, 60, seed=0)


def part(samples: Samples, chosen: torch.Tensor) -> Samples:
    return Samples(*(getattr(samples, name)[chosen] for name in samples.__dataclass_fields__))


def test_without_terminated_samples_query_candidates_far_from_the_samples_have_priority(steps):
    near = part(steps, steps.q_next.abs().amax(1) < 1)
    assert not bool(near.terminated.any())
    model = learn(definition_from_spec(LEARNED), near).model
    reserved = ending(model, near, Points(steps.q, steps.u))
    assert reserved is not None
    assert float(steps.q[reserved].abs().sum(1).min()) > float(steps.q.abs().sum(1).median())
    assert ending(model, near, Points(0 * steps.q, steps.u)) is None


def test_query_candidates_at_an_uncertain_termination_boundary_have_priority(steps):
    some = part(steps, torch.arange(len(steps)) % 2 == 0)
    assert bool(some.terminated.any())
    model = learn(definition_from_spec(LEARNED), some).model
    reserved = ending(model, some, Points(steps.q, steps.u))
    doubt = in_doubt(model, model.transition(steps.q, steps.u).q_next)
    assert reserved is not None
    assert float(doubt[reserved].min()) >= 0.5 * float(doubt.max()) > 0


def test_a_declared_termination_boundary_is_never_uncertain(steps):
    model = learn(definition_from_spec(cartpole()), steps).model
    assert float(in_doubt(model, steps.q_next).max()) == 0


def test_query_candidates_at_an_uncertain_reward_jump_have_priority():
    seen = drifting(lambda q, _: (q[:, 0] > 0.5).double(), 12)
    model = learn(definition_from_spec(plane()), seen).model
    (jump,) = model.jumps
    points = Points(
        2 * torch.rand(200, 2, generator=torch.Generator().manual_seed(1)).double() - 1, torch.zeros(200, 1)
    )
    reserved = ending(model, seen, Points(points.q, points.u.double()))
    assert reserved is not None
    chance = jump.region.probability(model.transition(points.q, points.u.double()).q_next)[reserved]
    assert float(chance.min()) > 0.1
    assert float(chance.max()) < 0.9


@pytest.mark.parametrize("seed", [0, 1])
def test_the_design_learns_an_undeclared_termination_of_cart_pole_in_30_steps(seed):
    """At most 30 real steps, the ends of CartPole not declared: better than calling no step an end."""
    spec = LEARNED.model_copy(update={"design": cartpole().design.model_copy(update={"seed": seed, "budget": 30})})
    definition, state = definition_from_spec(spec), DesignState()
    samples = answer(spec, *arrays(initial_queries(definition, 30)))
    while True:
        decision = advance(definition, samples, state, Request(30, 0.999))
        if decision.verdict != "continue":
            break
        state, left = decision.state, 30 - len(samples)
        samples = join(samples, answer(spec, *arrays(decision.queries[:left])))
    model, unseen = decision.model, random_steps(spec, 500, seed=20_000)
    predicted = model.terminated(model.transition(unseen.q, unseen.u).q_next)
    assert int((predicted != unseen.terminated).sum()) < int(unseen.terminated.sum())
    settings = VirtualSettings(num_envs=8, time_limit=500)
    lanes, _ = reset(definition, settings, create(definition, settings, seed=0))
    for _ in range(20):  # pushed to one side, the pole falls
        lanes, moved = step(model, settings, lanes, torch.ones(8, 1, dtype=torch.float64).numpy())
        if moved.terminated.any():
            break
    assert moved.terminated.any()
    assert not moved.truncated.any()
