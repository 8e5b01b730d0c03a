"""An engineer who has only the ONNX file knows what goes in and what comes out."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnxruntime
import pytest

from support.controllers import LEARNERS, learner, network, plant
from surrogym_shared.spec import BoxAction, DiscreteAction, MultiDiscreteAction
from surrogym_trainer.deployment.controller import Choices
from surrogym_trainer.deployment.graph import write
from surrogym_trainer.deployment.reading import controller_of
from surrogym_trainer.deployment.reference import act

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "deploy.md"
ACTIONS = {
    "continuous": (BoxAction(low=(-2.0, 0.0), high=(2.0, 10.0)), None),
    "number": (DiscreteAction(n=3), (0.0,)),
    "numbers": (MultiDiscreteAction(nvec=(2, 5)), (0.0, 0.0)),
    "bins": (BoxAction(low=(-2.0, 0.0), high=(2.0, 10.0), bins=(3, 5)), None),
}


def run(controller, folder: Path, observations: np.ndarray) -> np.ndarray:
    write(controller, folder)
    session = onnxruntime.InferenceSession(folder / "arm.onnx", providers=["CPUExecutionProvider"])
    return session.run(["action"], {"observation": observations})[0]


@pytest.mark.parametrize("case", ACTIONS)
def test_the_exported_onnx_file_gives_the_controllers_actions(tmp_path: Path, case: str):
    action, fallback = ACTIONS[case]
    controller = controller_of(network(tmp_path, plant(action), (16, 16)), choices=Choices(fallback=fallback))
    observations = np.random.default_rng(0).normal(size=(300, 4)).astype(np.float32)
    got = run(controller, tmp_path, observations)
    expected, _ = act(controller, observations.astype(np.float64))
    assert got.dtype == (np.int64 if case.startswith("number") else np.float32)
    assert len(np.unique(expected)) > 1, "a policy that always does the same shows nothing"
    close = np.abs(got - expected) <= 1e-5 * (controller.high - controller.low)
    assert close.mean() > 0.99 if controller.counts else close.all()


def test_the_onnx_export_of_a_squashed_stable_baselines3_policy_gives_its_actions(tmp_path: Path):
    controller = controller_of(learner(tmp_path, "SAC", plant(LEARNERS["SAC"][2])), trust=True)
    observations = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)
    expected, _ = act(controller, observations.astype(np.float64))
    np.testing.assert_allclose(run(controller, tmp_path, observations), expected, atol=1e-3)


def test_the_documented_onnxruntime_example_reads_the_onnx_description(tmp_path: Path):
    spec = plant(changes=1, actions=1, largest={"angle": 0.5, "slide": 0.2})
    write(controller_of(network(tmp_path, spec)), tmp_path)
    (program,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert "surrogym_" not in program
    program = program.replace("pendulum.onnx", "arm.onnx")
    out = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=True
    ).stdout
    assert "cos = cos(angle)  -1.0 1.0\n" in out
    assert "miss = clip(2.0 * slide + -1.0 * target + 0.1, -1.5, inf)" in out
    assert "slide = slide m" in out
    assert out.endswith("action from -2.0 to 2.0\naction from 0.0 to 10.0\n")


def test_the_onnx_description_contains_inputs_outputs_limits_and_period(tmp_path: Path):
    spec = plant(changes=1, actions=1, largest={"angle": 0.5, "slide": 0.2})
    write(controller_of(network(tmp_path, spec)), tmp_path)
    session = onnxruntime.InferenceSession(tmp_path / "arm.onnx", providers=["CPUExecutionProvider"])
    about = json.loads(session.get_modelmeta().custom_metadata_map["surrogym"])
    assert [m["name"] for m in about["measurements"]] == ["angle", "slide", "target"]
    slide = {"name": "slide", "unit": "m", "angle": False, "low": -1.0, "high": 2.0, "sensor": [-4.0, 5.0]}
    assert about["measurements"][1] == slide
    assert [lag["is"] for lag in about["lags"]] == [
        *("change of angle in the last step, by at most half a turn", "change of slide in the last step"),
        *("entry 0 of the last action", "entry 1 of the last action"),
    ]
    assert (about["sampling_period"], about["timeout"]) == (0.05, 0.1)
    assert set(about["sha256"]) == {"policy", "specification"}
    assert len(about["observation"]) == len(spec.observation)
