"""SqlStorage: the storage on one SQLite or PostgreSQL database."""

from __future__ import annotations

from collections.abc import Callable

import sqlalchemy as sa

from surrogym_server.errors import Damaged, Unavailable
from surrogym_server.storage.announcements import Alone
from surrogym_server.storage.port import Storage, T
from surrogym_server.storage.records import Synchronous
from surrogym_server.storage.sql.announcements import NotifiedAnnouncements
from surrogym_server.storage.sql.checks import Readiness, check_pages, check_tables
from surrogym_server.storage.sql.database import Database, connect, never_connected
from surrogym_server.storage.sql.designs import SqlDesigns
from surrogym_server.storage.sql.ledger import SqlLedger
from surrogym_server.storage.sql.memory import SqlEvents, SqlOccupancy, SqlSessions
from surrogym_server.storage.sql.migrate import migrate
from surrogym_server.storage.sql.models import SqlModels
from surrogym_server.storage.sql.policy_names import SqlPolicyNames
from surrogym_server.storage.sql.queries import SqlQueries
from surrogym_server.storage.sql.sample_counts import CountedSamples
from surrogym_server.storage.sql.samples import SqlSamples
from surrogym_server.storage.sql.snapshots import SqlSnapshots
from surrogym_server.storage.sql.surrogates import SqlSurrogates


class SqlStorage(Storage):
    """The ``Storage`` port on a SQLite or PostgreSQL database."""

    def __init__(self, database: Database) -> None:
        self._database, counted = database, CountedSamples()
        self._readiness = Readiness(database)
        self.surrogates = SqlSurrogates(database, counted)
        self.designs = SqlDesigns(database)
        self.queries = SqlQueries(database)
        self.samples = SqlSamples(database)
        self.snapshots = SqlSnapshots(database)
        self.ledger = SqlLedger(database, counted)
        self.models = SqlModels(database)
        self.occupancy = SqlOccupancy(database)
        self.sessions = SqlSessions(database)
        self.events = SqlEvents(database)
        self.policy_names = SqlPolicyNames(database)
        self.announcements = NotifiedAnnouncements(database) if database.notifies else Alone()

    def part(self, store: Callable[[Database], T]) -> T:
        return store(self._database)

    def ping(self) -> None:
        self._readiness.require()

    def close(self) -> None:
        self.announcements.close()
        self._readiness.close()
        self._database.close()


def open_storage(url: str, synchronous: Synchronous = "full") -> Storage:
    """Open a database, and bring its schema up to date.

    Args:
        url: ``sqlite:///path/to/file`` (created if it does not exist, for one server at a time) or
            ``postgresql://user:password@host/name`` (for several).
        synchronous: as in ``connect``.

    Raises:
        InvalidInput: another kind of address.
        Unavailable: another server holds the SQLite file, PostgreSQL does not answer, or the database was written by a
            newer program.
        Damaged: pages, tables or columns are broken or missing; the message says how to recover.
    """
    database = connect(url, synchronous)
    try:
        _bring_up(database)
    except BaseException as error:
        database.close()
        if isinstance(error, Unavailable) and never_connected(error.__cause__) and database.notifies:
            raise Unavailable(f"{error}; {_way_out(url, str(error))}") from error
        raise
    return SqlStorage(database)


def _way_out(url: str, message: str) -> str:
    """Return advice to people about a PostgreSQL database that can't be opened."""
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
