"""Steps on every device that this machine has agree with those on the CPU, and nothing of them stays behind there."""

from __future__ import annotations

from collections import Counter
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from support.models import gaussian_processes, learn
from support.real_steps import random_steps
from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_server import tensors
from surrogym_server.convert import definition_from_spec
from surrogym_server.gp import serving
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction import several
from surrogym_server.tensors import CPU, to_device
from surrogym_server.virtual import LaneState, LaneTransition, VirtualSettings, create, environment, reset, step
from surrogym_server.virtual.lanes import ENDED, RUNNING
from surrogym_server.virtual.residual import Residual
from surrogym_shared.spec import Limit, Limits, Term

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
    tensors = [value for value in vars(there[0]).values() if torch.is_tensor(value)]
    assert [values.device.type for values in tensors] == [device.type] * 3
    for ours, theirs in zip(here[1], there[1], strict=True):
        for field in fields(LaneTransition):
            if (expected := getattr(ours, field.name)) is not None:
                np.testing.assert_allclose(getattr(theirs, field.name), expected, rtol=1e-6, atol=1e-6)


def test_moving_a_model_to_a_device_copies_all_tensors_and_keeps_the_original(model):
    meta = torch.device("meta")
    assert model.on(CPU) is model
    assert model.on(meta).transitions[0].posterior.factor.device == meta
    assert model.transitions[0].posterior.factor.device == CPU


class Calls(TorchFunctionMode):
    """Notes functions that copy numbers of Python to the device, and let the program wait for the copy."""

    def __init__(self, seen: Counter[str]) -> None:
        super().__init__()
        self.seen = seen

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if function in INDEXING and is_there(args[0]):
            places = args[1] if isinstance(args[1], tuple) else (args[1],)
            if any(
                isinstance(p, list | tuple | np.ndarray) or (torch.is_tensor(p) and not is_there(p)) for p in places
            ):
                self.seen["indices"] += 1
        result = function(*args, **(kwargs or {}))
        if function in FACTORIES and is_there(result):
            self.seen["numbers"] += 1
        return result


class Copies(TorchDispatchMode):
    """Notes copies to and from the device."""

    def __init__(self, seen: Counter[str]) -> None:
        super().__init__()
        self.seen = seen

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = function(*args, **(kwargs or {}))
        if function.overloadpacket is torch.ops.aten._to_copy and is_there(args[0]) != is_there(result):
            self.seen["sent" if (kwargs or {}).get("non_blocking") else "copied"] += 1
        return result


def is_there(value: object) -> bool:
    return isinstance(value, torch.Tensor) and value.device == THERE


def seen_in_a_step(
    model: GaussianProcessModel,
    settings: VirtualSettings,
    monkeypatch: pytest.MonkeyPatch,
    phase: np.ndarray | None = None,
    mask: np.ndarray | None = None,
    ended: np.ndarray | bool = False,
    differences: bool = False,
) -> Counter[str]:
    """Count for what the program waits in the second step of a session on a device, which is not there: its tensors
    only pretend. An operation on two devices is refused then, and so is one whose result can't be known without
    waiting, such as a number of a tensor, or what a mask selects. Constants may be copied in the first step."""
    seen: Counter[str] = Counter()

    def results(*tensors: torch.Tensor | None) -> tuple[Any, ...]:
        assert all(t is None or is_there(t) for t in tensors)
        seen["fetched"] += 1
        arrays = [None if t is None else np.zeros(t.shape, str(t.dtype).removeprefix("torch.")) for t in tensors]
        if len(arrays) > 1:
            arrays[4] |= ended
        return tuple(arrays)

    def sizes(counts: torch.Tensor) -> tuple[Any, ...]:
        seen["fetched"] += 1
        return (np.eye(len(counts), dtype=np.int64)[0] * (LANES if mask is None else mask.sum()),)

    run(model, settings)  # what is computed once on the CPU, such as frequencies, is known then
    monkeypatch.setattr(serving, "_error_bounds", lambda _: (float(differences), float(differences)))
    monkeypatch.setattr(serving._Process, "function_by_differences", differences)
    monkeypatch.setattr(environment, "fetched", results)
    monkeypatch.setattr(several, "fetched", sizes)
    u = np.zeros((LANES, model.definition.action.size))
    with FakeTensorMode(allow_non_fake_inputs=True):
        there = to_device(model, THERE)
        if settings.functions:
            vars(there)["_uncertain_functions"] = to_device(model.uncertain_functions, THERE)
        if model.prior is not None:
            vars(there._predictor)["doubted"] = to_device(model._predictor.doubted, THERE)
        lanes, _ = reset(there.definition, settings, create(there.definition, settings, 0), seed=1)
        for _ in range(2):
            lanes = lanes if phase is None else replace(lanes, phase=phase)
            seen.clear()
            with Calls(seen), Copies(seen):  # inference mode does not go together with pretending
                lanes, _ = environment.step.__wrapped__(there, settings, lanes, u, mask, stds=True)
    return seen


THERE = torch.device("meta")
INDEXING = (torch.Tensor.__getitem__, torch.Tensor.__setitem__)
FACTORIES = (torch.tensor, torch.as_tensor, torch.Tensor.new_tensor)
SESSIONS = VARIANTS | {
    "sensors": {"sensor_noise": ("first coordinate",), "process_noise": True},
    "shared functions": {"variant": "pathwise", "functions": 3},
}
SOME = np.arange(LANES) % 3 == 0
FENCE = Limits(
    keep=(Limit(name="speed", term=Term.linear(theta_dot=1), low=-1, high=1),), fallback=(Term.constant(0.0),)
)
KINDS: dict[str, tuple[dict[str, Any], dict[str, Any], int]] = {
    "all run": ({}, {}, 1),
    "some are left out": ({}, {"mask": SOME}, 1),
    "some begin": ({}, {"phase": np.where(SOME, ENDED, RUNNING)}, 1),
    "some end and begin": ({"autoreset_mode": "same_step"}, {"ended": SOME}, 2),
}


@pytest.fixture(scope="module")
def fenced() -> GaussianProcessModel:
    """A model with a prior model, an outside reward and limits."""
    spec = pendulum()
    prior = gaussian_processes(definition_from_spec(spec), random_steps(spec, 14, seed=0))
    prior = replace(prior, definition=replace(prior.definition, outside_reward=-1.0, limits=FENCE))
    learned = [replace(output, size_with_prior=output.size) for output in prior.outputs]
    return replace(prior, transitions=tuple(learned[:-1]), reward=learned[-1], prior=prior)


@pytest.mark.parametrize("variant", SESSIONS)
def test_a_step_on_another_device_waits_for_it_once(model, variant, monkeypatch):
    differences = variant == "noisy, trusted"
    chosen = dict(SESSIONS[variant])
    if "sensor_noise" in chosen:
        chosen["sensor_noise"] = ((model.definition.coordinate_names[0], 0.1),)
    seen = seen_in_a_step(model, VirtualSettings(LANES, time_limit=9, **chosen), monkeypatch, differences=differences)
    assert seen.pop("fetched") == (2 if "functions" in chosen else 1)
    assert seen.keys() <= {"sent"}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("variant", ["deterministic", "probabilistic", "pathwise"])
def test_resets_and_declared_rules_let_a_device_be_waited_for_no_more(fenced, variant, kind, monkeypatch):
    chosen, happens, waits = KINDS[kind]
    errors = Residual((0.0,) * 4, (1.0,) * 4, (((0.1,) * 5,) * 3,) * 2)
    settings = VirtualSettings(LANES, variant=variant, particles=8, time_limit=9, residual=errors, trust=9.0, **chosen)
    seen = seen_in_a_step(fenced, settings, monkeypatch, **happens)
    assert seen.pop("fetched") == waits
    assert seen.keys() <= {"sent"}


def test_results_that_are_fetched_together_are_those_of_each(monkeypatch):
    monkeypatch.setattr(tensors, "CPU", THERE)  # so that tensors of the CPU are as those of a device
    sent = (torch.rand(3, 2), None, torch.rand(3) > 0.5, torch.rand(3, 2, dtype=torch.float64).T, torch.rand(0, 2))
    for ours, theirs in zip(sent, tensors.fetched(*sent), strict=True):
        assert (ours is None) == (theirs is None)
        if ours is not None:
            np.testing.assert_array_equal(theirs, ours.numpy(), strict=True)
            assert theirs.flags.aligned
