"""Saves the states of an environment, and returns to them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from surrogym_client.original.errors import EnvironmentDied, SnapshotGone, StepFailed, StepTimedOut, sentence
from surrogym_client.original.protocol import Array, SnapshotEnvironment
from surrogym_client.sampler.snapshots import SnapshotFolder


@runtime_checkable
class Resettable(SnapshotEnvironment, Protocol):
    """An environment that can also be reset."""

    def begin(self, seed: int | None = None) -> Array: ...


class Returning:
    """The snapshots of an environment that answers queries.

    Args:
        environment: saves and restores its state.
        folder: keeps the snapshots.
        known: names of the snapshots that the server knows.

    Attributes:
        gone: names of snapshots that the server has yet to forget.
    """

    def __init__(self, environment: Resettable, folder: SnapshotFolder, known: Sequence[str] = ()) -> None:
        self._environment, self._folder = environment, folder
        self.gone = sorted(set(known) - set(folder.names()))

    def begin(self, name: str) -> None:
        """Return to a snapshot.

        Raises:
            SnapshotGone: it can't be used, or the environment died or hung at it twice; it is dropped.
            StepTimedOut, EnvironmentDied: the environment hung or died, and can't be reset either.
        """
        try:
            try:
                self._restore(name)
            except (StepTimedOut, EnvironmentDied):
                if not self._resets():
                    raise  # the fault is the machine's
                self._restore_again(name)
        except SnapshotGone:
            self._folder.drop(name)
            self.gone.append(name)
            raise

    def save(self, coordinates: Sequence[float]) -> str | None:
        """Save the present state, which has the coordinates (C,). Returns its name; None if it can't be saved."""
        try:
            state = self._environment.save()
        except StepFailed:
            return None
        name, dropped = self._folder.add(state, coordinates)
        self.gone += dropped
        return name

    def _restore(self, name: str) -> None:
        state = self._folder.state(name)
        try:
            self._environment.restore(state)
        except (StepTimedOut, EnvironmentDied):
            raise  # the fault may be the snapshot's or the machine's
        except Exception as error:  # an environment that is not isolated may raise anything
            raise SnapshotGone(f"snapshot {name} can't be restored: {sentence(error)}") from error

    def _restore_again(self, name: str) -> None:
        """Return to a snapshot at which the environment died or hung, although it can be reset."""
        try:
            self._restore(name)
        except (StepTimedOut, EnvironmentDied) as error:
            raise SnapshotGone(f"snapshot {name} can't be restored: {error}, twice") from error

    def _resets(self) -> bool:
        """Whether the environment, started anew, can be reset."""
        try:
            self._environment.begin()
        except Exception:  # an environment that is not isolated may raise anything
            return False
        return True
