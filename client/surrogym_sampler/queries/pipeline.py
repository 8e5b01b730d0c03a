"""What a sampler asks of the server while the environment steps: it sends the answer before, and claims the queries
after."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from contextlib import suppress
from typing import Generic, TypeVar

from surrogym_client.errors import SurrogymClientError
from surrogym_shared.wire import ClaimedQueries

HELD_SECONDS = 1.0  # longest wait of a query that was claimed ahead for the end of the running step
LEAD = 3.0  # a claim ahead begins this many durations of the last answer before the expected end of the step

S = TypeVar("S")
T = TypeVar("T")


def beside(call: Callable[[], T]) -> Future[T]:
    """Call in a thread of its own, which does not keep the process alive."""
    future: Future[T] = Future()

    def run() -> None:
        try:
            future.set_result(call())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, name="beside the step", daemon=True).start()
    return future


class ClaimAhead:
    """Claims queries shortly before the running step ends, so that the next step need not wait for them.

    Other samplers may wait for these queries. If the step takes longer than expected, they go back to the queue.

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
        """Return the claimed queries, once the step is over. None: there are none, or it is too early or too late."""
        self._over.set()
        return self._future.result()

    def _run(self) -> ClaimedQueries | None:
        if self._over.wait(self._after):
            return None
        with suppress(SurrogymClientError):  # of a claim, which is repeated after the step; or the leases end
            claimed = self._claim()
            if claimed.queries and self._over.wait(HELD_SECONDS):
                return claimed
            self._give_back(claimed)
        return None


class Pipeline(Generic[T]):
    """At most one answer under way and one claim ahead, beside the running step of a sampler.

    It flows from an accepted answer until the next one that is not accepted. Otherwise each request waits for the one
    before it, so that no further step begins after a fault of the machine or of an answer.

    Args:
        settle: is called with the result of each answer, in order, by the thread that owns the pipeline. Returns
            whether the answer was accepted.
        give_back: as of ``ClaimAhead``.
    """

    def __init__(self, settle: Callable[[T], bool], give_back: Callable[[ClaimedQueries], None]) -> None:
        self._settle, self._give_back = settle, give_back
        self._flows = False
        self._answer: Future[T] | None = None
        self._ahead: ClaimAhead | None = None
        self._held: ClaimedQueries | None = None
        self._step_seconds = self._answer_seconds = 0.0  # of the last one

    @property
    def under_way(self) -> int:
        """Number of answers that are not acknowledged yet."""
        return int(self._answer is not None)

    def step(self, step: Callable[[], S], claim: Callable[[], ClaimedQueries] | None) -> S:
        """Take the real steps of a query. If the pipeline flows, ``claim`` is called shortly before their end."""
        if claim is not None and self._flows:
            after = max(0.0, self._step_seconds - LEAD * self._answer_seconds)
            self._ahead = ClaimAhead(claim, self._give_back, after)
        begun = time.monotonic()
        taken = step()
        self._step_seconds = time.monotonic() - begun
        return taken

    def send(self, answer: Callable[[], T], *, clean: bool, last: bool) -> None:
        """Send an answer. It is acknowledged when this returns, unless the pipeline flows and holds another query.

        Args:
            answer: sends it.
            clean: the server is likely to accept it.
            last: of the queries that were claimed before. One that was claimed ahead may follow.
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
        """Return the queries that were claimed ahead. The caller holds them from now on."""
        held, self._held = self._held, None
        return held

    def settle(self) -> None:
        """Wait until the answer under way is acknowledged. Raises what sending it raised."""
        if self._answer is not None:
            wait([self._answer])  # Ctrl-C ends this wait, and leaves the answer under way
            answer, self._answer = self._answer, None
            self._flows = False
            self._flows = self._settle(answer.result())

    def close(self) -> None:
        """Leave nothing claimed ahead and no answer under way. Raises like ``settle``."""
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
