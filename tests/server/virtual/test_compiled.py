"""Compiled steps agree with those of torch, on every kind of environment and settings, and torch steps where there are
none."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch

from support.kinds import ENVIRONMENTS
from support.models import gaussian_processes
from support.real_steps import random_steps
from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.errors import NotReset
from surrogym_server.models.gaussian_process import model as gaussian_process_model
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.testing.cases import model_cases
from surrogym_server.virtual import LaneState, LaneTransition, VirtualSettings, create, in_fastest_form, reset, step
from surrogym_shared import compiled
from surrogym_shared.spec import EnvironmentSpec, Limit, Limits, Term

needs_numba = pytest.mark.skipif(not compiled.available(), reason="numba is not installed, or switched off")
LANES, STEPS = 7, 5
CHOICES: dict[str, dict[str, Any]] = {
    "mean": {},
    "penalty, same step": {"penalty": 3.0, "autoreset_mode": "same_step", "time_limit": 3},
    "drawn functions": {
        "variant": "pathwise",
        "functions": 3,
        "penalty": 1.0,
        "autoreset_mode": "same_step",
        "time_limit": 3,
    },
    "draws in each step": {"variant": "probabilistic", "particles": 1, "spread": 0.0, "penalty": 1.0},
    "particles": {
        "variant": "probabilistic",
        "particles": 4,
        "process_noise": True,
        "autoreset_mode": "same_step",
        "time_limit": 3,
    },
    "particles with trust": {"variant": "probabilistic", "particles": 3, "trust": 0.5},
    "noisy sensors": {"process_noise": True, "autoreset_mode": "same_step", "time_limit": 2},
    "visited starts": {"penalty": 1.0, "autoreset_mode": "same_step", "time_limit": 3},
    "noise, trust, box": {"process_noise": True, "trust": 0.05, "start_box": 0.5, "time_limit": 2},
}
CASES = {f"case: {case}": case for case in model_cases("gaussian_process")}


@pytest.fixture(scope="module", params=[*CASES, *ENVIRONMENTS])
def model(request: pytest.FixtureRequest) -> GaussianProcessModel:
    if request.param in CASES:
        case = CASES[request.param]
        return gaussian_processes(case.definition, case.samples)
    spec = ENVIRONMENTS[request.param]()
    return gaussian_processes(definition_from_spec(spec), random_steps(spec, 20, seed=0))


def compiled_settings(model: GaussianProcessModel, **chosen: Any) -> VirtualSettings:
    settings = in_fastest_form(VirtualSettings(LANES, **chosen), model)
    assert settings.compiled
    return settings


def actions(model: GaussianProcessModel, rng: np.random.Generator) -> np.ndarray:
    action = model.definition.action
    if action.nvec:
        return rng.integers(action.nvec, size=(LANES, action.size)).astype(float)
    return rng.uniform(*model.definition.action_limits, (LANES, action.size))


def require_agreement(one: tuple[LaneState, LaneTransition], other: tuple[LaneState, LaneTransition]) -> None:
    """Flags and counts are the same, numbers to 1e-8 of the largest; variances near 0 lose half of their digits."""
    for ours, theirs in zip(one, other, strict=True):
        for field in fields(ours):
            a, b = getattr(ours, field.name), getattr(theirs, field.name)
            assert (a is None) == (b is None), field.name
            if a is None:
                continue
            a, b = np.asarray(a), np.asarray(b)
            assert (a.dtype, a.shape) == (b.dtype, b.shape), field.name
            tolerance = 2e-6 if field.name == "std" or a.dtype == np.float32 else 1e-8
            np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance, err_msg=field.name)


@needs_numba
@pytest.mark.parametrize("choice", CHOICES)
def test_compiled_steps_agree_with_torch(model, choice):
    settings, rng = compiled_settings(model, **CHOICES[choice]), np.random.default_rng(0)
    if choice == "noisy sensors":
        first = model.definition.coordinate_names[model.definition.moving[0]]
        settings = replace(settings, sensor_noise=((first, 0.1),))
    lanes, _ = reset(model.definition, settings, create(model.definition, settings, 0))
    if choice == "visited starts":  # which compiled code must find again
        settings = replace(settings, start_visited=0.5, visited=lanes.q + 0.01)
    for count in range(STEPS):
        u = actions(model, rng)
        made = step(model, settings, lanes, u, stds=count % 2 == 1)
        require_agreement(made, step(model, replace(settings, compiled=False), lanes, u, stds=count % 2 == 1))
        lanes = made[0]


@needs_numba
def test_compiled_steps_with_a_mask_agree_with_torch(model):
    settings, rng = compiled_settings(model, time_limit=2), np.random.default_rng(0)
    lanes, _ = reset(model.definition, settings, create(model.definition, settings, 0))
    for _ in range(STEPS):
        u, mask = actions(model, rng), rng.random(LANES) < 0.6
        mask.flags.writeable = False  # as that of a message is
        made = step(model, settings, lanes, u, mask)
        require_agreement(made, step(model, replace(settings, compiled=False), lanes, u, mask))
        lanes = made[0]


@needs_numba
def test_compiled_steps_refuse_environments_that_were_never_reset(model):
    settings = compiled_settings(model)
    with pytest.raises(NotReset):
        step(model, settings, create(model.definition, settings, 0), actions(model, np.random.default_rng(0)))


@needs_numba
def test_compiled_steps_do_not_modify_their_input_state(model):
    settings = compiled_settings(model, autoreset_mode="same_step", time_limit=1)
    lanes, _ = reset(model.definition, settings, create(model.definition, settings, 0))
    before = {name: array.copy() for name, array in lanes.to_arrays().items()}
    after, _ = step(model, settings, lanes, actions(model, np.random.default_rng(0)))
    for name, array in lanes.to_arrays().items():
        np.testing.assert_array_equal(array, before[name])
    assert (after.episode == lanes.episode + 1).all()


def test_a_session_without_numba_steps_with_torch(model, monkeypatch):
    monkeypatch.setattr(compiled, "available", lambda: False)
    fresh = replace(model)  # what it has compiled is not kept
    settings = VirtualSettings(LANES)
    assert in_fastest_form(settings, fresh) == settings
    lanes, _ = reset(model.definition, settings, create(model.definition, settings, 0))
    u = actions(model, np.random.default_rng(0))
    ours, theirs = (step(fresh, chosen, lanes, u) for chosen in (replace(settings, compiled=True), settings))
    for field in fields(LaneTransition):
        np.testing.assert_array_equal(getattr(ours[1], field.name), getattr(theirs[1], field.name))


def test_a_session_whose_model_fails_to_compile_steps_with_torch(model, monkeypatch, caplog):
    def fails(_: GaussianProcessModel) -> None:
        raise RuntimeError("no code for this processor")

    monkeypatch.setattr(GaussianProcessModel, "compiled", fails)
    assert not in_fastest_form(VirtualSettings(LANES), model).compiled
    assert "torch computes them" in caplog.text


def test_deviations_of_a_model_with_many_points_are_computed_with_torch(monkeypatch):
    case = CASES["case: learned reward"]
    model = gaussian_processes(case.definition, case.samples)
    monkeypatch.setattr(gaussian_process_model, "COMPILED_SOLVES", len(case.samples.q) - 1)
    assert not in_fastest_form(VirtualSettings(LANES, penalty=1.0), model).compiled
    assert in_fastest_form(VirtualSettings(LANES), model).compiled == compiled.available()


@needs_numba
@pytest.mark.parametrize("choice", ["mean", "penalty, same step", "drawn functions", "noise, trust, box"])
@pytest.mark.parametrize("time_limit", [None, 3])
def test_compiled_steps_agree_with_torch_when_the_sampling_range_is_left(choice, time_limit):
    """Lanes leave the sampling range, or what is trusted, in this step or in a later one."""
    slow = pendulum().model_dump() | {"outside_reward": -7.0}
    slow["coordinates"][1]["sampling"] = {"kind": "uniform", "low": -1.0, "high": 1.0}
    spec, rng = EnvironmentSpec.model_validate(slow), np.random.default_rng(0)
    model = gaussian_processes(definition_from_spec(spec), random_steps(spec, 20, seed=0))
    settings = compiled_settings(model, **CHOICES[choice] | {"time_limit": time_limit, "autoreset_mode": "same_step"})
    lanes, _ = reset(model.definition, settings, create(model.definition, settings, 0))
    fast = torch.tensor([[0.0, 6.0], [0.1, 0.2]], dtype=torch.float64).repeat(LANES, 1)[:LANES]
    left, lanes = 0, replace(lanes, q=fast)
    for _ in range(STEPS):
        u = actions(model, rng)
        made = step(model, settings, lanes, u, stds=True)
        require_agreement(made, step(model, replace(settings, compiled=False), lanes, u, stds=True))
        left, lanes = left + int(made[1].left.sum()), made[0]
    assert left >= 4


@needs_numba
@pytest.mark.parametrize("choice", ["mean", "penalty, same step", "drawn functions", "noise, trust, box"])
def test_compiled_steps_and_torch_end_episodes_equally_near_a_declared_limit(choice):
    """It ends before the limit, where the fallback would act, and pays for the steps that it lacks."""
    limit = Limit(name="speed", term=Term.linear(speed=1.0), low=-4.0, high=4.0, margin=0.5)
    limits = Limits(keep=(limit,), fallback=(Term.constant(0.0),)).model_dump()
    narrow = {name: {"kind": "uniform", "low": -0.1, "high": 0.1} for name in ("theta", "speed")}
    spec = EnvironmentSpec.model_validate({**pendulum().model_dump(), "start": narrow, "limits": limits})
    model = gaussian_processes(definition_from_spec(spec), random_steps(spec, 20, seed=0))
    chosen = CHOICES[choice] | {"time_limit": 10, "autoreset_mode": "same_step", "reward_limits": (-17.0, 1.0)}
    settings, u = compiled_settings(model, **chosen), np.zeros((LANES, 1))
    lanes, _ = reset(model.definition, settings, create(model.definition, settings, 0))
    fast = torch.tensor([[2.0, 3.3], [0.0, 0.0]], dtype=torch.float64).repeat(LANES, 1)[:LANES]
    lanes = replace(lanes, q=fast)
    made = step(model, settings, lanes, u, stds=True)
    require_agreement(made, step(model, replace(settings, compiled=False), lanes, u, stds=True))
    left = made[1].left
    assert left is not None
    assert left.tolist() == [lane % 2 == 0 for lane in range(LANES)]
    assert made[1].terminated[left].all()
    assert made[1].reward_mean[left].tolist() == [-170.0] * int(left.sum())
