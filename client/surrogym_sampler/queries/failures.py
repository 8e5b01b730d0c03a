"""Distinction between a broken machine and single failing queries, so that a broken machine does not use up the
attempts of every query."""

from __future__ import annotations

from collections.abc import Iterable

from surrogym_sampler.original.errors import MachineFails

FIRST_FEW = 4  # a machine that has never answered counts as broken after this number of different failed queries
MANY = 8  # a machine that has answered before counts as broken after this number of failed queries in a row
# Wait in seconds after a failure: the first, doubled with each failure, to the longest.
FIRST_DELAY, LONGEST_DELAY = 1.0, 30.0


class Failures:
    """The failures of one sampler since its last answer.

    A query that the machine can't reach fails again and again, while others succeed. A broken machine fails at every
    query.
    """

    def __init__(self) -> None:
        self._queries: set[int] = set()  # ids of the failed queries
        self._later = 0  # number of failures after FIRST_FEW different queries failed; each lengthens the delay
        self._answered = False  # whether any query was answered since the sampler started
        self._last = ""

    def answered(self) -> None:
        self._queries, self._later, self._answered = set(), 0, True

    def failed(self, query_id: int, error: str) -> None:
        self._queries.add(query_id)
        self._last = error
        self._later += len(self._queries) >= FIRST_FEW

    def delay(self) -> float:
        """Return the seconds to wait before the next query, so that a short fault of the machine can pass."""
        return min(FIRST_DELAY * 2 ** (self._later - 1), LONGEST_DELAY) if self._later else 0.0

    def check(self, waiting: Iterable[int]) -> None:
        """Raise an error if the machine seems broken, before further queries begin.

        Args:
            waiting: ids of the queries that could begin.

        Raises:
            MachineFails: the machine failed at too many different queries in a row; or it never answered, and failed at
                all queries that there are.
        """
        failed = len(self._queries)
        only_these = failed > 1 and self._queries.issuperset(waiting)
        if failed >= MANY or (not self._answered and (failed >= FIRST_FEW or only_these)):
            raise MachineFails(
                f"the original environment failed at {failed} different queries in a row, so the fault may be its "
                f"own, and no other query was begun; the last error was: {self._last}; repair it, and start the "
                "sampler again"
            )
