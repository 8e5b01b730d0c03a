"""Statistics with which Stable-Baselines3's ``VecNormalize`` normalised the observations of a policy.

The policy's own file lacks them. They are read from a file of arrays beside it, because those of ``VecNormalize.save``
are pickled.
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
    """Whether a policy of another program learned in a ``VecNormalize``: Stable-Baselines3 then also keeps the original
    observation. ``surrogym train`` normalises rewards only, and leaves it out of its files."""
    return getattr(model, "_last_original_obs", None) is not None


def statistics_path(policy: Path) -> Path:
    """Return the path of the statistics beside a policy, such as ``mine.vecnormalize.npz``."""
    return policy.with_suffix(ENDING)


def missing_statistics(policy: Path) -> UnusablePolicy:
    """The error for a policy whose statistics are not known, with the way out."""
    arrays = "mean=env.obs_rms.mean, var=env.obs_rms.var, epsilon=env.epsilon, clip=env.clip_obs"
    return UnusablePolicy(
        f"{policy} learned in a VecNormalize, whose statistics are not in the file: expected them in "
        f'{statistics_path(policy)}; with env = VecNormalize.load(...), numpy.savez("{statistics_path(policy)}", '
        f"{arrays}) writes it (mean=0, var=1, epsilon=0, clip=numpy.inf if it normalised rewards only)"
    )


class Normalisation:
    """Normalise observations as ``VecNormalize`` does: (o - mean) / sqrt(var + epsilon), clipped to +-clip."""

    def __init__(self, path: Path) -> None:
        """Read the statistics. Raises ``UnusablePolicy`` if the file does not hold them."""
        try:
            with np.load(path, allow_pickle=False) as file:
                self.mean, variance, epsilon, self.clip = (
                    np.asarray(file[name], dtype=np.float64) for name in ("mean", "var", "epsilon", "clip")
                )
        except (OSError, ValueError, KeyError) as error:
            raise UnusablePolicy(f"{path}: expected the arrays mean, var, epsilon and clip ({error})") from error
        self.spread = np.sqrt(variance + epsilon)

    def __call__(self, observations: Floats) -> Floats:
        """Return normalised observations (N, D)."""
        scaled = (observations - self.mean) / self.spread
        return np.clip(scaled, -self.clip, self.clip).astype(np.float32)
