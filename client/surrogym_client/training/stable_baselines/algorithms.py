"""The algorithms of Stable-Baselines3 as policy searches.

What differs between them follows from properties (on-policy or not, kind of action), never from a task's name.
"""

from __future__ import annotations

from typing import Any

import stable_baselines3
from stable_baselines3.common.vec_env import VecNormalize

from surrogym_client.policies.defaults import LANES
from surrogym_client.policies.networks import WIDER, PaperPolicy, decaying
from surrogym_client.training.proportions import even_batch
from surrogym_client.training.stable_baselines.search import StableBaselinesSearch
from surrogym_shared.network import counts_of
from surrogym_shared.spec import EnvironmentSpec


class OnPolicySearch(StableBaselinesSearch):
    """Many lanes, the paper's policies."""

    suggested_steps = 600_000
    lanes = LANES
    policy = PaperPolicy

    def network(self, spec: EnvironmentSpec) -> dict[str, Any]:
        return {"net_arch": WIDER} if spec.design.preset == "default" else {}


class OffPolicySearch(StableBaselinesSearch):
    """Learns once for each step of all lanes, from every step it has seen, and takes far longer for each."""

    suggested_steps = 50_000
    lanes = 4
    policy = "MlpPolicy"


class PPO(OnPolicySearch):
    """In large batches, with a learning rate that falls: docs/decisions/0011."""

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

    def exploring_by_state(self, spec: EnvironmentSpec) -> dict[str, Any]:
        """Noise drawn anew at every step may never reach what takes many steps in one direction; noise that is a
        function of the state, and stays for a rollout, pushes a lane its own way (gSDE, Raffin et al. 2022). For
        continuous actions; the rollouts of the other algorithms are too short."""
        able = not counts_of(spec) and spec.design.preset != "paper"
        return {"use_sde": True} if able else {}


class A2C(OnPolicySearch):
    algorithm = stable_baselines3.A2C


class SAC(OffPolicySearch):
    algorithm = stable_baselines3.SAC


class TD3(OffPolicySearch):
    algorithm = stable_baselines3.TD3


class DDPG(OffPolicySearch):
    algorithm = stable_baselines3.DDPG


class DQN(OffPolicySearch):
    algorithm = stable_baselines3.DQN
