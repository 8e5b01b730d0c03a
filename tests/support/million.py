"""A PostgreSQL database with many surrogates, samples and sessions: one of each is made through storage, and copied."""

from __future__ import annotations

import sqlalchemy as sa

from support.many import create, finish
from surrogym_server.storage.sql import Storage, open_storage
from surrogym_server.storage.sql.tables import metadata

FIRST, OPEN = "finished", "waiting"  # the surrogates that are made through storage
COPIED = ("surrogates", "queries", "leases", "samples", "models", "events", "evaluations")
APART = 100_000_000  # ids of the rows of one copy and of the next


def fill(url: str, surrogates: int, samples: int, sessions: int, checkpoint_bytes: int) -> None:
    """Make ``surrogates`` with ``samples`` in all, each the answer of a leased query, and 8 queries that wait; and
    ``sessions`` of a cluster."""
    storage = open_storage(url)
    try:
        finish(storage, FIRST)
        create(storage, OPEN)
        _sessions(storage, sessions, checkpoint_bytes)
    finally:
        storage.close()
    engine = sa.create_engine(url.replace("postgresql://", "postgresql+psycopg://"))
    with engine.begin() as connection:
        _multiply(connection, samples // surrogates)
        _copy(connection, surrogates)
        connection.execute(sa.text("UPDATE surrogates SET revision = 0, fitted_revision = 0"))
        for table in COPIED:
            connection.execute(
                sa.text(f"SELECT setval(pg_get_serial_sequence('{table}', 'id'), (SELECT max(id) FROM {table}))")
                if "id" in metadata.tables[table].c
                else sa.text("SELECT 1")
            )
    with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        connection.execute(sa.text("VACUUM ANALYZE"))
    engine.dispose()


def _sessions(storage: Storage, count: int, size: int) -> None:
    if not count:
        return
    from surrogym_server.features.ray.store import (  # late: a server may lack the feature
        Checkpoint,
        LiveSessions,
        NewLiveSession,
    )

    surrogate, live = storage.surrogates.get(FIRST).id, storage.part(LiveSessions)
    for number in range(count):
        new = NewLiveSession(f"session-{number}.{number % 2}", surrogate, "machine", Checkpoint(0, bytes(size)))
        live.add(new, f"{number % 2} host", 1e6)


def _multiply(connection: sa.Connection, wanted: int) -> None:
    """Copy one answered query with its lease and sample until the first surrogate has as many as wanted."""
    joined = "samples JOIN leases ON leases.id = samples.lease_id JOIN queries ON queries.id = samples.query_id"
    sample, lease, query = connection.execute(
        sa.text(f"SELECT samples.id, leases.id, queries.id FROM {joined} ORDER BY samples.id LIMIT 1")
    ).one()
    numbers = f"generate_series(1000, {wanted + 991}) AS numbers (k)"
    for name, row in (("queries", query), ("leases", lease), ("samples", sample)):
        table = metadata.tables[name]
        values = {
            "id": "k",
            "query_id": str(query) if name == "queries" else "k",
            "lease_id": "k",
            "token": "token || '-' || k",
        }
        columns = ", ".join(table.c.keys())
        copied = ", ".join(values.get(column.name, column.name) for column in table.c)
        connection.execute(
            sa.text(f"INSERT INTO {name} ({columns}) SELECT {copied} FROM {name}, {numbers} WHERE id = {row}")
        )


def _copy(connection: sa.Connection, count: int) -> None:
    """Copy both surrogates with everything they own: their own answers, and queries that wait."""
    first, waiting = (
        connection.execute(sa.text(f"SELECT id FROM surrogates WHERE name = '{name}'")).scalar_one()
        for name in (FIRST, OPEN)
    )
    connection.execute(sa.text(f"UPDATE queries SET surrogate_id = {first} WHERE surrogate_id = {waiting}"))
    connection.execute(sa.text(f"DELETE FROM surrogates WHERE id = {waiting}"))
    connection.execute(sa.text("UPDATE surrogates SET phase = 'collecting', paused = false, state = state"))
    for name in COPIED:
        table = metadata.tables[name]

        def copied(column: sa.Column[object], name: str = name) -> str:
            if column.name == "surrogate_id" or (name == "surrogates" and column.name == "id"):
                return f"{column.name} + 1000 * k"
            if column.name in ("id", "query_id", "lease_id"):
                return f"{column.name} + {APART} * k"
            return f"{column.name} || '-' || k" if column.name in ("name", "token") else column.name

        values = ", ".join(copied(column) for column in table.c)
        numbers = f"generate_series(1::bigint, {count - 1}) AS numbers (k)"
        columns = ", ".join(f'"{column.name}"' for column in table.c)
        connection.execute(sa.text(f"INSERT INTO {name} ({columns}) SELECT {values} FROM {name}, {numbers}"))
