"""When failures are the machine's and not the queries': one fault of it must not use up the attempts of every query."""

from __future__ import annotations

from collections.abc import Iterable

from surrogym_client.original.errors import MachineFails

FIRST_FEW = 4  # different queries, of which a machine that never answered has answered none
MANY = 8  # different queries in a row, of a machine that has answered others before
FIRST_DELAY, LONGEST_DELAY = 1.0, 30.0  # seconds


class Failures:
    """The failures of one worker since its last answer.

    A query that lies where the machine can't go fails again and again, and others are answered meanwhile. A machine
    that is broken fails at all of them.
    """

    def __init__(self) -> None:
        self._queries: set[int] = set()  # ids
        self._later = 0  # failures since the FIRST_FEW-th different query failed; each lengthens the delay
        self._answered = False  # anything, ever
        self._last = ""

    def answered(self) -> None:
        self._queries, self._later, self._answered = set(), 0, True

    def failed(self, query_id: int, error: str) -> None:
        self._queries.add(query_id)
        self._last = error
        self._later += len(self._queries) >= FIRST_FEW

    def delay(self) -> float:
        """Seconds to wait before the next query, so that a short fault of the machine has time to pass."""
        return min(FIRST_DELAY * 2 ** (self._later - 1), LONGEST_DELAY) if self._later else 0.0

    def check(self, waiting: Iterable[int]) -> None:
        """Call before queries of these ids are begun.

        Raises:
            MachineFails: it failed at too many different queries, or never answered and failed at all there are.
        """
        failed = len(self._queries)
        only_these = failed > 1 and self._queries.issuperset(waiting)
        if failed >= MANY or (not self._answered and (failed >= FIRST_FEW or only_these)):
            raise MachineFails(
                f"the original environment failed at {failed} different queries in a row, so that the fault may be its "
                f"own, and no other query was begun; it said: {self._last}; mend it, and start the sampler again"
            )
