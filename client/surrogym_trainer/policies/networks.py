"""Policy networks for Stable-Baselines3: the paper's (section 4) with one hidden layer of 32 units, and the default one
with two of 64.

Continuous actions: tanh after each layer, the output scaled to the action bounds. Discrete actions: ReLU, and a softmax
for each dimension; ``deterministic=True`` takes the most probable action. Both standardise observations by fixed
statistics, so that a saved policy needs no other file.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule
from torch import Tensor, nn

from surrogym_trainer.policies.defaults import CRITIC, EXPLORATION, HIDDEN
from surrogym_trainer.policies.defaults import WIDER as WIDER_ACTOR

WIDER = {"pi": list(WIDER_ACTOR), "vf": list(CRITIC)}

__all__ = [
    "HIDDEN",
    "WIDER",
    "Bounded",
    "PaperPolicy",
    "Standardise",
]


class Standardise(BaseFeaturesExtractor):
    """A layer that computes (observation - mean) / standard deviation, with a fixed mean and standard deviation, (D,)
    each."""

    mean: Tensor
    deviation: Tensor

    def __init__(
        self,
        observation_space: spaces.Box,
        mean: Sequence[float] | None = None,
        deviation: Sequence[float] | None = None,
    ) -> None:
        size = int(observation_space.shape[0])
        super().__init__(observation_space, size)
        self.register_buffer("mean", torch.as_tensor([0.0] * size if mean is None else mean, dtype=torch.float32))
        scale = torch.as_tensor([1.0] * size if deviation is None else deviation, dtype=torch.float32)
        self.register_buffer("deviation", scale)

    def forward(self, observations: Tensor) -> Tensor:
        standardised: Tensor = (observations - self.mean) / self.deviation
        return standardised


class Bounded(nn.Module):
    """A layer that scales the tanh of its input to the action bounds."""

    centre: Tensor
    reach: Tensor

    def __init__(self, space: spaces.Box) -> None:
        super().__init__()
        low, high = torch.as_tensor(space.low), torch.as_tensor(space.high)
        self.register_buffer("centre", (low + high) / 2)
        self.register_buffer("reach", (high - low) / 2)

    def forward(self, x: Tensor) -> Tensor:
        bounded: Tensor = self.centre + self.reach * torch.tanh(x)
        return bounded


class PaperPolicy(ActorCriticPolicy):
    """The paper's actor, with a critic that is only used in training."""

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        **kwargs: Any,
    ) -> None:
        continuous = isinstance(action_space, spaces.Box)
        settings: dict[str, Any] = {
            "net_arch": {"pi": [HIDDEN], "vf": list(CRITIC)},
            "activation_fn": nn.Tanh if continuous else nn.ReLU,
            "features_extractor_class": Standardise,
            "ortho_init": True,
        }
        super().__init__(observation_space, action_space, lr_schedule, **(settings | kwargs))

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        if isinstance(self.action_space, spaces.Box):
            bounded = Bounded(self.action_space)
            self.action_net = nn.Sequential(self.action_net, bounded)
            with torch.no_grad():
                self.log_std.copy_(torch.log(EXPLORATION * bounded.reach))
