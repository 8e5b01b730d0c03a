"""PPO of Stable-Baselines3 with the parameters of a NumPy learner: what that is measured and tested against."""

from __future__ import annotations

from collections.abc import Mapping

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv

from surrogym_shared.network import forward
from surrogym_shared.spec import EnvironmentSpec
from surrogym_trainer.policies.networks import WIDER, PaperPolicy, Standardise
from surrogym_trainer.training.fast_ppo.learner import Batch, Learner, Objective

ROWS, RATE = 1_024, 1e-3
OBJECTIVE = Objective(clip_range=0.2, vf_coef=0.5, max_grad_norm=0.5)
HYPERPARAMETERS = {"n_steps": ROWS, "batch_size": ROWS, "n_epochs": 1, "learning_rate": RATE, "device": "cpu"}


class Still(gymnasium.Env):
    """Spaces alone: nothing is stepped."""

    def __init__(self, observation: spaces.Space, action: spaces.Space) -> None:
        self.observation_space, self.action_space = observation, action


def space_of(spec: EnvironmentSpec) -> spaces.Space:
    """The space of a policy's actions."""
    action = spec.action
    if action.kind == "box":
        return spaces.Box(np.float32(action.low), np.float32(action.high))
    return spaces.Discrete(action.n) if action.kind == "discrete" else spaces.MultiDiscrete(action.nvec)


def batch_of(learner: Learner, rng: np.random.Generator) -> tuple[Mapping[str, np.ndarray], Batch]:
    """One batch as a rollout buffer holds it, and as a learner takes it. Some ratios are outside the clip range."""
    seen = rng.normal(size=(ROWS, len(learner.mean))).astype(np.float32)
    x = learner.standardised(seen)
    actions, logs = learner.distribution.sample(forward(learner.actor, learner.activation, x), learner.further, rng)
    logs = logs + rng.normal(0, 0.3, ROWS).astype(np.float32)
    values, advantages, returns = (rng.normal(size=ROWS).astype(np.float32) for _ in range(3))
    given = {"observations": seen, "actions": actions, "log_probs": logs}
    given |= {"values": values, "advantages": advantages, "returns": returns}
    return given, Batch(x, actions, logs, advantages, returns)


def reference(learner: Learner, spec: EnvironmentSpec, given: Mapping[str, np.ndarray]) -> PPO:
    """PPO with a learner's parameters, whose ``train`` is one update with this batch."""
    observed = spaces.Box(-np.inf, np.inf, (len(learner.mean),))
    network = {
        "features_extractor_class": Standardise,
        "features_extractor_kwargs": {"mean": learner.mean, "deviation": learner.deviation},
        "net_arch": WIDER,
    }
    env = DummyVecEnv([lambda: Still(observed, space_of(spec))])
    made = PPO(PaperPolicy, env, policy_kwargs=network, **HYPERPARAMETERS)
    made.set_logger(Logger(folder=None, output_formats=[]))
    with torch.no_grad():
        for module, (weights, bias) in zip(linear(made), layers(learner), strict=True):
            module.weight.copy_(torch.from_numpy(weights.T.copy()))
            module.bias.copy_(torch.from_numpy(bias.copy()))
    made._current_progress_remaining = 1.0
    buffer = made.rollout_buffer
    buffer.reset()
    for name, rows in given.items():
        shape = getattr(buffer, name).shape
        setattr(buffer, name, rows.reshape(ROWS, *shape[2:]) if len(shape) > 2 else rows.reshape(ROWS, 1))
    buffer.full = buffer.generator_ready = True  # as after the first look at it
    return made


def layers(learner: Learner) -> list[tuple[np.ndarray, np.ndarray]]:
    """Weights and bias of the actor's layers, then of the critic's."""
    return [*learner.actor, *learner.critic]


def linear(learner: PPO) -> list[torch.nn.Linear]:
    """The same layers of Stable-Baselines3."""
    policy = learner.policy
    last = policy.action_net[0] if isinstance(policy.action_net, torch.nn.Sequential) else policy.action_net
    hidden = policy.mlp_extractor
    found = [*hidden.policy_net, last, *hidden.value_net, policy.value_net]
    return [module for module in found if isinstance(module, torch.nn.Linear)]
