"""A family with none of the abilities is asked as its fallbacks say: by distance, step by step, without tests."""

import numpy as np
import pytest
import torch

from support.exact_models import exact_pendulum
from surrogym_server.environment.features import distances
from surrogym_server.environment.points import Points
from surrogym_server.models.abilities import LeaveOneOut, PredictedSteps, offers
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.batch import choose
from surrogym_server.sampling.candidates import Candidates
from surrogym_server.sampling.confidence import confidences_of, stds
from surrogym_server.sampling.endings import edge_in_doubt
from surrogym_server.sampling.lookahead import as_if_answered, outlook_of, path_outlook
from surrogym_server.sampling.rollouts import Aim, plan_round
from surrogym_shared.nouns import Query

TOLERANCES = [0.1, 0.1, 0.1]


@pytest.fixture
def plain() -> DynamicsModel:
    """It deviates by 0.5 in both coordinates, and more in the reward the farther from 0 the speed is."""
    exact = exact_pendulum()
    return type(exact)(exact.definition, exact.move, exact.pay, 0.5, lambda q: 0.1 * q[:, 1].abs())


@pytest.fixture
def candidates(points) -> Points:
    return Points(*points)


def test_a_model_without_leave_one_out_predictions_reports_no_such_errors(plain, candidates):
    assert offers(plain, LeaveOneOut) is None
    judged = confidences_of(plain, candidates, stds(plain, candidates.q, candidates.u), TOLERANCES)
    assert {(j.leave_one_out_error, j.leave_one_out_within_one) for j in judged} == {(None, None)}


def test_if_a_model_cannot_predict_variance_a_query_is_assumed_to_lower_uncertainty_nearby(plain, candidates):
    reference = candidates[30:]
    outlook = outlook_of(plain, candidates, reference, candidates[:0])[2]
    torch.testing.assert_close(outlook.std, 0.1 * candidates.q[:, 1].abs())
    here = torch.zeros(30, dtype=torch.float64)
    here[4] = 1.0
    reduction = outlook.reduction(here)
    assert int(reduction.argmax()) == 34
    assert float(reduction[34]) == pytest.approx(float(outlook.std[34]) ** 2)
    after = outlook.observe(34)
    assert float(after.std[34]) == 0
    assert bool((after.std <= outlook.std).all())
    assert float(after.reduction(here).max()) == 0


def test_if_a_model_cannot_predict_variance_pending_and_observed_queries_have_equal_effect(plain, candidates):
    observed = [o.observe(4).observe(9) for o in outlook_of(plain, candidates, candidates, candidates[:0])]
    assumed = outlook_of(plain, candidates, candidates, candidates[[4, 9]])
    for one, other in zip(observed, assumed, strict=True):
        torch.testing.assert_close(one.std, other.std)


def test_if_a_model_cannot_predict_variance_a_batch_of_queries_is_spread_out(plain, candidates):
    made = Candidates(candidates, torch.zeros(60), candidates, torch.full((60,), 1 / 60, dtype=torch.float64))
    nothing = candidates[:0]
    picks = choose(plain, made, nothing, nothing, [0, 0, 0, 0], TOLERANCES)
    assert len(set(picks)) == 4
    apart = distances(plain.definition, candidates[picks], candidates[picks])
    assert float(apart[~torch.eye(4, dtype=torch.bool)].min()) > 1


def test_without_joint_covariance_the_information_of_a_path_is_summed_over_its_steps(plain, candidates):
    steps = PredictedSteps(*(t.reshape(2, 30, -1) for t in (candidates.q, candidates.u, candidates.q)))
    along = path_outlook(plain, steps, 0)
    weight = torch.ones(2, 30, dtype=torch.float64)
    information = along.information(weight, 0.1)
    torch.testing.assert_close(information[:, -1], torch.full((2,), 30 * 0.5 * np.log1p(25.0), dtype=torch.float64))
    assert as_if_answered(plain, steps) is plain


def test_rollouts_can_be_planned_with_a_model_that_has_only_required_methods(plain):
    aim = Aim([0, 1], TOLERANCES, longest=5)
    rollouts = plan_round(plain, aim, 8, [Query.rollout([[0.0]] * 3)], np.random.default_rng(0))
    assert sum(query.steps for query in rollouts) == 8


def test_a_model_without_reward_jumps_has_no_uncertain_reward_boundary(plain, candidates):
    assert float(edge_in_doubt(plain, candidates.q, candidates.q).max()) == 0
