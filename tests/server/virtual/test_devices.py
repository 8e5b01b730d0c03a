"""Steps on every device that this machine has agree with those on the CPU, and nothing of them stays behind there."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode

from support.models import learn
from support.real_steps import random_steps
from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.gp import serving
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.tensors import CPU, to_device
from surrogym_server.virtual import LaneState, LaneTransition, VirtualSettings, create, environment, reset, step

LANES, STEPS = 6, 4
VARIANTS: dict[str, dict[str, Any]] = {
    "deterministic": {"penalty": 3.0},
    "noisy, trusted": {"process_noise": True, "trust": 10.0, "start_box": 0.5},
    "probabilistic": {"variant": "probabilistic", "particles": 8},
    "pathwise": {"variant": "pathwise"},
}


@pytest.fixture(scope="module", params=["pendulum", "learned ending", "paper"])
def model(request: pytest.FixtureRequest) -> GaussianProcessModel:
    spec = cartpole() if request.param == "learned ending" else pendulum()
    if request.param == "paper":
        spec = spec.model_copy(update={"design": spec.design.model_copy(update={"preset": "paper"})})
    if request.param == "learned ending":
        spec = spec.model_copy(update={"termination": "learned"})
    return learn(definition_from_spec(spec), random_steps(spec, 14, seed=0)).model


def run(model: GaussianProcessModel, settings: VirtualSettings) -> tuple[LaneState, list[LaneTransition]]:
    """Some steps from a seeded reset, some lanes of which are reset again."""
    definition, rng = model.definition, np.random.default_rng(0)
    low, high = definition.action_limits
    lanes, _ = reset(definition, settings, create(definition, settings, 0), list(range(LANES)))
    made = []
    for _ in range(STEPS):
        lanes, moved = step(model, settings, lanes, rng.uniform(low, high, (LANES, definition.action.size)).round())
        made.append(moved)
    lanes, _ = reset(definition, settings, lanes, mask=np.arange(LANES) % 2 == 0)
    return lanes, made


@pytest.mark.parametrize("variant", VARIANTS)
def test_virtual_steps_on_every_device_agree_with_those_on_the_cpu(model, variant, device):
    settings = VirtualSettings(LANES, autoreset_mode="same_step", time_limit=3, **VARIANTS[variant])
    here, there = run(model, settings), run(model.on(device), settings)
    assert {getattr(there[0], field.name).device.type for field in fields(LaneState)} == {device.type}
    for ours, theirs in zip(here[1], there[1], strict=True):
        for field in fields(LaneTransition):
            if (expected := getattr(ours, field.name)) is not None:
                np.testing.assert_allclose(getattr(theirs, field.name), expected, rtol=1e-6, atol=1e-6)


def test_moving_a_model_to_a_device_copies_all_tensors_and_keeps_the_original(model):
    meta = torch.device("meta")
    assert model.on(CPU) is model
    assert model.on(meta).transitions[0].posterior.factor.device == meta
    assert model.transitions[0].posterior.factor.device == CPU


@pytest.mark.parametrize("differences", [False, True])
@pytest.mark.parametrize("variant", VARIANTS)
def test_a_step_on_another_device_creates_no_tensor_on_the_cpu(model, variant, differences, monkeypatch):
    """Tensors that only pretend to be anywhere: an operation on two devices is refused. ``meta`` is the other one."""
    conditions = iter([True])  # all lanes run; nobody is to be reset
    monkeypatch.setattr(FakeTensor, "__bool__", lambda _: next(conditions, False))
    monkeypatch.setattr(serving, "_error_bounds", lambda _: (float(differences), float(differences)))
    arrived: list[torch.Tensor] = []
    monkeypatch.setattr(environment, "_array", lambda values: arrived.append(values) or np.zeros(0))
    settings = VirtualSettings(LANES, autoreset_mode="disabled", time_limit=3, **VARIANTS[variant])
    with FakeTensorMode(allow_non_fake_inputs=True):
        with pytest.raises(RuntimeError, match=r"same device|two different devices"):
            torch.zeros(2) + torch.zeros(2, device="meta")
        there = to_device(model, torch.device("meta"))
        lanes, _ = reset(there.definition, settings, create(there.definition, settings, 0), seed=1)
        if settings.variant == "pathwise":
            lanes = replace(lanes, path=there.draw(lanes.q.new_zeros(LANES, there.path_size)))
        plain = environment.step.__wrapped__  # pretending does not go together with inference mode
        plain(there, settings, lanes, np.zeros((LANES, model.definition.action.size)))
    assert {values.device.type for values in arrived} == {"meta"}
