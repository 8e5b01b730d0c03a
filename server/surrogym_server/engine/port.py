"""Two ports: ``SessionEngine`` for live sessions, and ``Compute`` for rounds of designs.

Requests and replies are data; an engine owns everything between them.

The docstrings state laws. Functions in ``surrogym_server.testing`` test an implementation of a port by them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

from surrogym_server.engine.design_job import DesignJob, DesignResult
from surrogym_server.engine.requests import (
    Advance,
    Array,
    Open,
    Reply,
    Restore,
    Saved,
    SessionInfo,
    Visited,
)
from surrogym_server.engine.tallies import Counts, SessionActivity


class SessionEngine(ABC):
    """Live sessions by id. The engine owns their models, locks, deadlines, visited states and tallies.

    Laws: a request is carried out once. The same seq with the same body gets the same reply, bit for bit, even while
    the first is still running. Another seq, or another body, is a ``SeqConflict`` that names the expected seq. A
    refused request uses no seq and changes nothing. Replies of a session depend only on how it was opened, on its seed
    and on its requests. Requests, replies and errors pickle.

    Every method that names a session raises ``UnknownSession`` or ``SessionExpired`` if the session does not exist.
    """

    idle_seconds: float  # a session without requests for this long expires
    lasting: bool = False  # whether sessions outlive this process and are open to other processes
    replay: int = 0  # number of last requests that a client should keep, to repeat them after a checkpoint

    @abstractmethod
    async def open(self, request: Open) -> SessionInfo:
        """Open a session. The same idempotency key with the same opening returns the session that was opened first.

        Raises:
            NoModel, UnknownModel, NotInstalled, IdempotencyConflict, Overloaded: as the classes say.
            TooLarge: more lanes, particles or memory than the limit.
        """

    @abstractmethod
    async def advance(self, request: Advance) -> Reply:
        """Reset, step or roll out.

        Raises:
            SeqConflict: the seq is neither the next one nor a repeat.
            InvalidInput: the action has the wrong shape, is not finite, or is out of bounds.
            NotReset: a lane to step has not been reset.
            TooLarge: a rollout of too many steps.
            DeadlineExceeded: the request would take longer than the caller waits, so it was not begun.
            Overloaded: too many requests are running or waiting.
            PluginFailed, NotInstalled: code of the model's family failed, or is not installed.
        """

    def try_now(self, request: Advance) -> Reply | None:
        """Do ``advance`` at once if that is possible without waiting; otherwise do nothing and return None.

        Raises like ``advance``.
        """
        del request
        return None

    @abstractmethod
    async def describe(self, session: str) -> SessionInfo:
        """Return the present state of a session."""

    @abstractmethod
    async def coordinates(self, session: str) -> Array:
        """Return the coordinates of a session's lanes, (N, C)."""

    @abstractmethod
    async def submit(self, session: str) -> Visited:
        """Return the states that a session visited, with the model's confidence over them.

        Raises:
            InvalidInput: the session was opened without occupancy.
            NotReset: the session has visited no state yet.
        """

    @abstractmethod
    async def close(self, session: str) -> None:
        """End a session. Does nothing if it does not exist."""

    @abstractmethod
    async def forget(self, surrogate: int) -> None:
        """End all sessions of a surrogate that was deleted, and drop its models."""

    @abstractmethod
    async def activity(self, surrogate: str) -> list[SessionActivity]:
        """Return the activity of a surrogate's open sessions, oldest first."""

    @abstractmethod
    def counts(self) -> Counts:
        """Return counts over all sessions. Any thread may call this."""

    @abstractmethod
    async def sweep(self) -> None:
        """Expire idle sessions, look for models stored by other processes, and end sessions of deleted surrogates."""

    @abstractmethod
    async def start(self) -> None:
        """Prepare the engine. Called once, before the first request."""

    @abstractmethod
    async def stop(self) -> None:
        """Refuse further requests. Running ones are completed; long ones end as ``Unavailable``."""

    @abstractmethod
    async def save(self) -> list[Saved]:
        """Return all sessions as bytes. Usually called after ``stop``."""

    @abstractmethod
    async def restore(self, request: Restore) -> None:
        """Restore a saved session. Its next reply is the same, bit for bit, as if it had not been saved.

        Raises:
            InvalidInput: the session was saved by another version of this program.
            UnknownSession: its surrogate was deleted, and another one has its name.
            Damaged: the bytes differ from those that were saved.
            TooLarge, Overloaded: the session exceeds a limit of the engine.
        """


class Compute(ABC):
    """Computation of design rounds, separate from sessions.

    Laws: a result equals that of ``run_design_job``, bit for bit. Jobs that run at the same time do not wait for each
    other. Any error of a job returns as text, and ends nothing else. Cancelling ends the job at any point, and no other
    one.
    """

    @abstractmethod
    def start(self) -> None:
        """Prepare for the first job, for example by starting a process."""

    @abstractmethod
    async def run(self, job: DesignJob) -> DesignResult:
        """Run a job, and return its result.

        Raises:
            Unavailable: the process or machine of the job died, and the job can't run again now.
            PluginFailed: the job raised an error; its notes have the traceback of an unexpected one.
            ChoiceFailed: the job itself raised this.
        """

    @abstractmethod
    def close(self) -> None:
        """End all jobs, if any run. It may block, so callers run it in a thread."""
