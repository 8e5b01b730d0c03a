"""The process of an FMU's host, seen from this process: it is started, sent requests, ended, and started again.

Shapes: V variables that are read, F inputs.
"""

from __future__ import annotations

import hashlib
import shlex
import shutil
import struct
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from surrogym_sampler.original.errors import (
    MORE_TIME,
    EnvironmentDied,
    OriginalError,
    RequestRefused,
    StepFailed,
    StepTimedOut,
    UnknownEnvironment,
)
from surrogym_sampler.original.executables.messages import Reply, numbers, truth
from surrogym_sampler.original.executables.program import Program
from surrogym_sampler.original.fmus.archive import Archive, Declared
from surrogym_sampler.original.fmus.choices import Value
from surrogym_sampler.original.protocol import Array

START_LIMIT = 120.0  # seconds within which the native code must be loaded
HEADER = struct.Struct("<8s16sqq")  # a snapshot's version, FMU's digest, steps so far, key
FORM = b"SGFMU\x00\x00\x01"
COMMAND = shlex.join([sys.executable, "-m", "surrogym_sampler.original.fmus.host"])

Start = tuple[str, int, Value]


class Process:
    """An FMU in a process of its own. A crash or a hang ends that process; ``initialise`` and ``restore`` start it
    again.

    Args:
        archive: the FMU's declarations.
        inputs: the F variables that an action sets.
        reads: the V variables that every answer contains.
        step: seconds of one action.
        start: values that every initialisation sets first.

    Raises:
        UnknownEnvironment: the native code can't be loaded.
    """

    def __init__(
        self,
        archive: Archive,
        inputs: Sequence[Declared],
        reads: Sequence[Declared],
        step: float,
        start: Sequence[Start],
    ) -> None:
        self.step_limit = 30.0  # seconds that one answer may take
        self._archive, self._inputs, self._reads, self._step = archive, inputs, reads, step
        self._start = list(start)
        self.parameters: list[Start] = []  # values that every initialisation sets after those of ``start``
        self._program = Program(COMMAND, called=f"the process of {archive.path.name}")
        self._values: Array | None = None
        self._directory = Path(tempfile.mkdtemp(prefix="surrogym-fmu-"))
        try:
            self._digest = _extract(archive, self._directory, [step, *self._start])
            self._open()
        except StepFailed as error:
            self.close()
            raise UnknownEnvironment(f"{archive.path} can't be used: {error}") from error
        except BaseException:
            self.close()
            raise

    @property
    def values(self) -> Array:
        """The values of the V variables that are read (V,), after the last answer.

        Raises:
            StepFailed: the last request failed, so the values are unknown.
        """
        self._check_state()
        assert self._values is not None
        return self._values

    def initialise(self, start: Sequence[Start] = ()) -> None:
        """Start the simulation again at time 0. The values in ``start`` are set in addition to those that every
        initialisation sets."""
        self._revive()
        self._take(self._ask("initialise", start=[*self._start, *self.parameters, *start]))

    def step(self, action: Array) -> bool:
        """Set the inputs (F,), and simulate one step. Returns whether the FMU ends the simulation."""
        self._check_state()
        reply = self._ask("step", action=[float(entry) for entry in action])
        self._take(reply)
        return truth(reply, "over")

    def save(self) -> bytes:
        """Return the FMU's whole state, as bytes for ``restore``."""
        file = self._directory / "snapshot"
        reply = self._ask("save", file=str(file))
        state = b"" if reply["key"] else file.read_bytes()
        return HEADER.pack(FORM, self._digest, reply["steps"], reply["key"]) + state

    def restore(self, snapshot: bytes) -> None:
        """Return to a saved state.

        Raises:
            StepFailed: another FMU made the snapshot, or this process can't use it.
        """
        if len(snapshot) < HEADER.size or not snapshot.startswith(FORM):
            raise StepFailed(
                f"expected a snapshot of {self._archive.path.name}, got {len(snapshot)} other bytes: delete the "
                "snapshot"
            )
        _, digest, steps, key = HEADER.unpack_from(snapshot)
        if digest != self._digest:
            raise StepFailed(
                f"expected a snapshot of {self._archive.path.name} as it is now, got one that was made with another "
                "file, step or start: delete the snapshot, or restore the former file and settings"
            )
        self._revive()
        file = self._directory / "snapshot"
        file.write_bytes(snapshot[HEADER.size :])
        self._take(self._ask("restore", file=str(file), steps=steps, key=key))

    def close(self) -> None:
        """End the process, and delete the extracted files."""
        self._program.close()
        shutil.rmtree(self._directory, ignore_errors=True)

    def _check_state(self) -> None:
        if self._values is None:
            raise StepFailed(
                f"expected {self._archive.path.name} to have a state, got none, because its last request failed: reset "
                "it"
            )

    def _open(self) -> None:
        self._program.start()
        archive = self._archive
        self._ask(
            "open",
            START_LIMIT,
            directory=str(self._directory),
            version=archive.version,
            library=archive.library,
            identifier=archive.identifier,
            token=archive.token,
            step=self._step,
            only_once=archive.only_once,
            serializes=archive.serializes,
            inputs=[(v.type, v.reference) for v in self._inputs],
            reads=[(v.name, v.type, v.reference) for v in self._reads],
        )

    def _revive(self) -> None:
        if self._program.running:
            return
        try:
            self._open()
        except OriginalError as error:
            self._program.end()
            raise EnvironmentDied(f"{self._archive.path.name} could not be started anew: {error}") from error

    def _ask(self, method: str, limit: float | None = None, **fields: Any) -> Reply:
        self._values = self._values if method == "save" else None
        deadline = time.monotonic() + (limit or self.step_limit)
        try:
            return self._program.ask(method, deadline, **fields)
        except StepTimedOut as error:
            raise error if limit else StepTimedOut(f"{error}; {MORE_TIME}") from error
        except RequestRefused as error:
            if error.code == "broken":
                self._program.end()
            said = str(error).partition(": ")[2]
            raise RequestRefused(
                f"the FMU {self._archive.path.name} refused the request {method}: {said}", error.code
            ) from error

    def _take(self, reply: Reply) -> None:
        self._values = numbers(reply, "values", len(self._reads))


def _extract(archive: Archive, directory: Path, others: Sequence[object]) -> bytes:
    """Extract the FMU, and return a digest (16 bytes) of its file and of ``others``: snapshots depend on both."""
    from fmpy import extract

    try:
        extract(str(archive.path), str(directory))
    except Exception as error:  # fmpy refuses unsafe paths in an archive by a plain Exception
        raise UnknownEnvironment(f"{archive.path} can't be extracted: {error}; export the FMU again") from error
    digest = hashlib.sha256(archive.path.read_bytes())
    digest.update(repr(others).encode())
    return digest.digest()[:16]
