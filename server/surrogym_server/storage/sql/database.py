"""Connections, transactions and the clock: the only file that tells the databases apart.

Writers of one surrogate take turns: on SQLite because ``BEGIN IMMEDIATE`` lets in one writer, on PostgreSQL
because a write locks the surrogate's row first. Claims, which skip what is locked, and renewals lock less.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import URL, Connection, Engine

from surrogym_server.errors import InvalidInput, Unavailable
from surrogym_server.storage.sql.filelock import FileLock

BUSY_SECONDS = 30
POOL = {"pool_size": 8, "max_overflow": 56, "pool_timeout": BUSY_SECONDS}

CLOCKS: dict[str, sa.ColumnElement[float]] = {
    "sqlite": sa.literal_column("(julianday('now') - 2440587.5) * 86400.0", sa.Double()),
    "postgresql": sa.literal_column("extract(epoch FROM clock_timestamp())::float8", sa.Double()),
}


class Database:
    """Hands out connections inside a transaction, and translates the driver's errors."""

    def __init__(self, engine: Engine, lock: FileLock | None = None) -> None:
        self._engine = engine
        self._lock = lock
        self._writing = engine.execution_options(begin="BEGIN IMMEDIATE")
        # SQLite's own waiting polls; a lock in this process wakes the next writer at once
        self._turn = threading.Lock() if engine.dialect.name == "sqlite" else contextlib.nullcontext()

    @contextlib.contextmanager
    def read(self) -> Iterator[Connection]:
        with _translated(), self._engine.begin() as connection:
            yield connection

    @contextlib.contextmanager
    def write(self) -> Iterator[Connection]:
        with _translated(), self._turn, self._writing.begin() as connection:
            yield connection

    def close(self) -> None:
        self._engine.dispose()
        if self._lock is not None:
            self._lock.close()


def clock(connection: Connection) -> sa.ColumnElement[float]:
    """Seconds since 1970, as a column of the next statement."""
    return CLOCKS[connection.dialect.name]


def conflict_insert(connection: Connection, table: sa.Table) -> sqlite.Insert | postgresql.Insert:
    """An INSERT that knows ON CONFLICT."""
    return sqlite.insert(table) if connection.dialect.name == "sqlite" else postgresql.insert(table)


def connect(url: str) -> Database:
    """Make the database of ``sqlite:///path/to/file`` or ``postgresql://user@host/name``.

    Raises:
        InvalidInput: another kind of address.
        Unavailable: another server holds the SQLite file.
    """
    try:
        parsed = sa.make_url(url)
    except sa.exc.ArgumentError:
        raise InvalidInput(f"expected a database address such as sqlite:///surrogym.db, got {url!r}") from None
    match parsed.get_backend_name():
        case "sqlite" if parsed.database and parsed.database != ":memory:":
            return _sqlite(Path(parsed.database))
        case "postgresql":
            return _postgresql(parsed)
        case _:
            shown = parsed.render_as_string()
            raise InvalidInput(f"expected sqlite:///path or postgresql://user@host/name, got {shown}")


def _sqlite(path: Path) -> Database:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Unavailable(f"expected a folder for the database, got {path.parent}: {error}") from None
    lock = FileLock(path.with_name(path.name + ".lock"))
    engine = sa.create_engine(URL.create("sqlite", database=str(path)), connect_args={"timeout": BUSY_SECONDS}, **POOL)
    sa.event.listen(engine, "connect", _prepare_sqlite)
    sa.event.listen(engine, "begin", _begin_sqlite)
    return Database(engine, lock)


def _prepare_sqlite(connection: Any, _: object) -> None:
    connection.isolation_level = None  # the driver starts no transactions; _begin_sqlite does
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON"):
        connection.execute(f"PRAGMA {pragma}").close()


def _begin_sqlite(connection: Connection) -> None:
    connection.exec_driver_sql(connection.get_execution_options().get("begin", "BEGIN"))


def _postgresql(url: URL) -> Database:
    engine = sa.create_engine(url.set(drivername="postgresql+psycopg"), pool_pre_ping=True, **POOL)
    return Database(engine)


# exactly these: IntegrityError and ProgrammingError derive from DatabaseError, and are our own bugs
UNUSABLE = (sa.exc.OperationalError, sa.exc.InterfaceError, sa.exc.TimeoutError, sa.exc.DatabaseError)
UNSTORABLE = (sa.exc.DataError, OverflowError, UnicodeEncodeError)


@contextlib.contextmanager
def _translated() -> Iterator[None]:
    try:
        yield
    except (*UNUSABLE, *UNSTORABLE) as error:
        reason = getattr(error, "orig", None) or error
        if isinstance(error, UNSTORABLE):
            raise InvalidInput(f"expected a value the database can store: {reason}") from error
        if type(error) in UNUSABLE:
            raise Unavailable(f"the database can't be used now: {reason}") from error
        raise
