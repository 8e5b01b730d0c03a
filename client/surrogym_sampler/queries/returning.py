"""Saving of an environment's states as snapshots, and return to them."""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from surrogym_client.transport.api import Api
from surrogym_sampler.original.errors import (
    EnvironmentDied,
    SnapshotGone,
    SnapshotNotKept,
    StepFailed,
    StepTimedOut,
    sentence,
)
from surrogym_sampler.original.protocol import Array, Environment, SnapshotEnvironment
from surrogym_sampler.queries.settings import SamplerSettings
from surrogym_sampler.queries.snapshots import SnapshotFolder
from surrogym_shared.spec import EnvironmentSpec, limits

SKIPPED = "the design chooses another query, and surrogym doctor --env ENVIRONMENT checks save and restore"
MOST_HANGS = 2  # number of time-outs of `save` in a row after which no state is saved; a single one may be chance
# A restored state is reported if it differs from the saved one by more than this share of a sampling range.
ELSEWHERE = 0.01


@runtime_checkable
class Resettable(SnapshotEnvironment, Protocol):
    """An environment that can be reset and can return to snapshots."""

    def begin(self, seed: int | None = None) -> Array: ...


class Returning:
    """Saves states of an environment as snapshots, and returns to them for queries that begin there.

    Args:
        environment: saves and restores its state.
        spec: the environment's specification.
        folder: stores the snapshots.
        known: names of the snapshots that the server knows.

    Attributes:
        gone: names of snapshots that no longer exist, of which the server has not been told yet.
    """

    def __init__(
        self,
        environment: Resettable,
        spec: EnvironmentSpec,
        folder: SnapshotFolder,
        known: Collection[str] = (),
    ) -> None:
        self._environment, self._spec, self._folder = environment, spec, folder
        self.gone = sorted(set(known) - set(folder.names()))
        self._hung_saves = 0
        self._remarks: dict[str, str] = {}  # first remark of each kind; "" after it was reported
        if self.gone:
            self._remark(
                "start",
                f"{len(self.gone)} of {len(known)} snapshots that the server knew are not in this sampler's folder, or "
                "can't be used, so the server forgets them",
            )

    def begin(self, name: str) -> None:
        """Return to a snapshot.

        Raises:
            SnapshotGone: the snapshot can't be used, or the environment died or hung twice when it was to return there.
                The snapshot is deleted.
            StepTimedOut, EnvironmentDied: the environment hung or died, and can't be reset either.
        """
        try:
            try:
                self._restore(name)
            except (StepTimedOut, EnvironmentDied):
                if not self._resets():
                    raise  # the environment can't be reset either, so the snapshot is not at fault
                self._restore_again(name)
        except SnapshotGone:
            self._folder.drop(name)
            self.gone.append(name)
            raise

    def save(self, coordinates: Sequence[float]) -> str | None:
        """Save the current state, which has the coordinates (C,), and return its name; None if it can't be saved.

        Raises:
            StepTimedOut, EnvironmentDied: the environment hung or died, so no step can follow.
        """
        if self._hung_saves >= MOST_HANGS:
            return None
        try:
            name, dropped = self._folder.add(self._state(), coordinates)
        except (StepTimedOut, EnvironmentDied):
            self._hung_saves += 1
            if self._hung_saves == MOST_HANGS:
                self._remark("hangs", "this sampler saves no state any more, because save hung or died too often")
            raise
        except (StepFailed, SnapshotNotKept) as error:
            self._remark("save", f"a state is not kept, so no query will begin there: {error}")
            return None
        self._hung_saves = 0
        self.gone += dropped
        return name

    def handed_in(self, names: Iterable[str]) -> None:
        """Check snapshots that the server has just learned of, and add the names of those that no longer exist to
        ``gone``. Another sampler may have deleted them, or this one while it sent their samples."""
        self.gone += [name for name in names if name not in self._folder and name not in self.gone]

    def remarks(self) -> str:
        """Return remarks about faults that harmed no query and were not reported yet, each kind once; empty if there
        are none."""
        untold = "; ".join(filter(None, self._remarks.values()))
        self._remarks = dict.fromkeys(self._remarks, "")
        return untold

    def _remark(self, kind: str, remark: str) -> None:
        self._remarks.setdefault(kind, remark)

    def _state(self) -> bytes:
        try:
            state: Any = self._environment.save()
        except StepFailed:
            raise
        except Exception as error:  # an environment that runs in this process may raise anything
            raise SnapshotNotKept(sentence(error)) from error
        if not isinstance(state, bytes):
            raise SnapshotNotKept(
                f"expected bytes from save, got a {type(state).__name__}: let save return the state as bytes"
            )
        return state

    def _restore(self, name: str) -> None:
        saved, state = self._folder.read(name)
        try:
            reached: Any = self._environment.restore(state)
        except (StepTimedOut, EnvironmentDied):
            raise  # either the snapshot or the environment may be at fault
        except Exception as error:  # an environment that runs in this process may raise anything
            raise SnapshotGone(f"snapshot {name} can't be restored: {sentence(error)}; {SKIPPED}") from error
        self._compare(name, np.array(saved), reached)

    def _restore_again(self, name: str) -> None:
        """Return to a snapshot at which the environment died or hung, although it can be reset. Raises ``SnapshotGone``
        if that happens again."""
        try:
            self._restore(name)
        except (StepTimedOut, EnvironmentDied) as error:
            raise SnapshotGone(f"snapshot {name} can't be restored: {error}, twice; {SKIPPED}") from error

    def _resets(self) -> bool:
        """Return whether the environment, started again, can be reset."""
        try:
            self._environment.begin()
        except Exception:  # an environment that runs in this process may raise anything
            return False
        return True

    def _compare(self, name: str, saved: NDArray[np.float64], reached: Any) -> None:
        """Check the coordinates (C,) that a return to a snapshot reached, and add a remark if they differ from the
        saved ones."""
        try:
            at = np.asarray(reached, dtype=np.float64)
        except (TypeError, ValueError):
            at = np.zeros(0)
        if at.shape != saved.shape or not np.isfinite(at).all():
            names = ", ".join(self._spec.coordinate_names)
            raise SnapshotGone(
                f"snapshot {name} can't be restored: expected coordinates ({names}), got {reached!r:.200}; {SKIPPED}"
            )
        apart = np.abs(at - saved)
        for coordinate, number, now, before in zip(self._spec.coordinates, apart, at, saved, strict=True):
            turned = min(number, abs(2 * np.pi - number)) if coordinate.kind == "angle" else number
            if turned > ELSEWHERE * float(np.ptp(limits(coordinate.sampling))):
                self._remark(
                    "restore",
                    f"restore leads to another state than was saved, first at snapshot {name}: expected {before:g} for "
                    f"{coordinate.name!r}, got {now:g}; surrogym doctor checks save and restore",
                )
                return


@contextmanager
def snapshots_of(
    api: Api, surrogate: str, environment: Environment, spec: EnvironmentSpec, settings: SamplerSettings
) -> Iterator[Returning | None]:
    """Open the folder of a surrogate's snapshots; None if the environment has no snapshots.

    Raises:
        UnusableFolder: the folder can't be made or written to.
    """
    if not spec.snapshots:
        yield None
        return
    assert isinstance(environment, Resettable)  # check_environment has checked that save and restore exist
    with tempfile.TemporaryDirectory(prefix="surrogym-snapshots-") as ended:
        kept = SnapshotFolder((settings.snapshots or Path(ended)) / surrogate, spec, settings.bounds)
        # The folder is read before the server is asked. A snapshot that is written in between may belong to a sample
        # that the server has not received yet, so it must not be dropped.
        before = kept.names()
        known = {one.name for one in api.snapshots(surrogate)}
        kept.drop_first(set(before) - known)
        yield Returning(environment, spec, kept, known)
