"""Implementations of ``Occupancy``, ``Sessions`` and ``Events``: visited states, saved sessions and events."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import sqlalchemy as sa

from surrogym_server.errors import TooLarge
from surrogym_server.storage import port
from surrogym_server.storage.records import Array, EventRecord, OccupancyRecord, SavedSession
from surrogym_server.storage.sql.database import BATCH, Database, conflict_insert
from surrogym_server.storage.sql.rows import find, hold
from surrogym_server.storage.sql.tables import events, occupancies, surrogates
from surrogym_server.storage.sql.tables import sessions as saved

MAX_CHECKPOINTS = 1_000  # largest number of occupancies (named sets of visited states) stored for a surrogate
NEWEST = sa.select(
    surrogates.c.name,
    sa.select(sa.func.max(events.c.id)).where(events.c.surrogate_id == surrogates.c.id).scalar_subquery(),
).where(surrogates.c.name.in_(sa.bindparam("names", expanding=True)))


class SqlOccupancy(port.Occupancy):
    def __init__(self, database: Database) -> None:
        self._database = database

    def put(self, name: str, checkpoint: str, states: Array) -> None:
        with self._database.write() as connection:
            surrogate = hold(connection, name)
            own = (occupancies.c.surrogate_id == surrogate.id, occupancies.c.checkpoint == checkpoint)
            connection.execute(sa.delete(occupancies).where(*own))
            others = sa.select(sa.func.count()).where(occupancies.c.surrogate_id == surrogate.id)
            if connection.execute(others).scalar_one() >= MAX_CHECKPOINTS:
                raise TooLarge(
                    f"expected at most {MAX_CHECKPOINTS} names for visited states (checkpoints) of {name!r}, got "
                    "one more: submit the states under one of the earlier names"
                )
            connection.execute(
                sa.insert(occupancies).values(
                    surrogate_id=surrogate.id,
                    checkpoint=checkpoint,
                    round=surrogate.round,
                    created_at=surrogate.now,
                    columns=states.shape[1],
                    states=states.ravel(),
                )
            )

    def get(self, name: str, checkpoint: str) -> OccupancyRecord | None:
        return self._newest(name, occupancies.c.checkpoint == checkpoint)

    def latest(self, name: str) -> OccupancyRecord | None:
        return self._newest(name, sa.true())

    def _newest(self, name: str, condition: sa.ColumnElement[bool]) -> OccupancyRecord | None:
        with self._database.read() as connection:
            own = occupancies.c.surrogate_id == find(connection, name)
            newest = sa.select(occupancies).where(own, condition).order_by(occupancies.c.id.desc()).limit(1)
            row = connection.execute(newest).one_or_none()
        if row is None:
            return None
        states = np.array(row.states).reshape(-1, row.columns)
        return OccupancyRecord(row.checkpoint, row.round, row.created_at, states)


class SqlSessions(port.Sessions):
    def __init__(self, database: Database) -> None:
        self._database = database

    def save(self, sessions: Sequence[SavedSession]) -> None:
        rows = [{"id": one.id, "surrogate": one.surrogate, "data": one.data} for one in sessions]
        if not rows:
            return
        with self._database.write() as connection:
            insert = conflict_insert(connection, saved)
            values = {"surrogate": insert.excluded.surrogate, "data": insert.excluded.data}
            connection.execute(insert.on_conflict_do_update(index_elements=["id"], set_=values), rows)

    def take(self) -> list[SavedSession]:
        with self._database.write() as connection:
            rows = connection.execute(sa.delete(saved).returning(*saved.c)).all()
        return [SavedSession(row.id, row.surrogate, bytes(row.data)) for row in rows]


class SqlEvents(port.Events):
    def __init__(self, database: Database) -> None:
        self._database = database
        self._pruned = 0  # id of the newest event of all surrogates at the last call of ``prune``

    def newest(self, names: Sequence[str]) -> dict[str, int]:
        with self._database.read() as connection:
            return {name: id or 0 for name, id in connection.execute(NEWEST, {"names": [*names]})}

    def list(self, name: str, after: int = 0, limit: int = 1_000) -> list[EventRecord]:
        with self._database.read() as connection:
            own = events.c.surrogate_id == find(connection, name)
            rows = connection.execute(
                sa.select(events.c.id, events.c.kind, events.c.created_at, events.c.body)
                .where(own, events.c.id > after)
                .order_by(events.c.id)
                .limit(limit)
            )
            return [EventRecord(**row._mapping) for row in rows]

    def prune(self, keep: int) -> int:
        with self._database.read() as connection:
            newest = connection.execute(sa.select(sa.func.max(events.c.id))).scalar() or 0
            changed = sa.select(events.c.surrogate_id).where(events.c.id > self._pruned).distinct()
            owners = [*connection.execute(changed).scalars()]
        removed = sum(self._prune(owner, keep) for owner in owners)
        self._pruned = newest
        return removed

    def _prune(self, owner: int, keep: int) -> int:
        own = events.c.surrogate_id == owner
        with self._database.read() as connection:
            beyond = sa.select(events.c.id).where(own).order_by(events.c.id.desc()).offset(keep).limit(1)
            last = connection.execute(beyond).scalar()
        if last is None:
            return 0
        oldest = sa.select(events.c.id).where(own, events.c.id <= last).order_by(events.c.id).limit(BATCH)
        remove = sa.delete(events).where(events.c.id.in_(oldest))
        return self._database.write_in_batches(lambda connection: connection.execute(remove).rowcount)
