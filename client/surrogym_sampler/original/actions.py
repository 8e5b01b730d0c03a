"""Conversion of a policy's actions to those of the original environment."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.original.errors import UnknownEnvironment
from surrogym_sampler.original.protocol import Array
from surrogym_shared.spec import BoxAction, EnvironmentSpec
from surrogym_shared.spec.actions import Action


def decode_actions(spec: EnvironmentSpec, raw: NDArray[Any], num_envs: int) -> Array:
    """Convert a policy's actions for N environments to actions (N, F) of the original environment. The numbers of
    bins become continuous values.

    Raises:
        ValueError: the actions have the wrong shape, are not finite, or are not numbers of existing bins or values.
    """
    rows = np.asarray(raw, dtype=np.float64)
    if rows.size != num_envs * spec.action.size:
        raise ValueError(
            f"expected actions of shape ({num_envs}, {spec.action.size}), got {np.shape(raw)}: give one row per "
            "environment"
        )
    rows = rows.reshape(num_envs, spec.action.size)
    if isinstance(spec.action, BoxAction) and spec.action.bins is None:
        if not np.isfinite(rows).all():
            raise ValueError(f"expected finite actions, got {rows.tolist()}: correct the policy that gave them")
        return np.clip(rows, spec.action.low, spec.action.high)
    counts = np.array(spec.action.policy_counts)
    if not ((rows >= 0) & (rows < counts) & (rows == np.round(rows))).all():
        raise ValueError(
            f"expected actions that are whole numbers from 0 to below {counts.tolist()}, got {rows.tolist()}: correct "
            "the policy"
        )
    if not isinstance(spec.action, BoxAction):
        return rows
    low, high = np.array(spec.action.low), np.array(spec.action.high)
    return np.asarray(low + rows * (high - low) / (counts - 1))


def explored(spec: EnvironmentSpec, action: Array, share: float, rng: np.random.Generator) -> Array:
    """Return an action (F,) of the environment after a random change.

    A continuous entry gets normal noise with a standard deviation of ``share`` times half its range, and stays within
    its bounds. With probability ``share``, an entry with a finite number of values becomes a random one of them.
    """
    size = spec.action.size
    if isinstance(spec.action, BoxAction):
        low, high = np.array(spec.action.low), np.array(spec.action.high)
        if spec.action.bins is None:
            return np.clip(action + rng.normal(0, share * (high - low) / 2, size), low, high)
    counts = np.array(spec.action.policy_counts)
    drawn = decode_actions(spec, rng.integers(counts, size=size), 1)[0]
    return np.where(rng.random(size) < share, drawn, action)


def random_action(spec: EnvironmentSpec, rng: np.random.Generator) -> Array:
    """Draw an action (F,) uniformly from the action space."""
    if isinstance(spec.action, BoxAction):
        return rng.uniform(spec.action.low, spec.action.high)
    return rng.integers(0, spec.action.nvec).astype(np.float64)


def middle_action(spec: EnvironmentSpec) -> Array:
    """Return the action (F,) in the middle of its bounds; zeros if the actions are discrete."""
    if isinstance(spec.action, BoxAction):
        return np.asarray(np.mean([spec.action.low, spec.action.high], axis=0))
    return np.zeros(spec.action.size)


def require_same_action(name: str, declared: Action, own: Action) -> None:
    """Refuse a declared action that the environment can't take. It may have fewer values than the environment's own,
    and other bounds.

    Args:
        name: the environment, for messages.
        declared: the action of the specification.
        own: the action of the environment.

    Raises:
        UnknownEnvironment: the declared action has another kind, another number of entries, or more values.
    """
    fits = declared.kind == own.kind and declared.size == own.size
    if fits and not isinstance(own, BoxAction):
        fits = all(asked <= there for asked, there in zip(declared.policy_counts, own.policy_counts, strict=True))
    if not fits:
        raise UnknownEnvironment(
            f"the specification declares {_words_of(declared)}, but {name} takes {_words_of(own)}: declare the latter "
            "as the action"
        )


def _words_of(action: Action) -> str:
    if isinstance(action, BoxAction):
        return f"a continuous action of {action.size} entr{'y' if action.size == 1 else 'ies'}"
    values = " and ".join(map(str, action.policy_counts))
    return f"a discrete action of {values} values"
