"""A policy that leaves gives the same actions as the one that stays, whatever its algorithm and form."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import onnxruntime
import pytest
import stable_baselines3
import torch
from gymnasium import spaces

from surrogym_sampler.original.classic import acrobot, pendulum
from surrogym_shared.network import Network
from surrogym_trainer.policies import UnusablePolicy, load_policy
from surrogym_trainer.policies import export as policy_export
from surrogym_trainer.policies.export import NotExportable, export_policy
from surrogym_trainer.policies.networks import PaperPolicy
from surrogym_trainer.policies.onnx_files import UnusableOnnx

OBSERVED = spaces.Box(-np.inf, np.inf, (3,), np.float32)
TORQUES = spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([2.0, 10.0], np.float32))
STATISTICS = {"mean": [1.0, 0.0, -2.0], "deviation": [2.0, 1.0, 4.0]}
OBSERVATIONS = (3 * np.random.default_rng(1).standard_normal((200, 3))).astype(np.float32)
CASES = {
    "PPO, continuous": ("PPO", PaperPolicy, TORQUES),
    "PPO, noise by the state": ("PPO", PaperPolicy, TORQUES),
    "PPO, discrete": ("PPO", PaperPolicy, spaces.Discrete(3)),
    "PPO, several discrete": ("PPO", PaperPolicy, spaces.MultiDiscrete([2, 3])),
    "SAC": ("SAC", "MlpPolicy", TORQUES),
    "TD3": ("TD3", "MlpPolicy", TORQUES),
    "DQN": ("DQN", "MlpPolicy", spaces.Discrete(3)),
}


class Idle(gymnasium.Env):
    """Something to build an algorithm on."""

    observation_space = OBSERVED

    def __init__(self, action_space: spaces.Space) -> None:
        self.action_space = action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(3, np.float32), {}

    def step(self, action):
        return np.zeros(3, np.float32), 0.0, False, False, {}


def saved(folder: Path, case: str) -> Path:
    """A policy whose weights differ from a fresh one's, so that each of them counts."""
    algorithm, policy, action_space = CASES[case]
    options: dict[str, Any] = (
        {} if policy == "MlpPolicy" else {"policy_kwargs": {"features_extractor_kwargs": STATISTICS}}
    )
    options |= {"use_sde": True} if "by the state" in case else {}
    learner = getattr(stable_baselines3, algorithm)(policy, Idle(action_space), device="cpu", seed=0, **options)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in learner.policy.parameters():
            parameter += 0.3 * torch.randn(parameter.shape, generator=generator)
    learner.save(folder / "policy.zip")
    return folder / "policy.zip"


def same(ours: np.ndarray, theirs: np.ndarray) -> None:
    assert (ours.shape, ours.dtype.kind) == (theirs.shape, theirs.dtype.kind)
    assert len(np.unique(ours)) > 1, "a policy that always does the same shows nothing"
    np.testing.assert_allclose(theirs, ours, atol=1e-4 if ours.dtype.kind == "f" else 0)


@pytest.mark.parametrize("case", CASES)
def test_a_policy_exported_to_torch_gives_the_same_actions(tmp_path: Path, case: str):
    policy = saved(tmp_path, case)
    export_policy(policy, tmp_path / "policy.pt2", CASES[case][0], trust=True)
    program = torch.export.load(tmp_path / "policy.pt2").module()
    expected = load_policy(policy, CASES[case][0], trust=True)
    for rows in (OBSERVATIONS, OBSERVATIONS[:1]):
        with torch.no_grad():
            got = program(torch.as_tensor(rows)).numpy()
        assert len(got) == len(rows)
        np.testing.assert_allclose(got, expected(rows), atol=1e-4)
    same(expected(OBSERVATIONS), program(torch.as_tensor(OBSERVATIONS)).detach().numpy())


@pytest.mark.parametrize("case", ["PPO, continuous", "PPO, noise by the state", "PPO, several discrete", "SAC"])
def test_a_policy_exported_to_onnx_gives_the_same_actions(tmp_path: Path, case: str):
    policy = saved(tmp_path, case)
    export_policy(policy, tmp_path / "policy.onnx", CASES[case][0], trust=True)
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx", providers=["CPUExecutionProvider"])
    got = session.run(["action"], {"observation": OBSERVATIONS})[0]
    same(load_policy(policy, CASES[case][0], trust=True)(OBSERVATIONS), got)
    same(got, load_policy(tmp_path / "policy.onnx")(OBSERVATIONS))


@pytest.mark.parametrize("spec", [pendulum(), acrobot()], ids=["continuous", "discrete"])
def test_a_policy_stored_as_arrays_can_be_exported_to_torch(tmp_path: Path, spec):
    d, rng = len(spec.observation), np.random.default_rng(0)
    network = Network.of(spec, np.ones(d), np.full(d, 2.0), 8, rng.normal(size=Network.size(spec, 8)))
    network.save(tmp_path / "policy.zip")
    export_policy(tmp_path / "policy.zip", tmp_path / "policy.pt2", "CMAES")
    observations = rng.normal(size=(50, d)).astype(np.float32)
    program = torch.export.load(tmp_path / "policy.pt2").module()
    same(network(observations), program(torch.as_tensor(observations)).numpy())


def test_an_exported_policy_file_whose_actions_differ_is_deleted(tmp_path: Path, monkeypatch):
    policy = saved(tmp_path, "PPO, continuous")
    read = policy_export._from_program
    monkeypatch.setattr(policy_export, "_from_program", lambda content: lambda o: read(content)(o) + 1e-3)
    with pytest.raises(NotExportable, match="differ by up to 0"):
        export_policy(policy, tmp_path / "policy.pt2", "PPO", trust=True)
    assert not (tmp_path / "policy.pt2").exists()


def test_an_impossible_policy_export_is_refused_with_a_reason(tmp_path: Path):
    policy = saved(tmp_path, "DQN")
    with pytest.raises(NotExportable, match=r"ending in \.onnx or \.pt2, got '\.txt'"):
        export_policy(policy, tmp_path / "policy.txt", "DQN")
    with pytest.raises(UnusablePolicy, match="not a policy of SAC"):
        export_policy(policy, tmp_path / "policy.pt2", "SAC", trust=True)
    (tmp_path / "junk.onnx").write_bytes(b"junk")
    with pytest.raises(UnusableOnnx, match="expected a policy in ONNX, got 4 bytes"):
        load_policy(tmp_path / "junk.onnx")
