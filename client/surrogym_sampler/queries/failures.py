"""Reasons for a sampler to stop by itself: a machine that fails at every query, so that it does not use up the attempts
of each, and limits that do not hold."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from surrogym_sampler.original.errors import LimitsLeft, MachineFails
from surrogym_shared.limits import limits_of, must_stop, room
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import NewSample

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
        self._gave_up = ""  # why the machine has to be stopped by hand; empty if it has not

    def gave_up(self, error: str) -> None:
        """Note that the fallback of the declared limits failed, so that no other query may begin."""
        self._gave_up = error

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
                all queries that there are; or it has to be stopped by hand.
        """
        if self._gave_up:
            raise MachineFails(
                f"{self._gave_up}; no other query was begun: stop the machine, repair it, and start the sampler again"
            )
        failed = len(self._queries)
        only_these = failed > 1 and self._queries.issuperset(waiting)
        if failed >= MANY or (not self._answered and (failed >= FIRST_FEW or only_these)):
            raise MachineFails(
                f"the original environment failed at {failed} different queries in a row, so the fault may be its "
                f"own, and no other query was begun; the last error was: {self._last}; repair it, and start the "
                "sampler again"
            )


class Violations:
    """The rollouts of one sampler that left a limit of the environment's own specification.

    A sampler stops if there are more of these rollouts than twice the allowed probability of leaving a limit explains.
    """

    def __init__(self, spec: EnvironmentSpec) -> None:
        self._spec = spec
        self._rollouts = self._left = 0
        # (L,) number of rollouts that left each of the L limits
        self._limits = np.zeros(0 if spec.limits is None else len(spec.limits.keep), dtype=int)
        self._too_many = False

    def rollout(self, steps: Sequence[NewSample]) -> None:
        """Note the real steps of a rollout."""
        if self._spec.limits is None or not steps:
            return
        reached = np.array([step.next_coordinates for step in steps])
        left = (room(self._spec, reached) < 0).any(axis=0)
        self._rollouts += 1
        self._left += bool(left.any())
        self._limits += left
        self._too_many = must_stop(self._left, self._rollouts, self._spec.limits.probability)

    def check(self) -> None:
        """Raise ``LimitsLeft`` if too many rollouts left a limit, before further queries begin."""
        if not self._too_many:
            return
        limits = limits_of(self._spec)
        each = ", ".join(f"{limit.name}: {n}" for limit, n in zip(limits.keep, self._limits, strict=True) if n)
        raise LimitsLeft(
            f"{self._left} of {self._rollouts} rollouts of this sampler left a limit ({each}), which is clearly more "
            f"than the allowed {100 * limits.probability:g} %, so no other query was begun: choose a larger margin, "
            "a smaller range of actions, or a fallback that keeps the limits, and register "
            "the environment under another name"
        )
