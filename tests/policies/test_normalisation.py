"""A policy that learned in a VecNormalize acts only with its statistics, which its file does not have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from surrogym_trainer.policies.card import UnusablePolicy
from surrogym_trainer.policies.files import load_learner, load_policy, save_policy, statistics_path

SHOWN = np.array([[1.0, 0.0, 5.0], [-0.3, 0.9, -7.0]], dtype=np.float32)
SETTINGS = {
    "n_steps": 8,
    "batch_size": 8,
    "n_epochs": 1,
    "device": "cpu",
    "seed": 0,
    "policy_kwargs": {"net_arch": [4]},
}


@pytest.fixture(scope="module")
def learned() -> tuple[PPO, VecNormalize]:
    env = VecNormalize(make_vec_env("Pendulum-v1", 2, seed=0))
    return PPO("MlpPolicy", env, **SETTINGS).learn(16), env


def test_a_vecnormalize_policy_is_refused_without_its_statistics(learned, tmp_path: Path) -> None:
    model, env = learned
    policy = tmp_path / "mine.zip"
    model.save(policy)
    with pytest.raises(UnusablePolicy, match=r"VecNormalize.*mine\.vecnormalize\.npz"):
        load_policy(policy, trust=True)
    np.savez(
        statistics_path(policy), mean=env.obs_rms.mean, var=env.obs_rms.var, epsilon=env.epsilon, clip=env.clip_obs
    )
    acts = load_policy(policy, trust=True)(SHOWN)
    np.testing.assert_allclose(acts, model.predict(env.normalize_obs(SHOWN), deterministic=True)[0], rtol=1e-5)
    assert not np.allclose(acts, model.predict(SHOWN, deterministic=True)[0])
    with pytest.raises(UnusablePolicy, match="VecNormalize"):
        load_learner(policy, trust=True)


def test_a_normalisation_file_without_the_needed_arrays_is_refused(learned, tmp_path: Path) -> None:
    model, _ = learned
    policy = tmp_path / "mine.zip"
    model.save(policy)
    np.savez(statistics_path(policy), mean=0.0)
    with pytest.raises(UnusablePolicy, match="expected the arrays mean, var, epsilon and clip"):
        load_policy(policy, trust=True)


def test_policies_without_vecnormalize_need_no_statistics(learned, tmp_path: Path) -> None:
    """Those of surrogym train learn in a VecNormalize of rewards alone."""
    model, env = learned
    save_policy(model, tmp_path / "ours.zip")
    load_policy(tmp_path / "ours.zip", trust=True)
    plain = PPO("MlpPolicy", env.venv, **SETTINGS).learn(16)
    plain.save(tmp_path / "plain.zip")
    load_policy(tmp_path / "plain.zip", trust=True)
