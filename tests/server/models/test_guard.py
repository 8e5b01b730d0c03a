"""What a family gives is looked at before it is taken: nothing that is no prediction is ever judged or served."""

from __future__ import annotations

import pytest

from support import pendulum, unruly
from surrogym_server.convert import definition_from_spec
from surrogym_server.engine.design_job import DesignJob, run_design_job
from surrogym_server.environment.samples import Samples
from surrogym_server.errors import InvalidInput, PluginFailed
from surrogym_server.models import guard
from surrogym_server.plugins import in_one_line
from surrogym_server.sampling.design import initial_queries
from surrogym_server.virtual.single_step import predict_points
from surrogym_shared.nouns import RealStep, RealSteps
from surrogym_shared.spec import EnvironmentSpec


def job(**changes: object) -> DesignJob:
    definition = definition_from_spec(EnvironmentSpec.model_validate(pendulum.spec()))
    queries = initial_queries(definition, pendulum.BUDGET)
    steps = [RealStep(**pendulum.real_step(list(query.coordinates), list(query.action))) for query in queries]
    return DesignJob(definition, RealSteps.of(steps, "manual"), {}, pendulum.BUDGET, 0.999)


@pytest.mark.parametrize(
    ("mode", "said"),
    [
        ("nan", ": next coordinates: expected finite numbers, got nan"),
        ("reward", ": reward: expected finite numbers, got nan"),
        ("negative", r": standard deviation of 'theta': expected at least 0, got -"),
        ("shape", r": reward: expected the shape \(5,\), got \(5, 1\)"),
        ("narrow", r": next coordinates: expected the shape \(5, 2\), got \(5, 1\)"),
        ("nothing", ": expected `transition` to return a `Transition`, got NoneType"),
        ("raise", ": RuntimeError: line 1 line 2"),
        ("exit", ": SystemExit: 3"),
        ("learn.exit", ": SystemExit: 3"),
        ("learn.cancel", ": CancelledError"),
        ("learn.nothing", ": expected `learn` to return a `Learned` that contains a `DynamicsModel`, got NoneType"),
        ("warm", ": expected the warm start 'theta' to be an array of numbers, got str"),
        ("tensor", ": expected a description and structures that JSON can represent, got TypeError: "),
        ("infinite", ": expected a description and structures that JSON can represent, got ValueError: "),
    ],
)
def test_an_invalid_plugin_model_fails_the_fit_with_one_sentence(monkeypatch: pytest.MonkeyPatch, mode: str, said: str):
    monkeypatch.setattr(guard, "learner_of", lambda _: unruly.Unruly(mode))
    with pytest.raises(PluginFailed, match=f"^the model family 'gaussian_process'{said}"):
        run_design_job(job())


def test_ctrl_c_during_a_fit_raises_keyboard_interrupt(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(guard, "learner_of", lambda _: unruly.Unruly("interrupt"))
    with pytest.raises(KeyboardInterrupt):
        run_design_job(job())


def test_a_plugin_prediction_of_wrong_shape_raises(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(guard, "learner_of", lambda _: unruly.Unruly())
    made = job()
    inner = guard.learn(made.definition, Samples.of(made.samples), None).model.inner
    with pytest.raises(PluginFailed, match=r"reward: expected the shape \(5,\), got \(5, 1\)"):
        predict_points(unruly.Bent(inner, "shape"), made.samples.coordinates, made.samples.action)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (InvalidInput("expected\n  this"), "expected this"),
        (AttributeError("'NoneType' object has no attribute 'model'"), "AttributeError: 'NoneType' object has no"),
        (KeyError("x"), "KeyError: 'x'"),
        (InvalidInput(""), "InvalidInput"),
    ],
)
def test_a_plugin_exception_is_reported_in_one_short_line(error: Exception, said: str):
    assert in_one_line(error).startswith(said)
    assert "\n" not in in_one_line(error)
    assert len(in_one_line(ValueError("x" * 10_000))) < 600
