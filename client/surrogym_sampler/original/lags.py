"""Conversion of the values that an environment reports to coordinates, some of which repeat earlier values (lags).

Shapes: C coordinates, of which R are read and the others are lags; F action entries.
"""

from __future__ import annotations

import numpy as np

from surrogym_sampler.original.errors import StepFailed
from surrogym_sampler.original.gymnasium import wrapped
from surrogym_sampler.original.protocol import Array
from surrogym_shared.spec import EnvironmentSpec, limits


def read_names(spec: EnvironmentSpec) -> tuple[str, ...]:
    """Return the names of the R coordinates that the environment itself reports. The others are lags, which repeat
    earlier coordinates or actions or count steps."""
    return tuple(c.name for c in spec.coordinates if c.lag is None)


def begun(spec: EnvironmentSpec, read: Array) -> Array:
    """Return the coordinates (C,) after a reset in which the environment reported R values, ``read`` (R,). The other
    coordinates are lags, which repeat earlier values: a lag that counts steps is 0, any other lag has the middle of its
    declared start.

    Examples:
        A policy on a machine observes ``surrogym_shared.terms.observe(spec, begun(spec, read)[None])[0]``.
    """
    middle = [0.0 if c.counted else sum(limits(spec.start[c.name])) / 2 for c in spec.coordinates]
    return placed(spec, read, np.array(middle))


def followed(spec: EnvironmentSpec, before: Array, action: Array, read: Array) -> Array:
    """Return the coordinates (C,) after a step.

    Args:
        spec: the specification.
        before: coordinates (C,) before the step.
        action: the action (F,) of the step.
        read: the R values (R,) that the environment reports after the step.
    """
    after = placed(spec, read, before)
    names = spec.coordinate_names
    for i, coordinate in enumerate(spec.coordinates):
        match coordinate.lag:
            case None:
                continue
            case lag if lag.kind == "action":
                after[i] = action[lag.entry or 0]
            case lag if lag.kind == "steps":
                after[i] = before[i] + 1
            case lag:
                source = names.index(lag.of or "")
                after[i] = before[source] if lag.kind == "value" else _change(spec, source, before, after)
    return wrapped(spec, after)


def placed(spec: EnvironmentSpec, read: Array, lags: Array) -> Array:
    """Return coordinates (C,) with the R values ``read`` (R,) that the environment reported. Coordinates that repeat
    earlier values (lags) are taken from ``lags`` (C,)."""
    placed = lags.copy()
    placed[[c.lag is None for c in spec.coordinates]] = read
    return wrapped(spec, placed)


def _change(spec: EnvironmentSpec, index: int, before: Array, after: Array) -> float:
    change = float(after[index] - before[index])
    if spec.coordinates[index].kind == "angle":
        return (change + np.pi) % (2 * np.pi) - np.pi
    return change


def snapshot_with(at: Array | None, own: bytes, prefix: int) -> bytes:
    """Return a snapshot that has the state ``at`` (C,), with its lags, before the environment's ``own`` bytes.
    ``prefix`` is the number of bytes of the state; without lags it is 0, and the own bytes are the snapshot.

    Raises ``StepFailed`` if no episode is running, so that there is no state.
    """
    if not prefix:
        return own
    if at is None:
        raise StepFailed(
            "expected a running episode, because a snapshot contains its earlier values (lags), got none: reset the "
            "environment first"
        )
    return at.astype("<f8").tobytes() + own


def parts_of(snapshot: bytes, prefix: int) -> tuple[Array, bytes]:
    """Return the state (C,) in a snapshot of ``snapshot_with``, of no entries if ``prefix`` is 0, and the environment's
    own bytes. Raises ``StepFailed`` if the snapshot is too short."""
    if len(snapshot) < prefix:
        raise StepFailed(
            f"expected a snapshot of at least {prefix} bytes, the size of the coordinates in it, got {len(snapshot)} "
            "bytes: delete the snapshots of this environment"
        )
    return np.frombuffer(snapshot[:prefix], dtype="<f8"), snapshot[prefix:]
