"""Storage of the steps of streams, in one table."""

from __future__ import annotations

from collections.abc import Sequence

import sqlalchemy as sa

from surrogym_server.errors import IdempotencyConflict, InvalidInput
from surrogym_server.storage.records import JSON
from surrogym_server.storage.sql.database import Database
from surrogym_server.storage.sql.rows import find, hold
from surrogym_server.storage.sql.tables import Json, checked, metadata, owner, row_id

KEPT = 100_000  # largest number of steps of a surrogate that are kept, the newest

streamed_steps = checked(
    sa.Table(
        "streamed_steps",
        metadata,
        row_id(),
        owner(),
        sa.Column("stream", sa.Text, nullable=False),
        sa.Column("number", sa.BigInteger, nullable=False),  # number of the step in its stream, from 0
        sa.Column("created_at", sa.Double, nullable=False),
        sa.Column("step", Json("streamed_steps.step"), nullable=False),
        sa.UniqueConstraint("surrogate_id", "stream", "number"),
        sa.Index(None, "surrogate_id", "id"),
        sqlite_autoincrement=True,
    )
)


class Streams:
    """Storage of the steps of streams. An operation on a surrogate that does not exist raises ``UnknownSurrogate``."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def add(self, name: str, stream: str, first: int, steps: Sequence[JSON]) -> tuple[int, int]:
        """Append steps to a stream, all or none. Return the number of steps that were not stored before, and the number
        with which the stream has to continue. Beyond ``KEPT`` steps of the surrogate, the oldest are removed.

        Args:
            name: name of the surrogate.
            stream: name of the stream.
            first: number of the first of the steps in the stream.
            steps: the steps.

        Raises:
            InvalidInput: the stream lacks steps before the first one.
            IdempotencyConflict: another step is stored under the same number, or was and is not kept any more.
        """
        table = streamed_steps
        with self._database.write() as connection:
            held = hold(connection, name)
            own = (table.c.surrogate_id == held.id) & (table.c.stream == stream)
            last = connection.execute(sa.select(sa.func.max(table.c.number)).where(own)).scalar()
            following = 0 if last is None else last + 1
            if first > following:
                raise InvalidInput(
                    f"first: expected step {following} of the stream {stream!r} next, got step {first}: post the steps "
                    "between them first, or begin another stream with step 0 if they are lost"
                )
            again = steps[: following - first]
            stored = sa.select(table.c.number, table.c.step).where(own, table.c.number >= first)
            known = {
                row.number: row.step for row in connection.execute(stored.where(table.c.number < first + len(again)))
            }
            for number, step in enumerate(again, start=first):
                if known.get(number) != step:
                    how = "with other values than before" if number in known else "that is not kept any more"
                    raise IdempotencyConflict(
                        f"first: expected step {following} of the stream {stream!r} next, got step {number} {how}: "
                        "begin another stream after a restart"
                    )
            place = {"surrogate_id": held.id, "stream": stream, "created_at": held.now}
            new = list(enumerate(steps[len(again) :], start=following))
            if new:
                connection.execute(sa.insert(table), [{**place, "number": at, "step": step} for at, step in new])
                rows = sa.select(table.c.id).where(table.c.surrogate_id == held.id).order_by(table.c.id.desc())
                if (oldest := connection.execute(rows.offset(KEPT).limit(1)).scalar()) is not None:
                    connection.execute(sa.delete(table).where(table.c.surrogate_id == held.id, table.c.id <= oldest))
            return len(new), following + len(new)

    def page(self, name: str, after: int, since: float, limit: int) -> list[JSON]:
        """Return up to ``limit`` steps with an id above ``after`` that were stored later than ``since`` (s since 1970),
        in order."""
        table = streamed_steps
        with self._database.read() as connection:
            own = (table.c.surrogate_id == find(connection, name)) & (table.c.id > after)
            rows = connection.execute(
                sa.select(table).where(own, table.c.created_at > since).order_by(table.c.id).limit(limit)
            )
            return [{**row.step, "id": row.id, "stream": row.stream, "number": row.number} for row in rows]
