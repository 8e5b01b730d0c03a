"""One instance of an FMU at a time, by fmpy: the calls of FMI 2.0 and 3.0 behind one interface.

This module runs in the host process, because a fault of the native code ends the process. Times are in seconds.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Slave, fmi2Discard, fmi2Fatal, fmi2Terminated
from fmpy.fmi3 import FMU3Slave

Value = bool | int | float | str
Typed = tuple[str, int]  # FMI type and value reference of a variable
Start = tuple[str, int, Value]  # FMI type, value reference and value to set before the FMU is initialised
STATUS = {2: "discard", 3: "error", 4: "fatal", 5: "pending (it works asynchronously)"}
# The type, by FMI version, in the name of the FMI functions that get and set variables of another type.
SET_AS = {"Enumeration": {2: "Integer", 3: "Int64"}}


class Broken(Exception):
    """The native code reported a fatal error, so nothing in this process can be used any more."""


class Refused(Exception):
    """The FMU answered a call with an error."""


@dataclass(frozen=True)
class Saved:
    """A saved state, as the FMU returned it, and the number of steps since the FMU's initialisation."""

    state: Any
    steps: int


class Instance:
    """The native code of an FMU, and at most one instance of it.

    Args:
        version: main version of FMI, 2 or 3.
        directory: the folder to which the FMU was extracted.
        library: path of the native code inside that folder.
        identifier: identifier of the model.
        token: the token in the model description.
        step: seconds of one step.
        only_once: whether the instance must be reset instead of being made again.
    """

    def __init__(
        self, version: int, directory: str, library: str, identifier: str, token: str, step: float, only_once: bool
    ) -> None:
        self._version, self._step, self._only_once = version, step, only_once
        self._fmu: Any = {2: FMU2Slave, 3: FMU3Slave}[version](
            guid=token,
            modelIdentifier=identifier,
            unzipDirectory=directory,
            instanceName=identifier,
            libraryPath=str(Path(directory, library)),
        )
        self._exists = self._initialised = False
        self._steps = 0  # number of steps since the initialisation

    def initialise(self, start: Sequence[Start]) -> None:
        """Make an instance at time 0; ``start`` contains the values to set before its initialisation."""
        self._renew()
        with _words("the start"):
            for kind, reference, value in start:
                self._set(kind, [reference], [value])
            if self._version == 2:
                self._fmu.setupExperiment(startTime=0.0)
            self._fmu.enterInitializationMode()
            self._fmu.exitInitializationMode()
        self._initialised, self._steps = True, 0

    def step(self, inputs: Sequence[Typed], action: Sequence[float]) -> bool:
        """Set the inputs, and simulate one step. Returns whether the FMU ends the simulation."""
        with _words("the step"):
            for (kind, reference), value in zip(inputs, action, strict=True):
                self._set(kind, [reference], [value])
            over = self._do_step(self._steps * self._step)
        self._steps += 1
        return over

    def read(self, variables: Sequence[Typed]) -> list[float]:
        """Return the values of variables, in the order of ``variables``."""
        with _words("reading"):
            by_kind = {kind: [r for k, r in variables if k == kind] for kind, _ in variables}
            read = {kind: iter(self._get(kind, references)) for kind, references in by_kind.items()}
        return [float(next(read[kind])) for kind, _ in variables]

    def save(self) -> Saved:
        """Save the FMU's state."""
        with _words("saving"):
            return Saved(self._fmu.getFMUState(), self._steps)

    def restore(self, saved: Saved) -> None:
        """Return to a saved state."""
        if not self._initialised:
            self.initialise(())
        with _words("restoring"):
            self._fmu.setFMUState(saved.state)
        self._steps = saved.steps

    def as_bytes(self, saved: Saved) -> bytes:
        """Convert a saved state to bytes."""
        with _words("serialising"):
            return bytes(self._fmu.serializeFMUState(saved.state))

    def from_bytes(self, state: bytes, steps: int) -> Saved:
        """Convert bytes to a saved state; ``steps`` is its number of steps since the initialisation."""
        if not self._initialised:
            self.initialise(())
        with _words("reading a saved state"):
            return Saved(self._fmu.deserializeFMUState(state), steps)

    def forget(self, saved: Saved) -> None:
        """Free the memory of a saved state."""
        with _words("freeing a saved state"):
            self._fmu.freeFMUState(saved.state)

    def close(self) -> None:
        """End the instance. The native code stays loaded until the process ends."""
        self._terminate()
        if self._exists:
            with suppress(FMICallException):
                self._free()
        self._exists = False

    def _renew(self) -> None:
        """Make a new instance, or reset the only one that may exist."""
        self._terminate()
        if self._exists and self._only_once:
            with _words("the reset"):
                self._fmu.reset()
            return
        if self._exists:
            self._free()
            self._exists = False
        try:
            self._fmu.instantiate()
        except Exception as error:  # fmpy raises a plain Exception
            raise Refused(
                "the FMU could not be instantiated: see the lines that it printed, and export it again"
            ) from error
        self._exists = True

    def _terminate(self) -> None:
        if self._initialised:
            self._initialised = False
            with suppress(FMICallException):
                self._fmu.terminate()

    def _free(self) -> None:
        """Free the instance but keep the library loaded, unlike fmpy's ``freeInstance``."""
        free = self._fmu.fmi2FreeInstance if self._version == 2 else self._fmu.fmi3FreeInstance
        free(self._fmu.component)

    def _do_step(self, time: float) -> bool:
        if self._version == 3:
            _, over, early, _ = self._fmu.doStep(currentCommunicationPoint=time, communicationStepSize=self._step)
            if early and not over:
                raise Refused(
                    f"expected the FMU to simulate the whole step of {self._step:g} s, got an early return: set a "
                    'smaller "step" (seconds of one action) in its JSON file, or export the FMU without early return'
                )
            return bool(over)
        try:
            self._fmu.doStep(currentCommunicationPoint=time, communicationStepSize=self._step)
        except FMICallException as error:
            if error.status == fmi2Discard and self._terminated():
                return True
            raise
        return False

    def _terminated(self) -> bool:
        try:
            return bool(self._fmu.getBooleanStatus(fmi2Terminated))
        except FMICallException:
            return False

    def _set(self, kind: str, references: list[int], values: list[Value]) -> None:
        getattr(self._fmu, f"set{self._called(kind)}")(references, values)

    def _get(self, kind: str, references: list[int]) -> list[Any]:
        return list(getattr(self._fmu, f"get{self._called(kind)}")(references))

    def _called(self, kind: str) -> str:
        return SET_AS.get(kind, {}).get(self._version, kind)


@contextmanager
def _words(during: str) -> Iterator[None]:
    """Context that converts an error of an FMI call to ``Broken`` or ``Refused``, with a message."""
    try:
        yield
    except FMICallException as error:
        status = STATUS.get(error.status, error.status)
        raise (Broken if error.status == fmi2Fatal else Refused)(
            f"the FMU answered {error.function} with status {status}, during {during}"
        ) from error
