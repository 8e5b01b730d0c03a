"""The statistics with which Stable-Baselines3's ``VecNormalize`` normalised the observations of a policy.

The policy's own file lacks them. They are read from a file of arrays beside it, because the file of
``VecNormalize.save`` is pickled.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from surrogym_trainer.policies.card import UnusablePolicy

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

Floats = NDArray[np.float32]
ENDING = ".vecnormalize.npz"


def is_normalised(model: BaseAlgorithm) -> bool:
    """Return whether a policy learned with observations that ``VecNormalize`` normalised: then Stable-Baselines3 also
    stores the original observation. ``surrogym train`` normalises only rewards, and removes that entry from its
    files."""
    return getattr(model, "_last_original_obs", None) is not None


def statistics_path(policy: Path) -> Path:
    """Return the path of the statistics beside a policy, such as ``mine.vecnormalize.npz``."""
    return policy.with_suffix(ENDING)


def missing_statistics(policy: Path) -> UnusablePolicy:
    """Return the error for a policy without a file of its statistics, with the code that writes one."""
    arrays = "mean=env.obs_rms.mean, var=env.obs_rms.var, epsilon=env.epsilon, clip=env.clip_obs"
    return UnusablePolicy(
        f"{policy} learned in a VecNormalize, whose statistics are not in the file: expected them in "
        f'{statistics_path(policy)}; with env = VecNormalize.load(...), numpy.savez("{statistics_path(policy)}", '
        f"{arrays}) writes it (mean=0, var=1, epsilon=0, clip=numpy.inf if it normalised rewards only)"
    )


class Normalisation:
    """The normalisation of observations as in ``VecNormalize``: (o - mean) / sqrt(var + epsilon), clipped to +-clip."""

    def __init__(self, path: Path) -> None:
        """Read the statistics from a file. Raises ``UnusablePolicy`` if the file does not contain them."""
        try:
            with np.load(path, allow_pickle=False) as file:
                self.mean, variance, epsilon, self.clip = (
                    np.asarray(file[name], dtype=np.float64) for name in ("mean", "var", "epsilon", "clip")
                )
        except (OSError, ValueError, KeyError) as error:
            raise UnusablePolicy(
                f"{path}: expected the arrays mean, var, epsilon and clip ({error}): write the file again"
            ) from error
        self.spread = np.sqrt(variance + epsilon)

    def __call__(self, observations: Floats) -> Floats:
        """Return the normalised observations (N, D)."""
        scaled = (observations - self.mean) / self.spread
        return np.clip(scaled, -self.clip, self.clip).astype(np.float32)
