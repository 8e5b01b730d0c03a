"""Requests to the server while the environment steps: the previous answer is sent, and the next queries are claimed."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from contextlib import suppress
from typing import Generic, TypeVar

from surrogym_client.errors import SurrogymClientError
from surrogym_shared.wire import ClaimedQueries

HELD_SECONDS = 1.0  # a query claimed ahead is returned if the running step does not end within these seconds
LEAD = 3.0  # the next query is claimed this many durations of an answer before the expected end of the running step

S = TypeVar("S")
T = TypeVar("T")


def beside(call: Callable[[], T]) -> Future[T]:
    """Call a function in a thread of its own, which does not keep the process alive, and return the future of its
    result."""
    future: Future[T] = Future()

    def run() -> None:
        try:
            future.set_result(call())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, name="beside the step", daemon=True).start()
    return future


class ClaimAhead:
    """A claim of queries shortly before the running step ends, so that the next step need not wait for the server.

    If the step takes longer than expected, the claimed queries are returned to the queue: other samplers may wait for
    them.

    Args:
        claim: claims queries, without waiting for any.
        give_back: returns queries that were not begun.
        after: seconds until the claim.
    """

    def __init__(
        self, claim: Callable[[], ClaimedQueries], give_back: Callable[[ClaimedQueries], None], after: float
    ) -> None:
        self._claim, self._give_back, self._after = claim, give_back, after
        self._over = threading.Event()
        self._future = beside(self._run)

    def take(self) -> ClaimedQueries | None:
        """Return the claimed queries, once the running step is over. None if there are none: the step ended before the
        claim began, nothing was claimed, or the step took so long that the queries were returned to the queue."""
        self._over.set()
        return self._future.result()

    def _run(self) -> ClaimedQueries | None:
        if self._over.wait(self._after):
            return None
        # Errors are ignored: a failed claim is repeated after the step, and unreturned queries come back when their
        # leases end.
        with suppress(SurrogymClientError):
            claimed = self._claim()
            if claimed.queries and self._over.wait(HELD_SECONDS):
                return claimed
            self._give_back(claimed)
        return None


class Pipeline(Generic[T]):
    """Sends an answer and claims the next query while a sampler takes real steps: at most one of each at a time.

    These requests run at the same time as a step only as long as the server accepts each answer. After an answer that
    is not accepted, each request waits for the one before it, so that no further step begins after a fault of the
    machine or of an answer.

    Args:
        settle: called with the result of each answer, in order, by the thread that owns the pipeline. Returns whether
            the answer was accepted.
        give_back: returns claimed queries that were not begun.
    """

    def __init__(self, settle: Callable[[T], bool], give_back: Callable[[ClaimedQueries], None]) -> None:
        self._settle, self._give_back = settle, give_back
        self._flows = False
        self._answer: Future[T] | None = None
        self._ahead: ClaimAhead | None = None
        self._held: ClaimedQueries | None = None
        self._step_seconds = self._answer_seconds = 0.0  # durations of the last step and the last answer

    @property
    def under_way(self) -> int:
        """Number of answers that are not acknowledged yet."""
        return int(self._answer is not None)

    def step(self, step: Callable[[], S], claim: Callable[[], ClaimedQueries] | None) -> S:
        """Take the real steps of a query. If the last answer was accepted, ``claim`` is called shortly before the
        expected end of the steps."""
        if claim is not None and self._flows:
            after = max(0.0, self._step_seconds - LEAD * self._answer_seconds)
            self._ahead = ClaimAhead(claim, self._give_back, after)
        begun = time.monotonic()
        taken = step()
        self._step_seconds = time.monotonic() - begun
        return taken

    def send(self, answer: Callable[[], T], *, clean: bool, last: bool) -> None:
        """Send an answer, and wait until the server has acknowledged it. There is no wait if the server has accepted
        the previous answer, is likely to accept this one, and another claimed query can begin: the answer is then sent
        during that query's step.

        Args:
            answer: sends the answer.
            clean: whether the server is likely to accept the answer.
            last: whether this is the answer to the last of the claimed queries. A query that was claimed ahead may
                follow.
        """
        self.settle()
        if not (clean and self._flows):
            self._flows = self._settle(self._timed(answer))
            self.give_back()
            return
        self._answer = beside(lambda: self._timed(answer))
        if last:
            self._held = self._take()
            if self._held is None:
                self.settle()

    def next(self) -> ClaimedQueries | None:
        """Return the queries that were claimed ahead; the caller becomes responsible for them."""
        held, self._held = self._held, None
        return held

    def settle(self) -> None:
        """Wait until the answer that is being sent is acknowledged. If sending it failed, this raises the error."""
        if self._answer is not None:
            wait([self._answer])  # Ctrl-C ends this wait, while the answer continues to be sent
            answer, self._answer = self._answer, None
            self._flows = False
            self._flows = self._settle(answer.result())

    def close(self) -> None:
        """Return queries that were claimed ahead, and wait for the answer that is being sent. If sending it failed,
        this raises the error."""
        try:
            self.give_back()
        finally:
            self.settle()
            self._flows = False

    def give_back(self) -> None:
        """Return the queries that were claimed ahead to the queue."""
        for claim in (self._take(), self.next()):
            if claim is not None:
                self._give_back(claim)

    def _take(self) -> ClaimedQueries | None:
        ahead, self._ahead = self._ahead, None
        return None if ahead is None else ahead.take()

    def _timed(self, answer: Callable[[], T]) -> T:
        begun = time.monotonic()
        result = answer()
        self._answer_seconds = time.monotonic() - begun
        return result
