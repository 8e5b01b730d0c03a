"""The storage of all data in a SQLite or PostgreSQL database, with migrations and checks of the database.

For all methods of the storage and its parts:
- an operation is atomic, and its changes are durable when it returns;
- all methods are thread-safe, and on PostgreSQL any number of servers may call them at a time;
- time is the database's clock, and a lease ends by that clock alone, whichever process dies; if the clock is set back,
  no lease lasts longer than its duration;
- an operation on a surrogate that does not exist raises ``UnknownSurrogate``;
- an operation that raises has changed nothing;
- a repeat with the same idempotency ``key`` and the same arguments changes nothing and returns the first result;
  with other arguments it raises ``IdempotencyConflict``;
- a database that can't be reached raises ``Unavailable``;
- stored data that differ from what was written raise ``Damaged``, which names them;
- events are appended by the operations themselves; their ids increase in the order in which they become visible.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from threading import Event, Lock, Timer
from typing import TypeVar

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from surrogym_server.errors import Damaged, Unavailable
from surrogym_server.storage.sql.database import Database, connect, damaged, never_connected
from surrogym_server.storage.sql.designs import Designs, Occupancy, Priors
from surrogym_server.storage.sql.events import Announcements, Events, NotifiedAnnouncements
from surrogym_server.storage.sql.models import Models, PolicyNames, Sessions
from surrogym_server.storage.sql.queries import Queries, Snapshots
from surrogym_server.storage.sql.samples import CountedSamples, Ledger, Samples
from surrogym_server.storage.sql.surrogates import Surrogates
from surrogym_server.storage.sql.tables import metadata

T = TypeVar("T")


class Storage:
    """The storage, which consists of parts. ``open_storage`` makes one."""

    def __init__(self, database: Database) -> None:
        self._database, counts = database, CountedSamples()
        self._readiness = Readiness(database)
        self.surrogates = Surrogates(database, counts)
        self.designs = Designs(database)
        self.queries = Queries(database)
        self.samples = Samples(database)
        self.snapshots = Snapshots(database)
        self.ledger = Ledger(database, counts)
        self.models = Models(database)
        self.priors = Priors(database)
        self.occupancy = Occupancy(database)
        self.sessions = Sessions(database)
        self.events = Events(database)
        self.policy_names = PolicyNames(database)
        self.announcements = NotifiedAnnouncements(database) if database.notifies else Announcements()

    def part(self, store: Callable[[Database], T]) -> T:
        """Create the store of an optional feature by calling ``store`` with the database of this storage."""
        return store(self._database)

    def ping(self) -> None:
        """Check that all tables exist and that the database accepts writes. The result is cached for a second.

        Raises:
            Unavailable: the check fails, or a write takes too long.
        """
        self._readiness.require()

    def close(self) -> None:
        """Release connections and locks. A second call does nothing."""
        self.announcements.close()
        self._readiness.close()
        self._database.close()


def open_storage(url: str) -> Storage:
    """Open a database, check it, and migrate its schema to the newest version.

    Args:
        url: ``sqlite:///path/to/file`` (created if it does not exist, for one server at a time) or
            ``postgresql://user:password@host/name`` (for several servers).

    Raises:
        InvalidInput: the address is of another kind.
        Unavailable: another server uses the SQLite file, PostgreSQL does not answer, or the database was written by a
            newer program.
        Damaged: pages, tables or columns are broken or missing; the message says how to recover.
    """
    database = connect(url)
    try:
        _bring_up(database)
    except BaseException as error:
        database.close()
        if isinstance(error, Unavailable) and never_connected(error.__cause__) and database.notifies:
            raise Unavailable(f"{error}; {_way_out(url, str(error))}") from error
        raise
    return Storage(database)


def _way_out(url: str, message: str) -> str:
    """Return what a person can do if the PostgreSQL database at ``url`` can't be opened, with this error
    ``message``."""
    name = sa.make_url(url).database
    if f'database "{name}" does not exist' in message:
        return f"createdb {name} makes it, or check --database"
    return "check that PostgreSQL runs, and the address in --database"


def _bring_up(database: Database) -> None:
    try:
        with database.read() as connection:
            check_pages(connection)
        migrate(database)
        with database.read() as connection:
            check_tables(connection)
        database.hold_open()
    except Damaged as error:
        raise Damaged(f"{error}; {database.way_out}") from error


SCRIPTS = Path(__file__).parent / "migrations"
VERSION = sa.table("alembic_version", sa.column("version_num", sa.Text))
MIGRATION_LOCK = 0x5355_5252  # arbitrary number of PostgreSQL's advisory lock, so that one server migrates at a time


def migrate(database: Database) -> None:
    """Run the migrations that the database's schema lacks.

    Raises:
        Unavailable: the database was written by a newer program, or by an unreleased one.
        Damaged: the database's record of its schema version is invalid.
    """
    revisions = [script.name[1:5] for script in sorted(SCRIPTS.glob("versions/r*.py"))]
    with database.write() as connection:
        _take_turn(connection)
        present = _present(connection)
        _refuse_others(present, revisions)
        if present != revisions[-1:]:
            _upgrade(connection)


def _present(connection: Connection) -> list[str]:
    """Return the revisions of the database's schema: usually one, none in a new database."""
    if not sa.inspect(connection).has_table(VERSION.name):
        return []
    return list(connection.execute(sa.select(VERSION.c.version_num)).scalars())


def _upgrade(connection: Connection) -> None:
    from alembic import command  # imported here, because it takes a fifteenth of the time in which a server starts
    from alembic.config import Config
    from alembic.util import CommandError

    config = Config(attributes={"connection": connection})
    config.set_main_option("script_location", str(SCRIPTS).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    try:
        command.upgrade(config, "head")
    except CommandError as error:  # raised by Alembic if the table alembic_version has no valid entry
        raise damaged(error) from error


def _take_turn(connection: Connection) -> None:
    if connection.dialect.name == "postgresql":
        # Wait without limit until another server's migration has ended.
        connection.execute(sa.text("SET LOCAL lock_timeout = 0"))
        # A migration may compute for a while between two statements.
        connection.execute(sa.text("SET LOCAL idle_in_transaction_session_timeout = 0"))
        connection.execute(sa.select(sa.func.pg_advisory_xact_lock(MIGRATION_LOCK)))


def _refuse_others(present: list[str], revisions: list[str]) -> None:
    unknown = sorted(map(str, set(present) - set(revisions)))
    if unknown and max(unknown) < revisions[0]:
        raise Unavailable(
            f"the database was written by an unreleased Surrogym: its schema is {', '.join(unknown)}, "
            f"the first released one is {revisions[0]}; export its samples with that version, or begin anew with "
            "another --database"
        )
    if unknown:
        raise Unavailable(
            f"the database was written by a newer Surrogym: its schema is {', '.join(unknown)}, this program knows "
            f"schemas up to {revisions[-1]}; start the newer program"
        )


logger = logging.getLogger(__name__)

CHECK_SECONDS = 10.0  # longest check of a SQLite file; enough for about 25 GB that are cached in memory
INDEXES_BYTES = 128 * 2**20  # largest file whose indexes are checked too; for 100 MB this takes 1.5 s instead of 0.4 s
FRESH_SECONDS = 1.0  # time for which a check of readiness is reused, so that it writes at most once a second
PATIENCE_SECONDS = 2.0  # longest wait of a caller for a check of readiness

schema = sa.table("alembic_version", sa.column("version_num"))


def check_pages(connection: Connection, seconds: float = CHECK_SECONDS) -> None:
    """Check the structure of a SQLite file, for at most ``seconds``. Does nothing for PostgreSQL.

    The indexes are checked too if the file has at most ``INDEXES_BYTES`` bytes.

    Raises:
        Damaged: the structure is broken; the message has SQLite's description.
    """
    if connection.dialect.name != "sqlite":
        return
    driver, expired = connection.connection.driver_connection, Event()
    assert driver is not None

    def cut_short() -> None:
        expired.set()
        driver.interrupt()

    timer = Timer(seconds, cut_short)
    timer.start()
    result = "ok"
    try:
        result = str(connection.exec_driver_sql(f"PRAGMA {_check(connection)}(1)").scalar())
    except sa.exc.OperationalError:
        if not expired.is_set():
            raise
    finally:
        timer.cancel()
        timer.join()  # the timer must not interrupt a later statement
    if expired.is_set():  # the result of an interrupted check is not reliable
        logger.warning("the database is large: its check stopped after %g s, and the rest was not checked", seconds)
    elif result != "ok":
        raise damaged(" ".join(result.split()))


def _check(connection: Connection) -> str:
    pages, size = (connection.exec_driver_sql(f"PRAGMA {name}").scalar_one() for name in ("page_count", "page_size"))
    return "integrity_check" if pages * size <= INDEXES_BYTES else "quick_check"


def check_tables(connection: Connection) -> None:
    """Check that all tables and columns exist, without reading rows.

    Raises:
        Damaged: a table or column is missing; the message names it.
    """
    for table in metadata.sorted_tables:
        connection.execute(sa.select(table).limit(0))


class Readiness:
    def __init__(self, database: Database) -> None:
        self._database = database
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="readiness")
        self._lock = Lock()
        self._probe: Future[None] | None = None
        self._probe_start = 0.0

    def require(self) -> None:
        """Check that all tables exist, that the database accepts writes, and that no broken page was found.

        The result of the last second is reused.

        Raises:
            Unavailable: the check failed, or took too long.
            Damaged: a page of the SQLite file is broken.
        """
        self._database.require_sound()
        probe = self._latest()
        wait([probe], PATIENCE_SECONDS)
        if not probe.done():
            raise Unavailable(
                f"the database can't be used now: no write succeeded within {PATIENCE_SECONDS:g} s; "
                "see whether its disk is full or another program holds it"
            )
        if (error := probe.exception()) is not None:
            raise Unavailable(str(error)) from error

    def close(self) -> None:
        self._thread.shutdown(wait=False)

    def _latest(self) -> Future[None]:
        """Return the last check of the database, or start a new check if the last one ended a while ago."""
        with self._lock:
            now = time.monotonic()
            if self._probe is None or (self._probe.done() and now - self._probe_start >= FRESH_SECONDS):
                self._probe, self._probe_start = self._thread.submit(self._write), now
            return self._probe

    def _write(self) -> None:
        with self._database.write() as connection:
            check_tables(connection)
            version = connection.execute(sa.select(schema.c.version_num)).scalar()
            for value in ("", version):  # two different values, so that SQLite really writes
                connection.execute(sa.update(schema).values(version_num=value))
