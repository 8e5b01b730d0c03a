"""SessionEngine: where live sessions are. Compute: where rounds of designs are computed.

Requests and replies are data; an engine owns everything between them.

The laws that stand in the docstrings are functions of ``surrogym_server.testing``.
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
    """Sessions by id. The engine owns their models, locks, deadlines, visited states and tallies.

    Laws: a request is carried out once. The same seq with the same body gets the same reply, bit for bit, also while
    the first is being carried out; another seq, or another body, is a ``SeqConflict`` that names the expected seq. A
    request that is refused takes no seq and changes nothing. Replies of a session depend on how it was opened, on its
    seed and on its requests alone. Requests, replies and errors pickle.

    Every method that names a session raises ``UnknownSession`` or ``SessionExpired`` where there is none.
    """

    idle_seconds: float  # a session that is not used for so long expires
    lasting: bool = False  # whether sessions live on when this process ends, and other processes find them

    @abstractmethod
    async def open(self, request: Open) -> SessionInfo:
        """Open a session; the same idempotency key and opening again give the session that they opened.

        Raises:
            NoModel, UnknownModel, NotInstalled, IdempotencyConflict, Overloaded: as the classes say.
            TooLarge: more lanes, particles or memory than the limit.
        """

    @abstractmethod
    async def advance(self, request: Advance) -> Reply:
        """Reset, step or roll out.

        Raises:
            SeqConflict: neither the next seq nor a repeat.
            InvalidInput: wrong shape, not finite, out of bounds.
            NotReset: a lane to step has not been reset.
            TooLarge: a rollout of too many steps.
            DeadlineExceeded: it would take longer than the caller waits, and was not begun.
            Overloaded: too many requests are at work or waiting.
            PluginFailed, NotInstalled: of the model's family.
        """

    def try_now(self, request: Advance) -> Reply | None:
        """The reply where it needs no waiting, not even for the event loop; else None, and nothing was done.

        Raises as ``advance``.
        """
        del request
        return None

    @abstractmethod
    async def describe(self, session: str) -> SessionInfo:
        """A session as it is now."""

    @abstractmethod
    async def coordinates(self, session: str) -> Array:
        """The coordinates of its lanes, (N, C)."""

    @abstractmethod
    async def submit(self, session: str) -> Visited:
        """The states that a session visited, judged by its model.

        Raises:
            InvalidInput: it was opened without occupancy.
            NotReset: nothing was visited yet.
        """

    @abstractmethod
    async def close(self, session: str) -> None:
        """End a session; harmless where there is none."""

    @abstractmethod
    async def forget(self, surrogate: int) -> None:
        """End all sessions of a surrogate that was deleted, and drop its models."""

    @abstractmethod
    async def activity(self, surrogate: str) -> list[SessionActivity]:
        """What the open sessions of a surrogate are doing, oldest first."""

    @abstractmethod
    def counts(self) -> Counts:
        """What all sessions are doing together. Any thread may call."""

    @abstractmethod
    async def sweep(self) -> None:
        """Expire idle sessions, see which models were stored elsewhere, and end sessions of deleted surrogates."""

    @abstractmethod
    async def start(self) -> None:
        """Get ready: called once, before the first request."""

    @abstractmethod
    async def stop(self) -> None:
        """Carry out nothing more. What is being carried out ends, as ``Unavailable`` where it is long."""

    @abstractmethod
    async def save(self) -> list[Saved]:
        """All sessions as bytes; usually after ``stop``."""

    @abstractmethod
    async def restore(self, request: Restore) -> None:
        """Take a saved session back; its next reply is the same, bit for bit, as without the pause.

        Raises:
            InvalidInput: saved by another version of this program.
            UnknownSession: its surrogate was deleted, and another one has its name.
            Damaged: these are not the bytes that were saved.
            TooLarge, Overloaded: it does not fit in.
        """


class Compute(ABC):
    """Where rounds of designs are computed, apart from sessions.

    Laws: a result is that of ``run_design_job``, bit for bit. Jobs that are run at the same time do not wait for each
    other. Whatever a job raises comes back as words, and ends nothing else. Cancelling ends the job, whatever it is
    doing, and no other one.
    """

    @abstractmethod
    def start(self) -> None:
        """Get ready before the first job comes."""

    @abstractmethod
    async def run(self, job: DesignJob) -> DesignResult:
        """Do a job.

        Raises:
            Unavailable: it was lost and can't be done now: a process or machine that died.
            PluginFailed: the job raised, whatever it was; notes have the traceback of what nobody raised on purpose.
            ChoiceFailed: the job did.
        """

    @abstractmethod
    def close(self) -> None:
        """End all jobs; harmless when they have ended. In a thread."""
