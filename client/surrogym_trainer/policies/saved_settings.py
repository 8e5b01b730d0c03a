"""Settings and counters that a policy's file may set on an algorithm of Stable-Baselines3.

Stable-Baselines3 makes every entry of a file an attribute of the algorithm, even a method. Only the entries here are
accepted, each of its type. All others are ignored, and the algorithm's defaults apply.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

from gymnasium import spaces
from pydantic import BaseModel, ConfigDict, Field

MAX_EXPERIENCE_BYTES = 2 * 1024**3
Count = Annotated[int, Field(ge=0, le=2**53)]
Positive = Annotated[int, Field(ge=1, le=2**53)]
Batch = Annotated[int, Field(ge=1, le=2**20)]
# Number of passes over the experience, or of gradient steps; -1 means one for each environment step.
Passes = Annotated[int, Field(ge=-1, le=10_000)]
Share = Annotated[float, Field(ge=0, le=1)]


class ReplaySettings(BaseModel):
    """The accepted settings of the replay buffer; its other settings follow from those of the algorithm."""

    model_config = ConfigDict(extra="ignore", frozen=True, strict=True)

    handle_timeout_termination: bool | None = None


class PolicySettings(BaseModel):
    """The accepted entries of a policy's file, named as the algorithm's attributes. None or a missing entry means the
    default."""

    model_config = ConfigDict(extra="ignore", frozen=True, strict=True, allow_inf_nan=False)

    seed: Annotated[int, Field(ge=0, lt=2**32)] | None = None
    gamma: Share | None = None
    learning_rate: Annotated[float, Field(ge=0)] | None = None
    max_grad_norm: float | None = None
    use_sde: bool | None = None
    sde_sample_freq: Annotated[int, Field(ge=-1)] | None = None
    use_sde_at_warmup: bool | None = None
    stats_window_size: Annotated[Batch | None, Field(alias="_stats_window_size")] = None
    # Settings of the stored experience.
    n_steps: Positive | None = None
    buffer_size: Positive | None = None
    optimize_memory_usage: bool | None = None
    replay_buffer_kwargs: ReplaySettings | None = None
    batch_size: Batch | None = None
    # Settings of PPO and A2C.
    n_epochs: Annotated[int, Field(ge=1, le=10_000)] | None = None
    gae_lambda: Share | None = None
    vf_coef: float | None = None
    normalize_advantage: bool | None = None
    target_kl: float | None = None
    # Settings of SAC, TD3, DDPG and DQN.
    ent_coef: float | Annotated[str, Field(pattern=r"^auto(_[0-9.e+-]+)?$", max_length=32)] | None = None
    target_entropy: float | None = None
    learning_starts: Count | None = None
    tau: Share | None = None
    gradient_steps: Passes | None = None
    target_update_interval: Positive | None = None
    policy_delay: Positive | None = None
    target_noise_clip: float | None = None
    target_policy_noise: float | None = None
    exploration_initial_eps: Share | None = None
    exploration_final_eps: Share | None = None
    exploration_fraction: Share | None = None
    exploration_rate: Share | None = None
    # Counters of the training's progress.
    num_timesteps: Count | None = None
    total_timesteps: Annotated[Count | None, Field(alias="_total_timesteps")] = None
    steps_at_start: Annotated[Count | None, Field(alias="_num_timesteps_at_start")] = None
    progress_remaining: Annotated[float | None, Field(alias="_current_progress_remaining")] = None
    episodes: Annotated[Count | None, Field(alias="_episode_num")] = None
    updates: Annotated[Count | None, Field(alias="_n_updates")] = None
    calls: Annotated[Count | None, Field(alias="_n_calls")] = None

    @property
    def attributes(self) -> dict[str, Any]:
        """The attributes that the file sets on the algorithm, by name."""
        return self.model_dump(by_alias=True, exclude_none=True)

    def require_memory(
        self, num_envs: int, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
    ) -> None:
        """Check that the experience for learning fits in ``MAX_EXPERIENCE_BYTES``.

        Raises:
            ValueError: the experience needs more memory.
        """
        # 4 further numbers in each step: the reward, the end, the value and the like
        numbers = 2 * _size(observation_space) + _size(action_space) + 4
        steps = max(self.buffer_size or 0, (self.n_steps or 0) * num_envs)
        if (needed := 4 * numbers * steps) > MAX_EXPERIENCE_BYTES:
            asked = f"n_steps={self.n_steps}, buffer_size={self.buffer_size}, {num_envs} lanes"
            raise ValueError(
                f"expected at most {MAX_EXPERIENCE_BYTES} bytes of experience, got {needed} ({asked}): lower these "
                "settings"
            )


def _size(space: spaces.Space[Any]) -> int:
    return math.prod(space.shape or ())
