"""An original environment that is a program, which answers each line of JSON with a line of JSON.

Shapes: C coordinates, R of them measured and not lags, F action entries.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from surrogym_sampler.original.errors import MORE_TIME, EnvironmentDied, StepFailed, StepTimedOut, UnknownEnvironment
from surrogym_sampler.original.executables.messages import (
    PROTOCOL,
    Reply,
    action_entries,
    number,
    numbers,
    specification_in,
    text,
    truth,
)
from surrogym_sampler.original.executables.program import Program
from surrogym_sampler.original.gymnasium import wrapped
from surrogym_sampler.original.lags import begun, followed, parts_of, placed, read_names, snapshot_with
from surrogym_sampler.original.limits import rest_seconds
from surrogym_sampler.original.protocol import Array, RealStep
from surrogym_shared.spec import EnvironmentSpec

PREFIX = "exec:"
START_LIMIT = 120.0  # seconds until the program must have given its specification; a simulator may start slowly


class Executable:
    """An original environment that is a program which can be reset and acted on.

    If the program dies, hangs or prints something other than an answer, the query fails, and the next query starts it
    once more.

    A program may answer the R measured coordinates alone: if the specification to use adds lags to those that the
    program declares, the lags are computed here.

    Args:
        program: the started program.
        own: the specification that the program declares.
        spec: the specification to use: the program's own, or one that a person gave.
        step_limit: seconds that one step, or one reset, may take.
    """

    def __init__(self, program: Program, own: EnvironmentSpec, spec: EnvironmentSpec, step_limit: float) -> None:
        self._program = program
        self._own = own
        self._spec = spec
        self._step_limit = step_limit
        self._at: Array | None = None
        # number of bytes that precede the program's in a snapshot: the coordinates, if lags are computed here
        measured_alone = own.coordinate_names == read_names(spec) and own.coordinate_names != spec.coordinate_names
        self._prefix = 8 * len(spec.coordinates) if measured_alone else 0

    def spec(self) -> EnvironmentSpec:
        return self._spec

    def begin(self, seed: int | None = None) -> Array:
        """Reset the program, and return the start coordinates (C,)."""
        self._at = None
        self._revive()
        reply = self._ask("reset", self._deadline(), seed=seed)
        self._at = begun(self._spec, self._read(reply)) if self._prefix else self._state(reply)
        return self._at

    def act(self, action: Array) -> RealStep:
        """Take the next step of the running episode, with an action (F,).

        Raises:
            StepFailed: no episode is running, or the program did not give a step.
        """
        before, self._at = self._at, None
        if before is None:
            raise StepFailed(
                "expected a running episode, got an action before a reset or after the episode's end: reset the "
                "environment first"
            )
        step = self._stepped(before, action, self._deadline())
        if not (step.terminated or step.truncated):
            self._at = step.next_coordinates  # type: ignore[assignment]  # an array (C,), from _stepped
        return step

    def resume(self, coordinates: Array) -> None:
        """Continue the episode at coordinates (C,) after a failed step, so that the fallback controller can act."""
        self._at = coordinates

    def save(self) -> bytes:
        """Return the program's snapshot of the current state: the text of its answer, as bytes."""
        return snapshot_with(self._at, text(self._ask("save", self._deadline()), "snapshot").encode(), self._prefix)

    def restore(self, snapshot: bytes) -> Array:
        """Let the program return to a snapshot, and return the coordinates (C,) there."""
        self._at = None
        self._revive()
        before, own = parts_of(snapshot, self._prefix)
        reply = self._ask("restore", self._deadline(), snapshot=own.decode(errors="replace"))
        self._at = placed(self._spec, self._read(reply), before) if self._prefix else self._state(reply)
        return self._at

    def close(self) -> None:
        """Ask the program to close, and kill it if it does not."""
        self._program.close()

    def _stepped(self, before: Array, action: Array, deadline: float) -> RealStep:
        sent = action_entries(self._spec.action, action)
        reply = self._ask("step", deadline, action=sent)
        taken = numbers(reply if "action" in reply else {"action": sent}, "action", len(sent))
        if self._prefix:
            reached = followed(self._spec, before, taken, self._read(reply))
        else:
            reached = self._state(reply)
        return RealStep(
            coordinates=before,
            action=taken,
            next_coordinates=reached,
            reward=number(reply, "reward"),
            terminated=truth(reply, "terminated"),
            truncated=truth(reply, "truncated"),
        )

    def _state(self, reply: dict[str, object]) -> Array:
        return wrapped(self._spec, numbers(reply, "state", len(self._spec.coordinates)))

    def _read(self, reply: dict[str, object]) -> Array:
        return numbers(reply, "state", len(read_names(self._spec)))

    def _revive(self) -> None:
        """Start the program again if it has ended. Only the first request of a query may do so, because later requests
        depend on the state that ended with the program."""
        if self._program.running:
            return
        try:
            own = _specification(self._program)
        except UnknownEnvironment as error:
            self._program.end()
            raise EnvironmentDied(f"the program could not be started anew: {error}") from error
        if own != self._own:
            self._program.end()
            raise EnvironmentDied(
                "expected the program to give the same specification when it is started again, got another one: "
                "correct the program"
            )

    def _ask(self, method: str, deadline: float, **fields: object) -> Reply:
        try:
            return self._program.ask(method, deadline, **fields)
        except StepTimedOut as error:
            raise StepTimedOut(f"{error}; {MORE_TIME}") from error

    def _deadline(self) -> float:
        return time.monotonic() + self._step_limit


class SettableExecutable(Executable):
    """An original environment that is a program whose state can be set."""

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        """Set the program to coordinates (C,) and apply an action (F,). One time limit holds for both together."""
        self._revive()
        deadline = self._deadline()
        achieved = self._state(self._ask("set", deadline, state=[float(c) for c in coordinates]))
        return self._stepped(achieved, action, deadline)


def is_executable(name: str) -> bool:
    """Return whether a name has the form ``exec:COMMAND``."""
    return name.startswith(PREFIX)


def name_of(command: str) -> str:
    """Return the environment name ``exec:COMMAND`` of a command; a command that has this prefix already is one."""
    return f"{PREFIX}{command.removeprefix(PREFIX)}"


def open_executable(
    name: str,
    spec: EnvironmentSpec | None = None,
    choose: Callable[[EnvironmentSpec], EnvironmentSpec] = lambda spec: spec,
    step_limit: float = 30.0,
) -> Executable:
    """Start the program of ``exec:COMMAND``, and return it as an environment.

    Args:
        name: the environment's name.
        spec: a specification that replaces the program's own.
        choose: changes the specification.
        step_limit: seconds that one step, or one reset, may take.

    Raises:
        UnknownEnvironment: the program can't be started, or does not give a specification.
        ValueError: the choices contradict the specification.
    """
    command = name.removeprefix(PREFIX)
    program = Program(command, grace=step_limit)
    try:
        own = _specification(program)
        chosen = choose(spec or own)
        if chosen.limits is not None:
            program.grant(rest_seconds(chosen))
    except StepFailed as error:
        program.end()
        raise UnknownEnvironment(f"expected a specification from the program {command!r}, got none: {error}") from error
    except BaseException:
        program.end()
        raise
    kind = Executable if chosen.query == "rollout" else SettableExecutable
    return kind(program, own, chosen, step_limit)


def _specification(program: Program) -> EnvironmentSpec:
    """Start a program, and return its specification."""
    program.start()
    return specification_in(program.ask("spec", time.monotonic() + START_LIMIT, protocol=PROTOCOL))
