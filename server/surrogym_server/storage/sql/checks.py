"""Checks of a database: of its pages and tables when it is opened, and that it accepts writes while it is open."""

from __future__ import annotations

import logging
import time
from concurrent.futures import Future, ThreadPoolExecutor, wait
from threading import Event, Lock, Timer

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from surrogym_server.errors import Unavailable
from surrogym_server.storage.sql.damage import damaged
from surrogym_server.storage.sql.database import Database
from surrogym_server.storage.sql.tables import metadata

logger = logging.getLogger(__name__)

CHECK_SECONDS = 10.0  # enough for about 25 GB that are cached in memory
INDEXES_BYTES = 128 * 2**20  # largest file whose indexes are checked too; for 100 MB this takes 1.5 s instead of 0.4 s
FRESH_SECONDS = 1.0  # lifetime of a result, so that frequent checks cause one small write a second
PATIENCE_SECONDS = 2.0  # longest wait of a caller for a new result

schema = sa.table("alembic_version", sa.column("version_num"))


def check_pages(connection: Connection, seconds: float = CHECK_SECONDS) -> None:
    """Read a SQLite file once and check its structure, for at most ``seconds``. The indexes are checked too if the file
    has at most ``INDEXES_BYTES``. PostgreSQL checks its own files.

    Raises:
        Damaged: names the place.
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
        timer.join()  # otherwise it might interrupt a later statement
    if expired.is_set():  # an interrupted check gives no reliable result
        logger.warning("the database is large: its check stopped after %g s, and the rest was not checked", seconds)
    elif result != "ok":
        raise damaged(" ".join(result.split()))


def _check(connection: Connection) -> str:
    pages, size = (connection.exec_driver_sql(f"PRAGMA {name}").scalar_one() for name in ("page_count", "page_size"))
    return "integrity_check" if pages * size <= INDEXES_BYTES else "quick_check"


def check_tables(connection: Connection) -> None:
    """Check that every table and column exists, without reading rows.

    Raises:
        Damaged: names what is missing.
    """
    for table in metadata.sorted_tables:
        connection.execute(sa.select(table).limit(0))


class Readiness:
    def __init__(self, database: Database) -> None:
        self._database = database
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="readiness")
        self._lock = Lock()
        self._probe: Future[None] | None = None
        self._begun = 0.0

    def require(self) -> None:
        """Raise ``Unavailable`` unless all tables exist, a write was recently made durable, and no broken page was ever
        found: data written to such a file may be lost."""
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
        """Return the last check of the database, or begin a new one if that is finished and old."""
        with self._lock:
            now = time.monotonic()
            if self._probe is None or (self._probe.done() and now - self._begun >= FRESH_SECONDS):
                self._probe, self._begun = self._thread.submit(self._write), now
            return self._probe

    def _write(self) -> None:
        with self._database.write() as connection:
            check_tables(connection)
            version = connection.execute(sa.select(schema.c.version_num)).scalar()
            for value in ("", version):  # two different values, because SQLite writes nothing if nothing changes
                connection.execute(sa.update(schema).values(version_num=value))
