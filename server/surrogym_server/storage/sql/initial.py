"""The initial queries of a design, queued in transactions that block nobody for long.

A row of ``requests`` holds how many are queued as long as some are missing. Until then no fit is due. If a crash
interrupts it, another call of ``ask`` with the same queries continues.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from surrogym_server.storage.sql.database import BATCH, Database
from surrogym_server.storage.sql.rows import NAMED, hold, insert_queries, remember
from surrogym_server.storage.sql.tables import requests, surrogates
from surrogym_shared.nouns import Query

OPERATION, KEY = "initial", ""  # no request of a client has an empty key
_OF_DESIGN = (requests.c.operation == OPERATION) & (requests.c.key == KEY)
IS_INCOMPLETE = sa.exists(  # condition on a surrogate's row: initial queries are missing
    sa.select(requests.c.key).where(requests.c.surrogate_id == surrogates.c.id, _OF_DESIGN)
)


def begin(connection: Connection, surrogate: Row[Any], queries: Sequence[Query]) -> None:
    """Queue as many initial queries as one transaction may, and note in the table whether others are missing."""
    remember(connection, surrogate, OPERATION, KEY, "", 0)
    _ask_some(connection, surrogate, queries)


def end(connection: Connection, surrogate: Row[Any]) -> None:
    """Note that no initial query is missing any more: those in the queue are all."""
    connection.execute(sa.delete(requests).where(requests.c.surrogate_id == surrogate.id, _OF_DESIGN))


def ask(database: Database, name: str, queries: Sequence[Query]) -> None:
    """Queue the initial queries that are missing. If none are, nothing changes. Raises ``UnknownSurrogate``."""

    def batch(connection: Connection) -> int:
        return _ask_some(connection, hold(connection, name), queries)

    with database.read() as connection:
        missing = connection.execute(sa.select(surrogates.c.id).where(NAMED, IS_INCOMPLETE), {"named": name}).first()
    if missing:
        database.write_in_batches(batch)


def _ask_some(connection: Connection, surrogate: Row[Any], queries: Sequence[Query]) -> int:
    """Queue a batch of the missing initial queries. Returns how many; 0 if none were missing."""
    own = (requests.c.surrogate_id == surrogate.id) & _OF_DESIGN
    queued = connection.execute(sa.select(requests.c.result).where(own)).scalar()
    if queued is None:
        return 0
    first, last = int(queued), int(queued) + BATCH
    ids = insert_queries(connection, surrogate, queries[first:last], "initial", 0)
    if last >= len(queries):
        end(connection, surrogate)
    else:
        connection.execute(sa.update(requests).where(own).values(result=last))
    return len(ids)
