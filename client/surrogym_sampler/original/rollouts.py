"""Adaptation of environments that can only be reset and acted on to the interface that the sampler uses."""

from __future__ import annotations

from typing import Any, TypeGuard

import numpy as np

from surrogym_sampler.original.errors import StepFailed, UnknownEnvironment
from surrogym_sampler.original.gymnasium import native_action
from surrogym_sampler.original.lags import begun, followed, parts_of, placed, read_names, snapshot_with
from surrogym_sampler.original.protocol import (
    Array,
    Environment,
    OriginalEnvironment,
    RealStep,
    ResettableEnvironment,
    RolloutEnvironment,
    SnapshotEnvironment,
    runs_in_parallel,
)
from surrogym_shared.rates import rates, within_rates
from surrogym_shared.spec import EnvironmentSpec

# Methods that each of the two kinds of environment needs.
KINDS = (("spec", "step_from", "close"), ("spec", "reset", "step", "coordinates", "close"))


class FromReset:
    """A ``ResettableEnvironment`` as a ``RolloutEnvironment``: each step begins where the previous one ended.

    The environment reports R coordinates. The others are lags, which repeat earlier values of these coordinates or
    earlier actions.
    """

    keeps_rates = True  # whether actions are changed so that they keep the declared rates

    def __init__(self, environment: ResettableEnvironment) -> None:
        self._environment = environment
        self._spec = environment.spec()
        self._rates = rates(self._spec)
        self._at: Array | None = None
        size = len(self._spec.coordinates)
        # number of bytes that precede the environment's in a snapshot: the coordinates, if some are lags (past values)
        self._prefix = 8 * size if size > len(read_names(self._spec)) else 0
        self.parallel = runs_in_parallel(environment)

    def spec(self) -> EnvironmentSpec:
        return self._spec

    def begin(self, seed: int | None = None) -> Array:
        """Reset the environment, and return the start coordinates (C,).

        Raises:
            StepFailed: ``reset`` does not return a pair, or ``coordinates`` does not return an array (R,) of the R
                coordinates that are no lags.
        """
        self._at = None
        first: Any = self._environment.reset(seed=seed)
        if not isinstance(first, tuple) or len(first) != 2:
            raise StepFailed(
                f"expected reset to return (observation, info), got a {type(first).__name__}: correct the environment"
            )
        self._at = begun(self._spec, self._read(first[0]))
        return self._at

    def act(self, action: Array) -> RealStep:
        """Apply an action (F,), or the nearest one that keeps the declared rates, and return the real step.

        Raises:
            StepFailed: no episode is running, or ``coordinates`` does not return an array (R,) of the R coordinates
                that are no lags.
        """
        if self._at is None:
            raise StepFailed(
                "expected a running episode, got an action before a reset or after the episode's end: reset the "
                "environment first"
            )
        before, self._at = self._at, None
        native = native_action(self._spec.action, within_rates(self._rates, before, action))
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

    def resume(self, coordinates: Array) -> None:
        """Continue the episode at coordinates (C,) after a failed step, so that the fallback controller can act."""
        self._at = coordinates

    def save(self) -> bytes:
        """Return a snapshot of the whole state: the environment's own bytes. The coordinates are put before these if
        some of them repeat earlier values (lags).

        Raises:
            StepFailed: the environment's ``save`` does not return bytes, or there are lags and no episode is running.
        """
        snapshot: Any = _saving(self._environment).save()
        if not isinstance(snapshot, bytes):
            raise StepFailed(f"expected save to return bytes, got a {type(snapshot).__name__}: correct the environment")
        return snapshot_with(self._at, snapshot, self._prefix)

    def restore(self, snapshot: bytes) -> Array:
        """Return to the state of a snapshot, and return the coordinates (C,) there.

        Raises:
            StepFailed: the snapshot is too short to contain the coordinates, or ``coordinates`` does not return an
                array (R,) of the R coordinates that are no lags.
        """
        self._at = None
        before, own = parts_of(snapshot, self._prefix)
        read = self._read(_saving(self._environment).restore(own))
        before = before if self._prefix else np.zeros(len(read))
        self._at = placed(self._spec, read, before)
        return self._at

    def close(self) -> None:
        self._environment.close()

    def _read(self, observation: Any) -> Array:
        read = np.asarray(self._environment.coordinates(observation), dtype=np.float64)
        names = read_names(self._spec)
        if read.shape != (len(names),):
            raise StepFailed(
                f"expected coordinates() to return ({', '.join(names)}), got an array of shape {read.shape}: "
                "correct the method"
            )
        return read


def _saving(environment: object) -> SnapshotEnvironment:
    """Return the environment if it has ``save`` and ``restore``. Raises ``StepFailed`` otherwise."""
    if not isinstance(environment, SnapshotEnvironment):
        raise StepFailed(
            "expected the methods save and restore for snapshots, got an environment without them: add both"
        )
    return environment


def _only_resets(environment: object) -> TypeGuard[ResettableEnvironment]:
    if isinstance(environment, RolloutEnvironment) or not isinstance(environment, ResettableEnvironment):
        return False
    return environment.spec().query == "rollout" or not isinstance(environment, OriginalEnvironment)


def answering(environment: object) -> Environment:
    """Return an environment with the interface for the kind of query that its specification declares.

    Raises:
        UnknownEnvironment: the object lacks methods that its kind of query, or its snapshots, need.
    """
    _check_snapshots(environment)
    if _only_resets(environment):
        environment = FromReset(environment)
    if not isinstance(environment, (OriginalEnvironment, RolloutEnvironment)):
        raise UnknownEnvironment(
            "expected an object with spec, step_from and close, or with spec, reset, step, coordinates and close, "
            f"got a {_class_of(environment)} without {_missing(environment)}"
        )
    if rates(environment.spec()) and not getattr(environment, "keeps_rates", False):
        raise UnknownEnvironment(
            "the action has a rate, which Surrogym keeps only in an environment with reset, step and coordinates: "
            f"expected these methods, got a {_class_of(environment)} without: write them, or remove the rate"
        )
    query = environment.spec().query
    needed, methods = (
        (RolloutEnvironment, "reset, step and coordinates")
        if query == "rollout"
        else (OriginalEnvironment, "step_from")
    )
    if not isinstance(environment, needed):
        other = '; for an environment that can only be reset, declare query="rollout"' if query == "step" else ""
        raise UnknownEnvironment(
            f"the environment's specification declares query={query!r}, which needs {methods}: add those that are "
            f"missing{other}"
        )
    return environment


def keeping_limits(environment: Environment, fallback: str | None = None) -> Environment:
    """Return an environment that keeps the limits of its specification. An environment without limits is returned
    unchanged.

    Args:
        environment: the environment. It is closed if this raises an error.
        fallback: program of the fallback that the specification's limits name, as NAME=package.module:function.

    Raises:
        UnknownEnvironment: the limits name a fallback, and ``fallback`` does not give its program; or the reverse.
    """
    if environment.spec().limits is None and fallback is None:
        return environment
    from surrogym_sampler.original.limits import guarded

    try:
        return guarded(environment, fallback)
    except UnknownEnvironment:
        environment.close()
        raise


def _class_of(environment: object) -> str:
    """Return the name of the user's class, also if its specification is replaced."""
    return type(getattr(environment, "wrapped", environment)).__name__


def _missing(environment: object) -> str:
    """Return the names of the methods that an object lacks to be an original environment. There are two kinds of
    environment; the names are those for the kind that lacks fewer methods or, if both lack equally many, for the kind
    that has more methods."""
    lacking = [[name for name in names if not callable(getattr(environment, name, None))] for names in KINDS]
    nearest = min(range(len(KINDS)), key=lambda kind: (len(lacking[kind]), -len(KINDS[kind])))
    return " and ".join(lacking[nearest])


def _check_snapshots(environment: object) -> None:
    declared = callable(getattr(environment, "spec", None)) and environment.spec().snapshots  # type: ignore[attr-defined]
    if declared and not isinstance(environment, SnapshotEnvironment):
        raise UnknownEnvironment(
            "the environment's specification declares snapshots, which need the methods save and restore: add those "
            "that are missing"
        )
