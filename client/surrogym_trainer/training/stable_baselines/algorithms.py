"""Policy searches by the algorithms of Stable-Baselines3.

Their defaults depend on properties of an algorithm (on-policy or not, kind of action), never on a task's name.
"""

from __future__ import annotations

from typing import Any

import stable_baselines3
from stable_baselines3.common.vec_env import VecNormalize

from surrogym_shared.spec import EnvironmentSpec
from surrogym_trainer.policies.defaults import LANES, decaying
from surrogym_trainer.policies.networks import WIDER, PaperPolicy
from surrogym_trainer.training.settings import even_batch
from surrogym_trainer.training.stable_baselines.search import StableBaselinesSearch


class OnPolicySearch(StableBaselinesSearch):
    """Policy search by an on-policy algorithm, with many lanes (environments that step together) and the paper's policy
    networks."""

    suggested_steps = 600_000
    lanes = LANES
    policy = PaperPolicy

    def network(self, spec: EnvironmentSpec) -> dict[str, Any]:
        return {"net_arch": WIDER} if spec.preset.wide_networks else {}


class OffPolicySearch(StableBaselinesSearch):
    """Policy search by an off-policy algorithm. It updates after each step of all lanes, so each step takes far longer
    than with an on-policy algorithm."""

    suggested_steps = 50_000
    lanes = 4
    policy = "MlpPolicy"


class PPO(OnPolicySearch):
    """Policy search by PPO, with large batches and a decreasing learning rate; lab/records/decisions/0011 has the
    reasons."""

    algorithm = stable_baselines3.PPO

    def defaults(self, env: VecNormalize) -> dict[str, Any]:
        steps = 128
        rollout = env.num_envs * self.hyperparameters.get("n_steps", steps)
        return {
            "n_steps": steps,
            "n_epochs": 10,
            "learning_rate": decaying,
            "gae_lambda": 0.97,
            "batch_size": even_batch(rollout),
        }


class A2C(OnPolicySearch):
    """Policy search by A2C of Stable-Baselines3."""

    algorithm = stable_baselines3.A2C


class SAC(OffPolicySearch):
    """Policy search by SAC of Stable-Baselines3."""

    algorithm = stable_baselines3.SAC


class TD3(OffPolicySearch):
    """Policy search by TD3 of Stable-Baselines3."""

    algorithm = stable_baselines3.TD3


class DDPG(OffPolicySearch):
    """Policy search by DDPG of Stable-Baselines3."""

    algorithm = stable_baselines3.DDPG


class DQN(OffPolicySearch):
    """Policy search by DQN of Stable-Baselines3."""

    algorithm = stable_baselines3.DQN
