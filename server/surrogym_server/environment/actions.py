"""Actions of a policy and of the model: checks, and conversions between them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput
from surrogym_shared.nouns import Vector

Array = NDArray[np.float64]
# An action may exceed its limit by this share of the action's range, because policies compute in float32.
FLOAT32_SLACK = 1e-6


def policy_actions(definition: EnvironmentDefinition, raw: NDArray[Any], num_envs: int) -> Array:
    """Check the actions that a policy chose, and convert them to the form in which the model takes actions.

    Args:
        definition: the environment.
        raw: actions of the policy, (N, F), or (N,) if F = 1.
        num_envs: number of environments, N.

    Returns:
        The model's actions, (N, F).

    Raises:
        InvalidInput: the array has a wrong shape, or an entry is not finite, not a whole number or out of bounds.
    """
    rows = _rows(raw, (num_envs, definition.action.size))
    if counts := definition.action.policy_counts:
        _require_counts(rows, counts)
        return rows if definition.action.nvec else decode_bins(definition, rows)
    return _in_box(definition, rows)


def model_actions(definition: EnvironmentDefinition, raw: NDArray[Any]) -> Array:
    """Check actions of queries and samples, and return them as float64, (n, F): continuous values, or the numbers of
    discrete actions.

    Raises:
        InvalidInput: the array has a wrong shape, or an entry is not finite, not a whole number or out of bounds.
    """
    rows = _rows(raw, (len(raw), definition.action.size))
    if counts := definition.action.nvec:
        _require_counts(rows, counts)
        return rows
    return _in_box(definition, rows)


def at_bound(definition: EnvironmentDefinition, actions: Sequence[Vector]) -> list[bool]:
    """Return for each of n actions of the model (n, F) whether an entry of it is at a bound of the specification. A
    discrete action has no bounds."""
    if definition.action.nvec or not actions:
        return [False] * len(actions)
    low, high = definition.action_limits
    rows, slack = np.array(actions), FLOAT32_SLACK * (high - low)
    return [bool(row.any()) for row in (rows <= low + slack) | (rows >= high - slack)]


def decode_bins(definition: EnvironmentDefinition, rows: Array) -> Array:
    """Convert n actions (n, F), whose entries are numbers of equally spaced values, to these values (n, F)."""
    low, high = definition.action_limits
    values: Array = low + rows * (high - low) / (np.array(definition.action.policy_counts) - 1)
    return values


def _rows(raw: NDArray[Any], expected: tuple[int, int]) -> Array:
    # The array is copied, because one that was received in a message may be unaligned and read-only.
    rows = np.array(raw, dtype=np.float64)
    if rows.ndim == 1 and expected[1] == 1:
        rows = rows[:, None]
    if rows.shape != expected:
        raise InvalidInput(f"action: expected shape {expected}, got {np.shape(raw)}")
    return rows


def _require_finite(rows: Array) -> None:
    if not np.isfinite(rows).all():
        raise InvalidInput("action: expected finite numbers, got NaN or infinity")


def _require_counts(rows: Array, counts: tuple[int, ...]) -> None:
    _require_finite(rows)
    if (rows != np.floor(rows)).any():
        raise InvalidInput(f"action: expected whole numbers, got {rows[rows != np.floor(rows)][0]:g}")
    bad = (rows < 0) | (rows >= np.array(counts))
    if bad.any():
        row, entry = np.argwhere(bad)[0]
        raise InvalidInput(
            f"action: expected entry {entry} to be from 0 to {counts[entry] - 1}, got {rows[row, entry]:g} in row {row}"
        )


def _in_box(definition: EnvironmentDefinition, rows: Array) -> Array:
    low, high = definition.action_limits
    if ((rows >= low) & (rows <= high)).all():  # no entry is NaN or infinite then, because both limits are finite
        return rows
    _require_finite(rows)
    # In float32, an action at its limit may be rounded to a value slightly beyond the limit.
    slack = FLOAT32_SLACK * (high - low)
    bad = (rows < low - slack) | (rows > high + slack)
    if bad.any():
        row, entry = np.argwhere(bad)[0]
        raise InvalidInput(
            f"action: expected entry {entry} in [{low[entry]:g}, {high[entry]:g}], "
            f"got {rows[row, entry]:g} in row {row}"
        )
    inside: Array = rows.clip(low, high)
    return inside
