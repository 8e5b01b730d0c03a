"""Numbers of samples by purpose, kept in memory, because counting a million rows takes 0.3 s."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from surrogym_server.storage.sql.damage import damaged
from surrogym_server.storage.sql.tables import samples

COUNTED = ("initial", "adaptive", "manual", "audit", "logged", "evaluation", "failed", "expired")
MOST_KEPT = 100_000  # surrogates whose counts are kept

PURPOSE = sa.type_coerce(samples.c.purpose, sa.Text)  # the column's own type would refuse unknown words
BY_PURPOSE: sa.Select[Any] = sa.select(
    samples.c.surrogate_id, PURPOSE, sa.func.count(), sa.func.max(samples.c.id)
).group_by(samples.c.surrogate_id, samples.c.purpose)
AT_ONCE = 500  # surrogates of one statement; SQLite parses an expression of at most 1,000 levels
SINCE = BY_PURPOSE.where(samples.c.surrogate_id == sa.bindparam("owner"), samples.c.id > sa.bindparam("newest"))


@dataclass(frozen=True)
class SampleCounts:
    """Number of a surrogate's samples by purpose, up to the one with the id ``newest``."""

    newest: int = 0
    by_purpose: Mapping[str, int] = field(default_factory=dict)


NONE = SampleCounts()


class CountedSamples:
    """Numbers of samples of each surrogate. Only samples since the last look are counted.

    Samples of a surrogate are added one transaction after the other, so their ids grow. They are never changed, and go
    only with their surrogate. Other processes may add samples too.
    """

    def __init__(self) -> None:
        self._known: dict[int, SampleCounts] = {}

    def of(self, connection: Connection, surrogate_id: int) -> SampleCounts:
        earlier = self._known.get(surrogate_id, NONE)
        since = connection.execute(SINCE, {"owner": surrogate_id, "newest": earlier.newest})
        return self._add(surrogate_id, earlier, since)

    def of_many(self, connection: Connection, newest: Mapping[int, int | None]) -> dict[int, SampleCounts]:
        """Count the samples of surrogates by a few statements, given the id of the newest sample of each."""
        earlier = {id: self._known.get(id, NONE) for id in newest}
        stale = [id for id, last in newest.items() if earlier[id].newest < (last or 0)]
        for first in range(0, len(stale), AT_ONCE):
            some = {id: earlier[id] for id in stale[first : first + AT_ONCE]}
            earlier |= self._count(connection, some)
        return earlier

    def _count(self, connection: Connection, earlier: Mapping[int, SampleCounts]) -> dict[int, SampleCounts]:
        since = [_is_since(id, counts) for id, counts in earlier.items() if counts.newest]
        new = samples.c.surrogate_id.in_([id for id, counts in earlier.items() if not counts.newest])
        rows: defaultdict[int, list[Sequence[Any]]] = defaultdict(list)
        for row in connection.execute(BY_PURPOSE.where(sa.or_(new, *since))):
            rows[row[0]].append(row)
        return {id: self._add(id, counts, rows[id]) for id, counts in earlier.items()}

    def _add(self, surrogate_id: int, earlier: SampleCounts, since: Iterable[Sequence[Any]]) -> SampleCounts:
        newest, by_purpose = earlier.newest, dict(earlier.by_purpose)
        for _, purpose, count, last in since:
            if purpose not in COUNTED:
                raise damaged(f"expected one of {list(COUNTED)} in samples.purpose, got {purpose!r}")
            by_purpose[purpose] = by_purpose.get(purpose, 0) + int(count)
            newest = max(newest, int(last))
        if len(self._known) > MOST_KEPT:
            self._known = {}
        counts = self._known[surrogate_id] = SampleCounts(newest, by_purpose)
        return counts


def _is_since(surrogate_id: int, counts: SampleCounts) -> sa.ColumnElement[bool]:
    return (samples.c.surrogate_id == surrogate_id) & (samples.c.id > counts.newest)
