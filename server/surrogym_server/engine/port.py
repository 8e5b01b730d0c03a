"""Two interfaces: ``SessionEngine`` runs sessions, and ``Compute`` computes rounds of designs.

Requests and replies are plain data. The docstrings state laws that each implementation has to keep, and functions in
``tests/support`` test them.
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
    """Interface of an engine, which runs sessions (virtual environments) and keeps their models, locks and counts.

    Laws: a request is carried out once. A repeat with the same sequence number (seq) and body gets the same reply, bit
    for bit, even while the first request still runs. Another seq or body raises ``SeqConflict``, which has the expected
    seq. A refused request uses no seq and changes nothing. The replies of a session depend only on its opening, its
    seed and its requests. Requests, replies and errors pickle.

    Each method with a session's id raises ``UnknownSession`` or ``SessionExpired`` if the session does not exist.
    """

    idle_seconds: float  # a session expires if it gets no request for this many seconds
    lasting: bool = False  # whether sessions continue after this process has ended, and other processes can use them
    # A client should keep this many of its last requests, to send them again if the session goes back to an older saved
    # state.
    replay: int = 0

    @abstractmethod
    async def open(self, request: Open) -> SessionInfo:
        """Open a session. A repeat with the same idempotency key and settings returns the session opened before.

        Raises:
            NoModel, UnknownModel: the surrogate has no model, or none of this version.
            NotInstalled: the package of the model's family is not installed.
            IdempotencyConflict: the same key came with other settings.
            TooLarge: the session would have more lanes, particles or memory than the limit.
            Overloaded: all sessions together have reached a limit.
        """

    @abstractmethod
    async def advance(self, request: Advance) -> Reply:
        """Carry out a reset, step or rollout of a session.

        Raises:
            SeqConflict: the sequence number is neither the next one nor that of the last request.
            InvalidInput: the action has the wrong shape, is not finite, or is out of bounds.
            NotReset: a lane to step has not been reset.
            TooLarge: the rollout has too many steps.
            DeadlineExceeded: the request would take longer than the caller waits, so it was not begun.
            Overloaded: too many requests are running or waiting.
            PluginFailed, NotInstalled: code of the model's family raised an error, or is not installed.
        """

    def try_now(self, request: Advance) -> Reply | None:
        """Carry out a reset, step or rollout at once if that needs no waiting; otherwise do nothing and return None.

        Raises the errors of ``advance``.
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
        """Return the states that a session visited, with the model's confidence index over them.

        Raises:
            InvalidInput: the session was opened without the option ``occupancy``, which records visited states.
            NotReset: the session has visited no state yet.
        """

    @abstractmethod
    async def close(self, session: str) -> None:
        """End a session. Does nothing if the session does not exist."""

    @abstractmethod
    async def forget(self, surrogate: int) -> None:
        """End all sessions of a deleted surrogate (``surrogate`` is its id), and remove the surrogate's models from
        memory."""

    @abstractmethod
    async def activity(self, surrogate: str) -> list[SessionActivity]:
        """Return the steps, returns and idle time of each open session of a surrogate, oldest first."""

    @abstractmethod
    def counts(self) -> Counts:
        """Return counts of sessions, lanes, requests and steps over all sessions. Thread-safe."""

    @abstractmethod
    async def sweep(self) -> None:
        """Expire idle sessions, look for models stored by other processes, and end sessions of deleted surrogates."""

    @abstractmethod
    async def start(self) -> None:
        """Prepare the engine. The server calls this once, before the first request."""

    @abstractmethod
    async def stop(self) -> None:
        """Stop the engine: it refuses new requests, completes short ones, and ends long ones with ``Unavailable``."""

    @abstractmethod
    async def save(self) -> list[Saved]:
        """Return all sessions in a form that can be stored and restored. Usually called after ``stop``."""

    @abstractmethod
    async def restore(self, request: Restore) -> None:
        """Restore a saved session. Its next reply is the same, bit for bit, as if it had not been saved.

        Raises:
            InvalidInput: the session was saved by another version of this program.
            UnknownSession: the session's surrogate was deleted, and another surrogate now has the same name.
            Damaged: the saved bytes have changed.
            TooLarge, Overloaded: the session exceeds a limit of the engine.
        """


class Compute(ABC):
    """Interface of an object that computes rounds of designs (a fit and the next queries), in other processes.

    Laws: a result equals that of ``run_design_job``, bit for bit. Jobs run at the same time without waiting for each
    other. An error of a job affects no other job, and its exception has the error's text. A job can be cancelled at any
    time, which affects no other job.
    """

    @abstractmethod
    def start(self) -> None:
        """Prepare for the first job, for example by starting a process for it."""

    @abstractmethod
    async def run(self, job: DesignJob) -> DesignResult:
        """Run a job, and return its result.

        Raises:
            Unavailable: the process or machine of the job died, and the job can't run again now.
            PluginFailed: the job raised an error. The notes of the exception have the traceback if it was unexpected.
            ChoiceFailed: the acquisition could not choose the next queries.
        """

    @abstractmethod
    def close(self) -> None:
        """End all running jobs. This may block, so call it in a thread."""
