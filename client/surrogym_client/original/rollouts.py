"""Environments that can only be reset and acted on, as the sampler uses them."""

from __future__ import annotations

from typing import Any, TypeGuard

import numpy as np

from surrogym_client.original.errors import StepFailed, UnknownEnvironment
from surrogym_client.original.gymnasium import native_action
from surrogym_client.original.lags import begun, followed, read_names
from surrogym_client.original.protocol import (
    Array,
    Environment,
    OriginalEnvironment,
    RealStep,
    ResettableEnvironment,
    RolloutEnvironment,
    SnapshotEnvironment,
    runs_in_parallel,
)
from surrogym_shared.spec import EnvironmentSpec


class FromReset:
    """A ``ResettableEnvironment`` as a ``RolloutEnvironment``: each step begins where the one before ended.

    The environment reads R coordinates; the others are lags of these and of the actions.
    """

    def __init__(self, environment: ResettableEnvironment) -> None:
        self._environment = environment
        self._spec = environment.spec()
        self._at: Array | None = None
        self.parallel = runs_in_parallel(environment)

    def spec(self) -> EnvironmentSpec:
        return self._spec

    def begin(self, seed: int | None = None) -> Array:
        """Reset the environment; the coordinates (C,) it starts at.

        Raises:
            StepFailed: ``reset`` gives no pair, or ``coordinates`` no (R,).
        """
        self._at = None
        first: Any = self._environment.reset(seed=seed)
        if not isinstance(first, tuple) or len(first) != 2:
            raise StepFailed(f"expected (observation, info) of reset, got a {type(first).__name__}")
        self._at = begun(self._spec, self._read(first[0]))
        return self._at

    def act(self, action: Array) -> RealStep:
        """Apply action (F,).

        Raises:
            StepFailed: no episode is running, or ``coordinates`` gives no (R,).
        """
        if self._at is None:
            raise StepFailed("expected an action in a running episode, got one after its end or before a reset")
        before, self._at = self._at, None
        native = native_action(self._spec.action, action)
        observation, reward, terminated, truncated, _ = self._environment.step(native)
        taken = np.atleast_1d(np.asarray(native, dtype=np.float64))
        reached = followed(self._spec, before, taken, self._read(observation))
        if not (terminated or truncated):
            self._at = reached
        return RealStep(
            coordinates=before,
            action=taken,
            next_coordinates=reached,
            reward=float(reward),
            terminated=bool(terminated),
            truncated=bool(truncated),
        )

    def save(self) -> bytes:
        """The whole state, in the environment's own form. Raises ``StepFailed`` if it is not bytes."""
        snapshot: Any = _saving(self._environment).save()
        if not isinstance(snapshot, bytes):
            raise StepFailed(f"expected bytes from save, got a {type(snapshot).__name__}")
        return snapshot

    def restore(self, snapshot: bytes) -> Array:
        """Return to the state of a snapshot; the coordinates (C,) there."""
        self._at = None
        self._at = self._read(_saving(self._environment).restore(snapshot))
        return self._at

    def close(self) -> None:
        self._environment.close()

    def _read(self, observation: Any) -> Array:
        read = np.asarray(self._environment.coordinates(observation), dtype=np.float64)
        names = read_names(self._spec)
        if read.shape != (len(names),):
            raise StepFailed(f"expected coordinates ({', '.join(names)}), got an array of shape {read.shape}")
        return read


def _saving(environment: object) -> SnapshotEnvironment:
    """Return the environment if it has ``save`` and ``restore``. Raises ``StepFailed`` otherwise."""
    if not isinstance(environment, SnapshotEnvironment):
        raise StepFailed("expected the methods save and restore for snapshots, got an environment without them")
    return environment


def _only_resets(environment: object) -> TypeGuard[ResettableEnvironment]:
    if isinstance(environment, RolloutEnvironment) or not isinstance(environment, ResettableEnvironment):
        return False
    return environment.spec().query == "rollout" or not isinstance(environment, OriginalEnvironment)


def answering(environment: object) -> Environment:
    """Adapt an environment to the kind of query that its specification declares."""
    _check_snapshots(environment)
    if _only_resets(environment):
        environment = FromReset(environment)
    if not isinstance(environment, (OriginalEnvironment, RolloutEnvironment)):
        raise UnknownEnvironment(
            "expected an object with spec, step_from and close, or with spec, reset, step, coordinates and close, "
            f"got a {type(environment).__name__}"
        )
    query = environment.spec().query
    needed, methods = (
        (RolloutEnvironment, "reset, step and coordinates")
        if query == "rollout"
        else (OriginalEnvironment, "step_from")
    )
    if not isinstance(environment, needed):
        raise UnknownEnvironment(
            f"its specification declares query={query!r}, which needs {methods}: some of them are missing"
        )
    return environment


def _check_snapshots(environment: object) -> None:
    declared = callable(getattr(environment, "spec", None)) and environment.spec().snapshots  # type: ignore[attr-defined]
    if declared and not isinstance(environment, SnapshotEnvironment):
        raise UnknownEnvironment(
            "its specification declares snapshots, which need the methods save and restore: some of them are missing"
        )
