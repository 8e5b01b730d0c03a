"""Errors of the original environment.

OriginalError
├── UnknownEnvironment      no environment can be made from this name, or no specification can express it
├── NotPerturbable          the environment's physical attributes can't be changed, because they are unknown
├── NotSettable             the environment can't be set to a state, only reset
├── PolicyMisfit            the policy was trained for another environment, or gives unknown actions
├── QueryRefused            the environment's specification does not allow a query; nothing was sent to it
├── SnapshotGone            a query begins at a snapshot that can't be used; the design chooses another query
├── SnapshotNotKept         a state can't be saved or written; no query will begin there
├── UnusableFolder          snapshots can't be kept in this folder; nothing was begun
├── MachineFails            the environment failed at several queries in a row, or its fallback did; the sampler stops
├── LimitsLeft              more rollouts left a limit than is allowed; the sampler stops
├── EvaluationFailed        the environment or the policy failed after real steps had been taken
└── StepFailed              the environment did not give a step; the query fails, the sampler continues
    ├── StepTimedOut        the step took too long, and the environment was killed; the next step starts it anew
    ├── EnvironmentDied     the environment's process ended; the next step starts it anew
    ├── StepRefused         the environment refused the step before it moved; the design chooses another query
    ├── FallbackFailed      the fallback of declared limits gave up, so the machine may move; the sampler stops
    └── RequestRefused      the environment's program answered with an error, and keeps running
"""

from __future__ import annotations

import os
import traceback
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from surrogym_shared.limits import KeptEpisodes

MORE_TIME = "a larger --step-limit gives it more time"
# Errors of a user's environment that are caught. KeyboardInterrupt is not: the user pressed Ctrl-C.
RAISED = (Exception, SystemExit)
LONGEST = 2_000  # characters of a foreign exception's message that are reported


class OriginalError(Exception):
    """Base class of all errors of an original environment; its text is one sentence for a person."""


class UnknownEnvironment(OriginalError):
    """The name stands for no original environment that can be made and specified."""


class NotPerturbable(OriginalError):
    """Only environments with a built-in adapter can be perturbed."""


class NotSettable(OriginalError):
    """The environment can't be set to a state: an episode can only begin with a reset."""


class PolicyMisfit(OriginalError, ValueError):
    """A policy was trained for another environment, or gave actions that this environment does not take."""


class QueryRefused(OriginalError):
    """A query lies outside the environment's own specification; nothing was sent to the environment."""


class SnapshotGone(OriginalError):
    """A snapshot was deleted, is damaged, or can't be restored; no real step was taken."""


class SnapshotNotKept(OriginalError):
    """A state could not be saved, or its snapshot could not be written. The real step that led to the state still
    counts."""


class UnusableFolder(OriginalError):
    """The folder for snapshots can't be made or written to."""


class MachineFails(OriginalError):
    """The environment failed at several different queries in a row, or its fallback failed. The claimed queries were
    returned to the queue."""


class LimitsLeft(OriginalError):
    """More rollouts of a sampler left a limit than its specification allows. The claimed queries were returned to the
    queue."""


class EvaluationFailed(OriginalError):
    """An evaluation failed after ``steps`` real steps; ``__cause__`` is the error. ``limits`` counts how the episodes
    so far kept declared limits."""

    def __init__(self, steps: int, cause: BaseException, limits: KeptEpisodes | None = None) -> None:
        super().__init__(f"the evaluation failed after {steps} real steps: {sentence(cause)}")
        self.steps, self.limits = steps, limits
        self._arguments = (steps, cause, limits)

    def __reduce__(self) -> tuple[type[EvaluationFailed], tuple[int, BaseException, KeptEpisodes | None]]:
        return type(self), self._arguments


class StepFailed(OriginalError):
    """The environment raised an error, or returned something that is not a step."""


class StepTimedOut(StepFailed):
    """A step, reset or other request took longer than the environment's time limit."""


class EnvironmentDied(StepFailed):
    """The process of the environment ended during a request."""


class StepRefused(StepFailed):
    """The environment refused a step before anything moved; an environment's method may raise it.

    The query then counts neither as an attempt nor towards the budget, and the design chooses another state and action.

    Examples:
        >>> def step_from(coordinates, action):
        ...     if coordinates[0] + action[0] > 1.0:
        ...         raise StepRefused("the tank would overflow")
    """


class FallbackFailed(StepFailed):
    """The fallback controller of declared limits failed too often in a row, so the machine may still move. The
    environment takes no further steps."""


class RequestRefused(StepFailed):
    """An environment's program answered a request with an error. ``code`` is "unsupported", or another code of the
    program's answer."""

    def __init__(self, message: str, code: str = "failed") -> None:
        super().__init__(message)
        self.code = code


def message_of(error: BaseException) -> str:
    """Return the message of a foreign exception, as text that can be sent and printed, and at most ``LONGEST``
    characters of it. Never raises, even if the exception's own code does."""
    try:
        said = str(error)
    except RAISED as failed:
        return f"its message can't be read, because of {type(failed).__name__}"
    if len(said) > LONGEST:
        said = f"{said[:LONGEST]} ... (of {len(said)} characters)"
    return said.replace("\0", r"\x00").encode(errors="backslashreplace").decode()


def sentence(error: BaseException) -> str:
    """Describe an exception of a user's environment: its type, its message, and the line that raised it."""
    # An error of Surrogym is a complete sentence already; the line that raised it would not help the user.
    if isinstance(error, OriginalError):
        return message_of(error)
    frame = traceback.extract_tb(error.__traceback__)[-1:]
    where = f" ({os.path.basename(frame[0].filename)}:{frame[0].lineno})" if frame else ""
    message = message_of(error)
    return f"{type(error).__name__}{f': {message}' if message else ''}{where}"
