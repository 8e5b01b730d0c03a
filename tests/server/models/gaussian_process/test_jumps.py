"""Rewards that jump: sparse ones, steps with a cost, and smooth ones that must not be cut."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.models import learn
from support.plane import drifting, plane
from support.steps_in_c import check_in_c
from surrogym_server.convert import definition_from_spec
from surrogym_server.errors import InvalidInput
from surrogym_server.models.files import from_bytes, to_bytes
from surrogym_server.models.gaussian_process.model import GaussianProcessModel


def in_box(q: torch.Tensor) -> torch.Tensor:
    return ((q[:, 0] > 0.2) & (q[:, 1].abs() < 0.6)).double()


def error(model: GaussianProcessModel, pay) -> float:
    unseen = drifting(pay, 1000, seed=1)
    reward = model.transition(unseen.q, unseen.u).reward
    return float(((reward - unseen.reward).abs() > 0.1).double().mean())


def sparse(q, _):
    return in_box(q)


def until_goal(q, _):
    return torch.where(q[:, 0] > 0.5, 0.0, -1.0).double()


def cost_and_jump(q, u):
    return -0.3 * u[:, 0].square() - 0.2 * q[:, 1] + 10 * (q[:, 0] > 0.4)


def three_levels(q, _):
    return torch.where(q[:, 0] > 0.5, 4.0, torch.where(q[:, 0] < -0.5, -1.0, 0.0)).double()


@pytest.mark.parametrize(
    ("pay", "sizes", "wrong"),
    [(sparse, [1], 0.06), (until_goal, [1], 0.03), (cost_and_jump, [10], 0.03), (three_levels, [4, -1], 0.06)],
)
def test_a_reward_jump_is_found_with_its_size_and_boundary(pay, sizes, wrong):
    model = learn(definition_from_spec(plane()), drifting(pay, 60)).model
    assert sorted(abs(jump.size) for jump in model.jumps) == pytest.approx(sorted(map(abs, sizes)), abs=0.05)
    assert error(model, pay) < wrong
    assert len(model.description["jumps"]) == len(sizes)


def test_the_exported_c_step_reproduces_reward_jumps():
    unseen = drifting(three_levels, 200, seed=1)
    check_in_c(learn(definition_from_spec(plane()), drifting(three_levels, 60)).model, (unseen.q, unseen.u))


def test_a_model_with_reward_jumps_predicts_a_sparse_reward_better():
    model = learn(definition_from_spec(plane()), drifting(sparse, 60)).model
    paper = plane().model_copy(update={"design": plane().design.model_copy(update={"preset": "paper"})})
    without = learn(definition_from_spec(paper), drifting(sparse, 60)).model
    assert without.jumps == ()
    assert error(model, sparse) < 0.5 * error(without, sparse)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "pay",
    [
        lambda q, u: -q.square().sum(1) - 0.1 * u[:, 0].square(),
        lambda q, _: (3 * q[:, 0]).sin() * q[:, 1],
        lambda q, _: torch.exp(-8 * q.square().sum(1)),
        lambda q, _: torch.full((len(q),), -1.0, dtype=torch.float64),
    ],
)
def test_no_jump_is_found_in_a_smooth_reward(pay, seed):
    assert learn(definition_from_spec(plane()), drifting(pay, 14, seed)).model.jumps == ()


def test_the_reward_deviation_is_large_where_the_jump_boundary_is_uncertain():
    model = learn(definition_from_spec(plane()), drifting(until_goal, 40)).model
    inside = model.jumps[0].region.probability
    q, u = drifting(until_goal, 400, seed=2).q, torch.zeros(400, 1, dtype=torch.float64)
    predicted = model.transition(q, u, reward_std=True)
    doubtful = inside(predicted.q_next)
    expected = (doubtful * (1 - doubtful)).sqrt()
    torch.testing.assert_close(predicted.reward_std, expected, rtol=0, atol=1e-6)
    assert float(expected.max()) > 0.3


def test_reward_jumps_survive_storage_and_invalid_ones_are_refused():
    model = learn(definition_from_spec(plane()), drifting(cost_and_jump, 60)).model
    loaded = from_bytes(model.definition, to_bytes(model))
    q, u = drifting(cost_and_jump, 50, seed=2).q, torch.zeros(50, 1, dtype=torch.float64)
    assert torch.equal(loaded.transition(q, u).reward, model.transition(q, u).reward)
    assert loaded.description == model.description
    json.dumps(loaded.description, allow_nan=False)
    (jump,) = model.jumps
    for bad in (replace(jump, size=math.inf), replace(jump, region=replace(jump.region, forms=()))):
        with pytest.raises(InvalidInput):
            from_bytes(model.definition, to_bytes(replace(model, jumps=(bad,))))


def test_jump_weights_that_sum_above_1_by_rounding_give_no_negative_variance():
    """The reward's deviation was NaN there, and the design failed."""
    model = learn(definition_from_spec(plane()), drifting(sparse, 60)).model
    form = model.jumps[0].region.forms[0][1]
    weights = (0.058312872925848885, 0.9416871270741513)
    assert sum(weights) > 1
    region = replace(model.jumps[0].region, forms=tuple((weight, form) for weight in weights))
    model = replace(model, jumps=(replace(model.jumps[0], region=region),))
    unseen = drifting(sparse, 1000, seed=1)
    assert (region.probability(unseen.q) == 1).any()
    plain = model.transition(unseen.q, unseen.u, reward_std=True)
    assert plain.reward_std.isfinite().all()
    if (steps := model.compiled()) is not None:
        q, u = (np.ascontiguousarray(x) for x in (unseen.q, unseen.u))
        moved = steps(q, u, noise=None, process=None, paths=None, stds=False, reward_std=True)
        assert np.isfinite(moved.std[:, -1]).all()
