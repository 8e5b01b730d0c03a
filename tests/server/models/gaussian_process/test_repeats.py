"""Outputs that do the same with inputs of their own share samples, by evidence, and the same in every computation."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from support.models import gaussian_processes
from support.predictions import WAYS, check_compiled, check_processes
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.samples import Samples
from surrogym_server.errors import InvalidInput
from surrogym_server.models.files import from_bytes, to_bytes
from surrogym_server.models.gaussian_process.codec.outputs import require_output
from surrogym_server.models.gaussian_process.learning import repeats
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.description import describe
from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Term, Uniform

NAMES = ("first", "second", "third", "fourth")
SAMPLES = 24


def spec(design: object = None, **model: object) -> EnvironmentSpec:
    """Four tanks in series, each of which drains into the next."""
    ranges = {name: Uniform(low=0.1, high=1) for name in NAMES}
    made = EnvironmentSpec(
        coordinates=tuple(Coordinate(name=n, sampling=r) for n, r in ranges.items()),
        observation=tuple(ObservationEntry(name=n, term=Term.linear(**{n: 1})) for n in NAMES),
        action=BoxAction(low=(-1,), high=(1,)),
        start=ranges,
        time_limit=50,
    )
    chosen = design or {"model": {"name": "gaussian_process", "settings": model}}
    return made.model_copy(update={"design": made.design.model_validate(chosen)})


ROW = definition_from_spec(spec())
APART = definition_from_spec(spec(repeated_parts=False))


def steps(count: int, seed: int, narrow: float = 0.2) -> Samples:
    """``narrow`` is the last tank's valve."""
    p = torch.rand(count, 5, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    q, u = 0.1 + 0.9 * p[:, :4], 2 * p[:, 4:] - 1
    out = torch.tensor([0.2, 0.2, 0.2, narrow], dtype=torch.float64) * q.sqrt()
    into = torch.cat([0.1 + 0.1 * u, out[:, :-1]], 1)
    return Samples(q, u, q + into - out, -((q[:, 3] - 0.5) ** 2), torch.zeros(count, dtype=torch.bool))


def error(model: GaussianProcessModel, column: int) -> float:
    test = steps(400, 9)
    return float((model.transition(test.q, test.u).q_next - test.q_next)[:, column].square().mean().sqrt())


@pytest.fixture(scope="module")
def model() -> GaussianProcessModel:
    return gaussian_processes(ROW, steps(SAMPLES, 0))


@pytest.fixture(scope="module")
def points() -> tuple[Tensor, Tensor]:
    test = steps(50, 7)
    return test.q, test.u


def test_outputs_of_tanks_with_equal_dynamics_are_learned_from_shared_samples(model):
    assert [set(output.shared) for output in model.transitions] == [
        set(),
        {"third", "fourth"},
        {"second", "fourth"},
        {"second", "third"},
    ]
    assert [len(output.posterior.y) for output in model.transitions] == [SAMPLES, *[3 * SAMPLES] * 3]
    assert "with samples of" in model.structures[1]
    assert describe(ROW, model.transitions[1])["shares_samples_with"] == list(model.transitions[1].shared)


def test_predictions_are_much_better_with_shared_samples(model):
    apart = gaussian_processes(APART, steps(SAMPLES, 0))
    assert not any(output.shared for output in apart.outputs)
    for column in (1, 2, 3):
        assert error(model, column) < 0.3 * error(apart, column)


def test_errors_of_a_model_with_shared_samples_are_within_its_deviations(model):
    test = steps(400, 9)
    moved = model.transition(test.q, test.u, stds=True)
    within = (moved.q_next - test.q_next).abs() <= 1.645 * moved.std + 1e-4
    assert float(within[:, 1:].double().mean()) > 0.85


def test_the_output_of_a_tank_with_different_dynamics_shares_no_samples():
    model = gaussian_processes(ROW, steps(SAMPLES, 0, narrow=0.25))
    assert model.transitions[3].shared == ()
    assert model.transitions[1].shared == ("third",)


def test_with_preset_paper_no_samples_are_shared_between_outputs():
    paper = definition_from_spec(spec({"preset": "paper"}))
    assert not any(output.shared for output in gaussian_processes(paper, steps(SAMPLES, 0)).outputs)


def test_with_many_samples_no_samples_are_shared_between_outputs(model):
    """With many samples each tank is known without the others."""
    known = gaussian_processes(ROW, steps(100, 0))
    assert not any(output.shared for output in known.outputs)


def test_the_number_of_samples_an_output_takes_from_others_is_limited(monkeypatch):
    monkeypatch.setattr(repeats, "MOST", 40)
    model = gaussian_processes(ROW, steps(SAMPLES, 0))
    assert max(len(output.posterior.y) for output in model.transitions) == 40


def test_a_model_with_shared_samples_predicts_the_posteriors_of_its_gaussian_processes(model, points):
    check_processes(model, points)


@pytest.mark.parametrize("how", WAYS)
def test_compiled_steps_of_outputs_that_share_their_samples_equal_the_model(model, points, how):
    check_compiled(model, points, how)


def test_a_stored_model_keeps_which_outputs_share_samples(model, points):
    loaded = from_bytes(ROW, to_bytes(model))
    assert isinstance(loaded, GaussianProcessModel)
    assert [o.shared for o in loaded.outputs] == [o.shared for o in model.outputs]
    torch.testing.assert_close(loaded.transition(*points).q_next, model.transition(*points).q_next, rtol=0, atol=0)


@pytest.mark.parametrize("shared", [("fifth",), ("reward",)])
def test_a_stored_model_that_shares_samples_with_an_output_other_than_a_transition_is_refused(model, shared):
    with pytest.raises(InvalidInput, match="`shared`"):
        require_output(ROW, replace(model.transitions[1], shared=shared))
