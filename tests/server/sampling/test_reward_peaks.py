"""Where a reward that hides is highest is looked for, met, and then known."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from support.hidden_bump import HiddenBump
from support.models import gaussian_processes
from support.plane import drifting, plane
from surrogym import Design
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples
from surrogym_server.sampling.judging import monte_carlo
from surrogym_server.sampling.reward_peaks import highest
from surrogym_shared.spec import Inequality, Term

DEFINITION = definition_from_spec(plane())
POINTS = Points(*monte_carlo(DEFINITION))[:500]
PLACE = torch.tensor([0.3, -0.2], dtype=torch.float64)


def bump(q: torch.Tensor, _: torch.Tensor) -> torch.Tensor:
    return (-0.5 * ((q - PLACE) / 0.02).square().sum(-1)).exp()


def looked_for(samples, tolerance: float = 0.01) -> Points | None:
    model = gaussian_processes(DEFINITION, samples)
    return highest(model, samples, POINTS, tolerance, np.random.default_rng(0))


def test_the_predicted_place_of_an_unreached_reward_peak_is_queried():
    samples = drifting(bump, 12)
    assert float(samples.reward.max()) < 0.01
    found = looked_for(samples)
    assert found is not None
    arrives = found.q + 0.1 * found.u[:, :1]
    assert float((arrives - PLACE).norm()) < 0.02


def test_the_search_for_a_reward_peak_queries_no_terminal_state():
    """A reward that is highest behind the line at which episodes end."""
    right = Inequality(term=Term.linear(x=1), relation=">", value=0.1)
    definition = definition_from_spec(plane().model_copy(update={"termination": ((right,),)}))
    samples = drifting(bump, 24)
    left = samples.q[:, 0] <= 0.1
    going = Samples(*(getattr(samples, field.name)[left] for field in fields(samples)))
    model = gaussian_processes(definition, going)
    found = highest(model, going, POINTS, 1e-9, np.random.default_rng(0))
    assert found is not None
    assert not bool(definition.terminated(found.q).any())


def test_the_search_for_a_reward_peak_ends_once_it_was_reached():
    samples = drifting(bump, 12)
    q, u = PLACE[None], torch.zeros(1, 1, dtype=torch.float64)
    met = replace(
        samples,
        q=torch.cat([samples.q, q]),
        u=torch.cat([samples.u, u]),
        q_next=torch.cat([samples.q_next, q]),
        reward=torch.cat([samples.reward, torch.ones(1, dtype=torch.float64)]),
        terminated=torch.cat([samples.terminated, torch.zeros(1, dtype=torch.bool)]),
    )
    assert looked_for(met) is None


def test_the_design_searches_no_reward_peak_if_the_reward_is_smooth():
    assert looked_for(drifting(lambda q, _: -q.square().sum(-1), 12)) is None


def constant(value: float) -> Samples:
    return drifting(lambda q, _: torch.full((len(q),), value, dtype=torch.float64), 12)


def test_if_all_rewards_are_zero_the_point_farthest_from_the_samples_is_queried():
    samples = constant(0.0)
    found = looked_for(samples)
    assert found is not None
    nearest = torch.cdist(POINTS.q, samples.q).amin(1)
    assert float(torch.cdist(found.q, samples.q).min()) == pytest.approx(float(nearest.max()))


def test_the_design_searches_no_reward_peak_if_every_reward_is_the_same_nonzero_value():
    assert looked_for(constant(-1.0)) is None


@pytest.mark.parametrize("seed", [0, 1])
def test_the_design_finds_a_narrow_reward_peak_within_twenty_steps(seed):
    bump = HiddenBump(seed=seed)
    design, met = Design(bump.spec(), budget=20), []
    while (query := design.ask()) is not None:
        step = bump.step_from(query.coordinates, query.action)
        design.tell(query, step)
        met.append(step.reward)
    assert design.phase == "ready"
    assert max(met) > 0.9
    x, u = torch.tensor(bump.place)[None], torch.zeros(1, 2, dtype=torch.float64)
    assert float(design.surrogate().model.transition(x, u).reward) == pytest.approx(1, abs=0.05)
