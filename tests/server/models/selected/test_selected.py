"""The family as a whole: what it serves, what it keeps, and what it refuses."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
import torch

from support.selected import mixed_cases
from surrogym_server.convert import definition_from_spec
from surrogym_server.errors import InvalidSpec
from surrogym_server.models.abilities import (
    CompiledSteps,
    FunctionDraws,
    LearnedNoise,
    LeaveOneOut,
    Lookahead,
    UncertainHyperparameters,
    offers,
)
from surrogym_server.models.files import from_bytes, to_bytes
from surrogym_server.models.registry import learner_of
from surrogym_server.models.selected import SelectedFamilies
from surrogym_server.models.selected.selection import SERVING, WON
from surrogym_server.models.singles import BUILT_IN
from surrogym_server.plugins import Choice
from surrogym_server.sampling.design import DesignState
from surrogym_server.testing import ModelCase, model_cases
from surrogym_server.testing.cases import PENDULUM
from surrogym_shared.spec import EnvironmentSpec

PROCESS, SPARSE, ENSEMBLE = "gaussian_process", "sparse_gaussian_process", "ensemble"
QUICK = {"steps": 50}


def case_of(settings: dict[str, float | str], samples: int = 24) -> ModelCase:
    return model_cases("selected", QUICK | settings, samples)[0]


def test_few_smooth_samples_are_served_by_processes_and_as_by_them_alone() -> None:
    case, alone = case_of({}), model_cases(PROCESS)[0]
    model = case.model
    assert model.description["selection"]["serving"] == [PROCESS] * 3
    q, u = case.points.q, case.points.u
    assert torch.equal(model.transition(q, u).q_next, alone.model.transition(q, u).q_next)
    assert [output["family"] for output in model.description["outputs"]] == [PROCESS] * 3


def test_networks_that_serve_at_first_give_way_to_processes_at_once_then_after_two_fits() -> None:
    """The order of the candidates does not decide, and a state that has served is left only after two fits."""
    case = case_of({"candidates": f"{ENSEMBLE}, {PROCESS}"})
    assert case.model.description["selection"]["serving"] == [PROCESS] * 3
    warm = {SERVING: np.zeros(3), WON: np.zeros((3, 2))}
    served = []
    for _ in range(2):
        learned = case.learner.learn(case.definition, case.samples, warm)
        served.append(learned.model.description["selection"]["serving"])
        state = DesignState(warm=learned.warm)
        warm = DesignState.from_json(state.to_json()).warm  # as it is stored with the model
    assert served == [[ENSEMBLE] * 3, [PROCESS] * 3]


def test_scores_are_in_the_stored_model() -> None:
    case = case_of({})
    selection = from_bytes(case.definition, to_bytes(case.model)).description["selection"]
    assert selection == case.model.description["selection"]
    held = selection["held_out"]
    assert (held["kind"], held["pieces"], held["horizons"], held["folds"]) == ("steps", 24, [1], 5)
    assert [one["family"] for one in selection["standings"][0]] == [PROCESS, ENSEMBLE]
    assert held["notes"] == [f"{SPARSE} is the same as {PROCESS} with at most 300 samples"]


def test_a_candidate_that_fails_is_named_and_the_others_serve(monkeypatch: pytest.MonkeyPatch) -> None:
    from surrogym_server.models.ensemble import NetworkEnsembles

    def fails(*_: object) -> None:
        raise ValueError("no networks today")

    monkeypatch.setattr(NetworkEnsembles, "learn", fails)
    selection = case_of({}).model.description["selection"]
    assert "ensemble failed: ValueError: no networks today" in selection["held_out"]["notes"]
    assert selection["serving"] == [PROCESS] * 3


def test_a_few_samples_are_not_compared() -> None:
    selection = case_of({}, 5).model.description["selection"]
    assert selection["held_out"]["kind"] == "none"
    assert selection["standings"] == [[], [], []]


def test_abilities_are_those_of_all_parts() -> None:
    process = case_of({}).model
    networks = mixed_cases((PROCESS, ENSEMBLE, PROCESS), QUICK)[0].model
    both = mixed_cases((PROCESS, SPARSE, PROCESS), QUICK)[0].model
    for ability in (LeaveOneOut, Lookahead, LearnedNoise, UncertainHyperparameters, FunctionDraws):
        assert offers(process, ability) is not None
        assert offers(both, ability) is not None
    assert offers(process, CompiledSteps) is not None
    assert [offers(networks, ability) for ability in (LeaveOneOut, Lookahead, CompiledSteps)] == [None] * 3
    noise = offers(networks, LearnedNoise)
    assert noise is not None
    assert noise.noise_deviations[1] > 0
    assert offers(process, LearnedNoise).noise_deviations[1] != noise.noise_deviations[1], "that of the networks"  # type: ignore[union-attr]


def test_each_output_is_predicted_by_its_own_family() -> None:
    mixed = mixed_cases((PROCESS, ENSEMBLE, PROCESS), QUICK)[0]
    learners = mixed.learner.family.learners  # type: ignore[attr-defined]
    parts = {name: learners[name].learn(mixed.definition, mixed.samples).model for name in (PROCESS, ENSEMBLE)}
    q, u = mixed.points.q, mixed.points.u
    made = mixed.model.transition(q, u, deviations=True)
    process, networks = (parts[name].transition(q, u, deviations=True) for name in (PROCESS, ENSEMBLE))
    assert torch.equal(made.q_next[:, 0], process.q_next[:, 0])
    assert torch.equal(made.q_next[:, 1], networks.q_next[:, 1])
    assert made.deviation is not None
    assert torch.equal(made.deviation[:, 1], networks.deviation[:, 1])  # type: ignore[index]


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"candidates": PROCESS}, "at least two different families"),
        ({"candidates": f"{PROCESS}, {PROCESS}"}, "at least two different families"),
        ({"candidates": f"{PROCESS}, selected"}, "candidate: expected one of gaussian_process"),
        ({"margin": -1.0}, "expected margin to be a number from 0 to 10"),
        ({"members": 1}, "expected members to be a whole number from 2"),
        ({"kernel": "none"}, "expected kernel to be one of"),
    ],
)
def test_wrong_settings_are_refused(settings: dict[str, float | str], said: str) -> None:
    with pytest.raises(InvalidSpec, match=said):
        learner_of(Choice("selected", tuple(settings.items())))


def test_settings_reach_the_candidates() -> None:
    family = learner_of(Choice("selected", (("symmetry", "none"), ("members", 3), ("inducing", 50))))
    learners = family.learners  # type: ignore[attr-defined]
    assert (learners[PROCESS].symmetry, learners[SPARSE].inducing, learners[ENSEMBLE].members) == ("none", 50, 3)


def test_every_setting_of_a_built_in_family_can_be_given() -> None:
    """A setting that ``selected`` lacks keeps its default there, as the ensemble's ``beta`` did."""
    own = {field.name for field in fields(SelectedFamilies)}
    lacking = {name: sorted({field.name for field in fields(kind)} - own) for name, kind in BUILT_IN.items()}  # type: ignore[arg-type]
    assert not any(lacking.values()), lacking


def test_the_preset_of_the_paper_has_one_family() -> None:
    spec = EnvironmentSpec.model_validate(PENDULUM | {"design": {"preset": "paper", "model": "selected"}})
    with pytest.raises(InvalidSpec, match="expected another family than 'selected'"):
        definition_from_spec(spec)
