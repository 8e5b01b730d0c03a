"""Excursions: a design with snapshots tests its model away from its samples before it is ready."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from support.models import learn
from support.real_steps import join, roll
from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.features import distances
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.sampling.design import advance
from surrogym_server.sampling.excursions import FAR, excursion
from surrogym_server.sampling.rollouts import predict_paths, random_sequences
from surrogym_server.sampling.state import Conditions, DesignState, Request
from surrogym_shared.nouns import Query
from surrogym_shared.spec import EnvironmentSpec

STILL = {"kind": "uniform", "low": -0.01, "high": 0.01}  # resets lead to the top, nearly at rest
CHANGES = {"query": "rollout", "snapshots": True, "start": {"theta": STILL, "speed": STILL}}
SPEC = EnvironmentSpec.model_validate(pendulum().model_dump() | CHANGES)
DEFINITION = definition_from_spec(SPEC)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.fixture(scope="module")
def samples() -> Samples:
    """Three ways from resets: enough for a sure model."""
    sequences = random_sequences(DEFINITION, 3, 10, rng())
    return join(*(roll(SPEC, torch.from_numpy(actions), seed) for seed, actions in enumerate(sequences)))


@pytest.fixture(scope="module")
def model(samples: Samples) -> GaussianProcessModel:
    return learn(DEFINITION, samples).model


def away(model: GaussianProcessModel, start: torch.Tensor, actions: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    """Distance of each predicted state to the nearest of the known ones, (T,)."""
    reached = predict_paths(model, start[None], actions[None]).q_next[0]
    still = (Points(q, torch.zeros(len(q), 1, dtype=torch.float64)) for q in (reached, known))
    return distances(model.definition, *still).amin(1)


def test_a_rollout_that_explores_away_from_the_samples_stops_at_the_first_state_far_from_all(
    model: GaussianProcessModel,
):
    known = torch.zeros(1, 2, dtype=torch.float64)
    found = excursion(model, known, {"top": (0.0, 0.0)}, 16, rng())
    gone = away(model, known[0], torch.tensor(found.actions, dtype=torch.float64), known)
    assert gone[-1] >= FAR
    assert (gone[:-1] < FAR).all()
    shorter = torch.from_numpy(random_sequences(DEFINITION, 300, found.steps - 1, rng(1)))
    assert all(away(model, known[0], actions, known).amax() < FAR for actions in shorter)


def test_an_exploring_rollout_that_stays_near_the_samples_goes_as_far_as_possible(model: GaussianProcessModel):
    known = torch.zeros(1, 2, dtype=torch.float64)
    found = excursion(model, known, {"still": (0.0, 0.0), "moving": (0.0, 0.4)}, 2, rng())
    assert found.snapshot == "moving", "it moves away already"
    assert np.abs(found.actions) == pytest.approx(np.full((2, 1), 2.0)), "all the torque that there is"


def test_an_exploring_rollout_without_snapshots_starts_at_a_reset(model: GaussianProcessModel, samples: Samples):
    assert excursion(model, samples.q, {}, 4, rng()).snapshot is None


def request(samples: Samples, budget: int = 60, **options: Any) -> Request:
    snapshots = {str(number): tuple(state) for number, state in enumerate(samples.q_next.tolist())}
    return Request(budget=budget, target=0.9, snapshots=snapshots, **options)


def test_a_confident_design_with_snapshots_is_ready_only_after_an_exploring_rollout(samples: Samples):
    first = advance(DEFINITION, samples, DesignState(), request(samples))
    assert first.verdict == "continue"
    (rollout,) = first.queries
    lost = advance(DEFINITION, samples, first.state, request(samples))
    assert lost.verdict == "continue", "its query was withdrawn, so another excursion is due"
    assert len(lost.queries) == 1
    answered = join(samples, roll(SPEC, rollout.actions, 7))
    state = DesignState.from_json(first.state.to_json())
    assert advance(DEFINITION, answered, state, request(answered)).verdict == "ready"


def test_a_design_whose_budget_is_too_small_for_an_exploring_rollout_ends_over_budget(samples: Samples):
    decision = advance(DEFINITION, samples, DesignState(), request(samples, len(samples)))
    assert decision.verdict == "over_budget"
    assert not decision.queries
    raised = advance(DEFINITION, samples, decision.state, request(samples))
    assert len(raised.queries) == 1, "once there is room, the excursion is due"


def test_a_log_does_not_answer_an_open_exploring_rollout(samples: Samples):
    first = advance(DEFINITION, samples, DesignState(), request(samples))
    (rollout,) = first.queries
    logged = join(samples, roll(SPEC, torch.zeros(2, 1, dtype=torch.float64), 11))
    waiting = request(logged, pending=first.queries, open=rollout.steps, logged=2)
    second = advance(DEFINITION, logged, first.state, waiting)
    assert (second.verdict, second.queries) == ("continue", ())
    lost = advance(DEFINITION, logged, second.state, request(logged, logged=2))
    assert (lost.verdict, len(lost.queries)) == ("continue", 1), "its query was withdrawn, so another excursion is due"
    answered = join(logged, roll(SPEC, rollout.actions, 7))
    assert advance(DEFINITION, answered, second.state, request(answered, logged=2)).verdict == "ready"


def test_a_design_ends_unsure_if_the_environment_refuses_too_many_exploring_rollouts(samples: Samples):
    """It is sure of its model, so without a limit it would request another excursion for ever."""

    def decide(refusals: int) -> tuple[str, int]:
        refused = (Query.rollout([[0.0]]),) * refusals
        decision = advance(DEFINITION, samples, DesignState(), request(samples, refused=refused))
        return decision.verdict, len(decision.queries)

    limit = 60 + len(samples)
    assert (decide(limit), decide(limit - 1)) == (("unsure", 0), ("continue", 1))


def test_an_ended_design_takes_no_exploring_rollout_after_an_audit(samples: Samples):
    """Its tolerances are declared, so the audit changes nothing under which it ended."""
    tolerances = advance(DEFINITION, samples, DesignState(), request(samples)).tolerances
    declared = DEFINITION.with_tolerances(dict(zip(DEFINITION.outputs, tolerances, strict=True)))
    conditions = Conditions(len(samples), 60, 0.9, tolerances)
    ended = DesignState(round=1, ended_under=conditions, ended_as="unsure")
    audited = join(samples, roll(SPEC, torch.zeros(2, 1, dtype=torch.float64), 11))
    after = advance(declared, audited, ended, request(audited, audited=2))
    assert (after.verdict, after.queries, after.state.ended_as) == ("unsure", (), "unsure")
    raised = advance(declared, audited, after.state, request(audited, 61, audited=2))
    assert (raised.verdict, len(raised.queries)) == ("continue", 1)


def test_without_snapshots_or_in_preset_paper_no_exploring_rollout_is_needed(samples: Samples):
    plain = replace(DEFINITION, snapshots=False)
    assert advance(plain, samples, DesignState(), request(samples)).verdict == "ready"
    paper = replace(DEFINITION, design=replace(DEFINITION.design, stopping="confidence"))
    assert advance(paper, samples, DesignState(), request(samples)).verdict == "ready"
