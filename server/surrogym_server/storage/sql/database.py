"""Connections, transactions and the clock of a database, for SQLite and PostgreSQL.

Transactions that write to one surrogate run one after the other. On SQLite, ``BEGIN IMMEDIATE`` admits one writer; on
PostgreSQL, a write locks the surrogate's row first. Claims and renewals of queries lock the surrogate against deletion
at most, so other writers need not wait.
"""

from __future__ import annotations

import contextlib
import re
import shlex
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import URL, Connection, Engine
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.functions import FunctionElement

from surrogym_server.errors import Damaged, InvalidInput, Unavailable
from surrogym_server.storage.sql.filelock import FileLock, marks

SQLITE_CODES = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
# PostgreSQL's error codes for corrupted data, a corrupted index, a missing table and a missing column.
SQLSTATES = ("XX001", "XX002", "42P01", "42703")
# Pattern of SQLite's messages about missing or different tables; such errors have no code.
OTHER_SCHEMA = re.compile(r"no such (table|column)|has no column|already exists")
UNDECODABLE = "Could not decode to UTF-8"  # part of the message of SQLite's driver about damaged text


def damaged(reason: object) -> Damaged:
    """Return the error for stored data that are damaged; ``reason`` describes the damage."""
    return Damaged(f"the database is damaged: {reason}")


def means_damage(error: sa.exc.DBAPIError) -> bool:
    """Whether an error of the database driver means that stored data can't be read, or that tables are missing or
    different."""
    if getattr(error.orig, "sqlstate", None) in SQLSTATES:
        return True
    message = str(error.orig)
    return are_broken_pages(error) or UNDECODABLE in message or OTHER_SCHEMA.search(message) is not None


def are_broken_pages(error: sa.exc.DBAPIError) -> bool:
    """Whether an error of the driver means that the structure of a SQLite file is broken, which can't be repaired while
    the server runs."""
    return getattr(error.orig, "sqlite_errorcode", 0) & 0xFF in SQLITE_CODES


BUSY_SECONDS = 5  # longest wait of a statement for locks of other programs or threads
STALLED_SECONDS = 10  # time after which PostgreSQL ends an idle transaction, and its locks with it
BATCH = 250  # largest number of rows that one transaction writes or removes
# Pause after each of several transactions that write rows in batches, so that a waiting writer can begin.
PAUSE_SECONDS = 0.002
POOL = {"pool_size": 8, "max_overflow": 56, "pool_timeout": BUSY_SECONDS}
POSTGRESQL = {
    "client_encoding": "utf8",  # also for a database in SQL_ASCII, of which psycopg would return bytes instead of text
    "connect_timeout": BUSY_SECONDS,
}

STORABLE = "expected text without the character NUL and without halves of characters, and whole numbers below 2^63"

CLOCKS = {
    "sqlite": "((julianday('now') - 2440587.5) * 86400.0)",
    "postgresql": "extract(epoch FROM clock_timestamp())::float8",
}


class _Now(FunctionElement[float]):
    inherit_cache = True
    type = sa.Double()


@compiles(_Now)
def _now(_: _Now, compiler: SQLCompiler, **__: Any) -> str:
    return CLOCKS.get(compiler.dialect.name, "now()")  # statements in other dialects are never executed, only printed


NOW = _Now()  # SQL expression of the database's clock, in seconds since 1970


def constant(word: str) -> sa.ColumnElement[str]:
    """Return the SQL expression for ``word`` as a constant in the text of a statement. With a parameter instead, the
    query planner would not know that this value is rare."""
    return sa.literal_column(f"'{word}'", sa.Text())


class Database:
    """Provides connections for transactions, and converts errors of the driver to ``SurrogymError``."""

    def __init__(self, engine: Engine, lock: FileLock | None = None, *, way_out: str) -> None:
        """Wrap an SQLAlchemy engine.

        Args:
            engine: engine of SQLite or PostgreSQL.
            lock: lock on the SQLite file; None for PostgreSQL.
            way_out: advice in the error message if the database is damaged.
        """
        self.way_out = way_out
        self._engine = engine
        self._lock = lock
        self._writing = engine.execution_options(begin="BEGIN IMMEDIATE")
        # A lock of this process wakes the next writer at once, while SQLite's own lock is polled.
        self._turn = threading.RLock() if engine.dialect.name == "sqlite" else None
        self._open_connection: Connection | None = None
        self._broken: str | None = None

    def hold_open(self) -> None:
        """Keep a connection to the SQLite file open until ``close``, and watch for changes by other programs.

        SQLite deletes its write-ahead log when the last connection is closed. So while this connection is open, a
        missing or replaced write-ahead log shows that another program has changed the database. The write-ahead log is
        merged into the file first, so that the first bytes of the file differ from those of an older copy. Does nothing
        for PostgreSQL.
        """
        if self._lock is None:
            return
        with self._translated():
            self._open_connection = self._engine.connect()
            driver = self._open_connection.connection.driver_connection
            assert driver is not None
            driver.execute("PRAGMA wal_checkpoint").close()
            self._open_connection.execute(sa.text("SELECT count(*) FROM sqlite_master"))
            self._open_connection.rollback()
        self._lock.watch()

    @contextlib.contextmanager
    def read(self) -> Iterator[Connection]:
        self._require_own()
        with self._translated(), self._engine.begin() as connection:
            yield connection

    @contextlib.contextmanager
    def write(self) -> Iterator[Connection]:
        with self._take_turn():
            self._require_own()
            with self._translated(), self._writing.begin() as connection:
                self._mark_log(connection)
                yield connection

    def write_in_batches(self, batch: Callable[[Connection], int]) -> int:
        """Call ``batch`` repeatedly, each time in its own transaction, until it returns 0. Return the sum of its
        results.

        Other writers can run between two transactions. A batch of ``BATCH`` rows takes some milliseconds.
        """
        total = 0
        while True:
            with self.write() as connection:
                count = batch(connection)
            if not count:
                return total
            total += count
            time.sleep(PAUSE_SECONDS)

    def require_sound(self) -> None:
        """Raise ``Damaged`` if broken pages of the SQLite file have been found since the start. Other damage can be
        repaired while the server runs."""
        if self._broken is not None:
            raise Damaged(f"{self._broken}; {self.way_out}")

    def _require_own(self) -> None:
        """Check that no other program has changed or replaced the SQLite file. Raises ``Unavailable`` if one has."""
        if self._lock is None:
            return
        self._lock.require_in_place()
        if not self._lock.is_as_noted():
            # With the write lock, no other connection can be merging the write-ahead log into the file.
            with self._take_turn():
                self._lock.require_own_content()

    def _mark_log(self, connection: Connection) -> None:
        if self._lock is not None and self._lock.log_is_merged():
            for statement in marks(self._lock.header()):
                connection.exec_driver_sql(statement)

    @property
    def notifies(self) -> bool:
        """Whether the database can send notices to its connections, as PostgreSQL can."""
        return self._engine.dialect.name == "postgresql"

    def notify(self, channel: str, payloads: Sequence[str]) -> None:
        """Send messages (``payloads``) to all connections that listen to a channel of this PostgreSQL database."""
        with self.write() as connection:
            for payload in payloads:
                connection.execute(sa.select(sa.func.pg_notify(channel, payload)))

    def detached(self) -> Any:
        """Open a connection of the driver without a transaction. The caller has to close it. Raises ``Unavailable``."""
        with self._translated():
            own = self._engine.raw_connection()
            driver = own.driver_connection
            own.detach()
        assert driver is not None
        driver.autocommit = True
        return driver

    def close(self) -> None:
        if self._open_connection is not None:
            self._open_connection.close()
        self._engine.dispose()
        if self._lock is not None:
            self._lock.close()

    @contextlib.contextmanager
    def _take_turn(self) -> Iterator[None]:
        if self._turn is None:
            yield
            return
        if not self._turn.acquire(timeout=BUSY_SECONDS):
            raise Unavailable(
                f"the database can't be used now: other writers have held it for {BUSY_SECONDS} s; try again later"
            )
        try:
            yield
        finally:
            self._turn.release()

    @contextlib.contextmanager
    def _translated(self) -> Iterator[None]:
        try:
            yield
        except UNSTORABLE as error:
            raise InvalidInput(STORABLE) from error
        except UnicodeDecodeError as error:  # the driver can't decode a damaged name in SQLite's message
            raise self._damaged(error.object.decode(errors="replace"), pages=True) from error
        except sa.exc.TimeoutError as error:
            raise Unavailable(
                f"the database can't be used now, because all its connections are busy ({error}): try again later"
            ) from error
        except sa.exc.DBAPIError as error:
            if means_damage(error):
                raise self._damaged(_reason(error), pages=are_broken_pages(error)) from error
            if type(error) in UNUSABLE:
                raise Unavailable(f"the database can't be used now: {_reason(error)}") from error
            raise

    def _damaged(self, reason: str, *, pages: bool) -> Damaged:
        error = damaged(reason)
        if pages:
            self._broken = str(error)
        return error


def conflict_insert(connection: Connection, table: sa.Table) -> sqlite.Insert | postgresql.Insert:
    """Return the INSERT construct of this database's dialect, which supports ON CONFLICT."""
    return sqlite.insert(table) if connection.dialect.name == "sqlite" else postgresql.insert(table)


def connect(url: str) -> Database:
    """Open a SQLite file or a PostgreSQL database.

    Args:
        url: address such as ``sqlite:///path/to/file`` or ``postgresql://user@host/name``.

    Raises:
        InvalidInput: the address is of another kind.
        Unavailable: another server uses the SQLite file, or its write-ahead log belongs to another database.
    """
    try:
        location = sa.make_url(url)
    except sa.exc.ArgumentError:
        raise InvalidInput(f"expected a database address such as sqlite:///surrogym.db, got {url!r}") from None
    match location.get_backend_name():
        case "sqlite" if location.database and location.database != ":memory:":
            return _sqlite(Path(location.database))
        case "postgresql":
            return _postgresql(location)
        case _:
            address = location.render_as_string()
            raise InvalidInput(
                f"expected a database address such as sqlite:///path or postgresql://user@host/name, got {address}"
            )


def _sqlite(path: Path) -> Database:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Unavailable(
            f"the folder {path.parent} for the database can't be created: {error}; choose another path"
        ) from None
    if path.exists() and not (path.is_file() or path.is_dir()):  # opening a pipe could block forever
        raise InvalidInput(
            f"expected a file for the database, got {path}, which is a pipe, a socket or a device: choose another path"
        )
    lock = FileLock(path)
    engine = sa.create_engine(URL.create("sqlite", database=str(path)), connect_args={"timeout": BUSY_SECONDS}, **POOL)
    sa.event.listen(engine, "do_connect", lambda *_: lock.require_in_place())  # else SQLite would create a missing file
    sa.event.listen(engine, "connect", _prepare_sqlite)
    sa.event.listen(engine, "begin", _begin_sqlite)
    sa.event.listen(engine, "before_cursor_execute", _require_storable)
    recover = f"sqlite3 {shlex.quote(str(path))} .recover | sqlite3 recovered.db"
    return Database(engine, lock, way_out=f"restore a copy of the file, or save what can be read: {recover}")


def _prepare_sqlite(connection: Any, _: object) -> None:
    connection.isolation_level = None  # the driver begins no transaction itself; ``_begin_sqlite`` does
    # synchronous=FULL: each commit waits until the disk has stored it
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON"):
        connection.execute(f"PRAGMA {pragma}").close()


def _require_storable(_: Connection, __: Any, ___: str, parameters: Any, *____: Any) -> None:
    """Raise ``InvalidInput`` for text with the character NUL, which SQLite could store but PostgreSQL could not."""
    if _has_nul(parameters):
        raise InvalidInput(STORABLE)


def _has_nul(value: Any) -> bool:
    if isinstance(value, str):
        return "\0" in value
    if isinstance(value, dict):
        return any(map(_has_nul, value.values()))
    return isinstance(value, (tuple, list)) and any(map(_has_nul, value))


def _begin_sqlite(connection: Connection) -> None:
    connection.exec_driver_sql(connection.get_execution_options().get("begin", "BEGIN"))


def _postgresql(url: URL) -> Database:
    driven = url.set(drivername="postgresql+psycopg")
    limits = f"-c lock_timeout={BUSY_SECONDS}s -c idle_in_transaction_session_timeout={STALLED_SECONDS}s"
    unsaid = {name: value for name, value in {**POSTGRESQL, "options": limits}.items() if name not in url.query}
    engine = sa.create_engine(driven, connect_args=unsaid, pool_pre_ping=True, **POOL)
    return Database(engine, way_out="restore a copy")


# Errors of a database that can't be used now. They are compared by exact class, because subclasses of DatabaseError,
# such as IntegrityError, are bugs of this program.
UNUSABLE = (sa.exc.OperationalError, sa.exc.InternalError, sa.exc.InterfaceError, sa.exc.DatabaseError)
UNSTORABLE = (sa.exc.DataError, OverflowError, UnicodeEncodeError)


def never_connected(error: BaseException | None) -> bool:
    """Whether an error of PostgreSQL comes from the connection instead of a statement. Only errors of statements have a
    code."""
    return isinstance(error, sa.exc.OperationalError) and getattr(error.orig, "sqlstate", None) is None


def _reason(error: Exception) -> str:
    """Return the first line of the driver's message; the other lines show the SQL statement."""
    message = str(getattr(error, "orig", None) or error)
    return message.partition("\n")[0]
