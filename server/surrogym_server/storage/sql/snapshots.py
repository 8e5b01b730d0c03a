"""Adapter of ``Snapshots``: the snapshots that samplers keep."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from surrogym_server.storage import port
from surrogym_server.storage.records import QueryRecord
from surrogym_server.storage.sql import leases as leasing
from surrogym_server.storage.sql.database import Database, conflict_insert
from surrogym_server.storage.sql.rows import append_event, find, hold, touch
from surrogym_server.storage.sql.tables import queries, snapshots, surrogates
from surrogym_shared.nouns import Vector

GONE = "its snapshot is gone"


class SqlSnapshots(port.Snapshots):
    def __init__(self, database: Database) -> None:
        self._database = database

    def all(self, name: str) -> dict[str, Vector]:
        with self._database.read() as connection:
            own = snapshots.c.surrogate_id == find(connection, name)
            statement = sa.select(snapshots.c.name, snapshots.c.coordinates).where(own).order_by(snapshots.c.id)
            return {row.name: row.coordinates for row in connection.execute(statement)}

    def drop(self, name: str, snapshots: Sequence[str]) -> int:
        with self._database.write() as connection:
            surrogate = hold(connection, name)
            gone = _forget(connection, surrogate, snapshots)
            _give_up_queries(connection, surrogate, snapshots)
            return gone


def insert_snapshots(connection: Connection, surrogate: Row[Any], new: dict[str, Vector]) -> None:
    """Store snapshots by name with their coordinates (C,). A name that is stored already does not change."""
    if new:
        rows = [{"surrogate_id": surrogate.id, "name": name, "coordinates": at} for name, at in new.items()]
        insert = conflict_insert(connection, snapshots).on_conflict_do_nothing()
        connection.execute(insert, rows)


def give_up_lost(connection: Connection, surrogate: Row[Any], given_back: QueryRecord) -> None:
    """Give up a query that was leased while its snapshot was reported as gone. Otherwise samplers would claim it again
    and again."""
    if given_back.snapshot is None or given_back.status != "pending":
        return
    own = (snapshots.c.surrogate_id == surrogate.id) & (snapshots.c.name == given_back.snapshot)
    if not connection.execute(sa.select(sa.exists().where(own))).scalar():
        _give_up_queries(connection, surrogate, [given_back.snapshot])


def _forget(connection: Connection, surrogate: Row[Any], names: Sequence[str]) -> int:
    own = (snapshots.c.surrogate_id == surrogate.id) & snapshots.c.name.in_(names)
    return len(connection.execute(sa.delete(snapshots).where(own).returning(snapshots.c.id)).all())


def _give_up_queries(connection: Connection, surrogate: Row[Any], names: Sequence[str]) -> None:
    """Remove the pending queries that begin at dropped snapshots; set aside those of which steps may have been taken.

    Steps of removed queries that ``improve`` had requested are requested again.
    """
    from_there = queries.c.snapshot.in_(names)
    unbegun = leasing.is_unbegun(surrogate.id) & from_there
    removed = connection.execute(sa.delete(queries).where(unbegun).returning(queries.c.steps, queries.c.extra)).all()
    waiting = (queries.c.surrogate_id == surrogate.id) & (queries.c.status == "pending") & from_there
    aside = sa.update(queries).where(waiting).values(status="set_aside", error=GONE).returning(queries.c.id)
    begun = sorted(connection.execute(aside).scalars())
    if removed:
        append_event(connection, surrogate, "queries", withdrawn=len(removed), round=surrogate.round)
    for query_id in begun:
        append_event(connection, surrogate, "set_aside", query_id=query_id, error=GONE)
    if removed or begun:
        again = sum(row.steps for row in removed if row.extra)
        touch(connection, surrogate, extra_queries=surrogates.c.extra_queries + again)
