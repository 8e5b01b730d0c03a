"""The program under test, with requests that check its answers.

Shapes: C coordinates, F action entries.
"""

from __future__ import annotations

import time
from typing import Self

import numpy as np

from surrogym_sampler.diagnosis.outcomes import Mismatch
from surrogym_sampler.original.actions import random_action
from surrogym_sampler.original.episodes import draw
from surrogym_sampler.original.errors import RequestRefused
from surrogym_sampler.original.executables.messages import (
    PROTOCOL,
    Reply,
    action_entries,
    number,
    numbers,
    specification_in,
    truth,
)
from surrogym_sampler.original.executables.program import Program
from surrogym_sampler.original.protocol import Array
from surrogym_shared.spec import EnvironmentSpec

UNSUPPORTED = "unsupported"


class LeftOut(Exception):
    """The check does not apply to this program; the message is the reason."""


class Subject:
    """A program under test, its specification, and random states and actions for it.

    Args:
        command: the program and its arguments, quoted as for a shell.
        seconds: time allowed for each answer.
    """

    spec: EnvironmentSpec

    def __init__(self, command: str, seconds: float) -> None:
        self.program = Program(command)
        self.seconds = seconds
        self._rng = np.random.default_rng(0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.program.close()

    @property
    def deadline(self) -> float:
        """The time on the monotonic clock by which an answer to a request sent now must arrive."""
        return time.monotonic() + self.seconds

    def start(self) -> None:
        """Start the program, and read its specification into ``spec``.

        Raises:
            UnknownEnvironment: there is no such program, or its specification is invalid.
            StepFailed: the program did not answer.
        """
        self.program.start()
        self.spec = specification_in(self.ask("spec", protocol=PROTOCOL))

    def revive(self) -> None:
        """Start the program anew if an earlier check has ended it."""
        if not self.program.running:
            self.start()

    def ask(self, method: str, **fields: object) -> Reply:
        """Send the request ``method`` with these fields, and return the result."""
        return self.program.ask(method, self.deadline, **fields)

    def ask_if_supported(self, method: str, **fields: object) -> Reply:
        """Send a request that a program need not support, and return the result.

        Raises:
            LeftOut: the program does not support it.
        """
        try:
            return self.ask(method, **fields)
        except RequestRefused as refused:
            if refused.code == UNSUPPORTED:
                raise LeftOut(f"the program does not support the request {method}, which is optional") from refused
            raise

    def refused(self, method: str, **fields: object) -> RequestRefused:
        """Send a request that must be answered with an error, and return the error."""
        try:
            result = self.ask(method, **fields)
        except RequestRefused as error:
            return error
        raise Mismatch(
            f"expected the program to refuse the request {method}, got the result {result}: let it answer with an error"
        )

    def reset(self, seed: int | None) -> Array:
        """Reset the program with a seed, and return the coordinates (C,) of the start."""
        return self.state(self.ask("reset", seed=seed))

    def set(self, state: Array) -> Array:
        """Set the program to a state (C,), and return the coordinates (C,) that it reports.

        Raises:
            LeftOut: the program declares rollout queries, so its state can't be set.
        """
        if self.spec.query == "rollout":
            raise LeftOut("the program's specification declares rollout queries, so its state can't be set")
        return self.state(self.ask("set", state=[float(entry) for entry in state]))

    def begin(self) -> None:
        """Bring the program into a state from which a step can be taken: a reset, or a random state that is set."""
        if self.spec.query == "rollout":
            self.reset(0)
        else:
            self.set(self.random_state())

    def step(self, action: Array) -> Array:
        """Apply an action (F,), check every field of the answer, and return the next coordinates and the reward (C +
        1,)."""
        reply = self.ask("step", action=action_entries(self.spec.action, action))
        truth(reply, "terminated")
        truth(reply, "truncated")
        return np.append(self.state(reply), number(reply, "reward"))

    def state(self, reply: Reply) -> Array:
        """Return the coordinates (C,) in a reply."""
        return numbers(reply, "state", len(self.spec.coordinates))

    def random_state(self) -> Array:
        """Return random coordinates (C,) within the sampling ranges."""
        return draw(self.spec, self._rng, wide=True)

    def random_action(self) -> Array:
        """Return a random action (F,) of the action space."""
        return random_action(self.spec, self._rng)
