"""Checks of a database when it is opened: of its pages and its tables."""

from __future__ import annotations

import logging
from threading import Event, Timer

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from surrogym_server.storage.sql.damage import damaged
from surrogym_server.storage.sql.tables import metadata

logger = logging.getLogger(__name__)

CHECK_SECONDS = 10.0  # enough for about 25 GB that are cached in memory
INDEXES_BYTES = 128 * 2**20  # largest file whose indexes are checked too; for 100 MB this takes 1.5 s instead of 0.4 s


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
    found = "ok"
    try:
        found = str(connection.exec_driver_sql(f"PRAGMA {_check(connection)}(1)").scalar())
    except sa.exc.OperationalError:
        if not expired.is_set():
            raise
    finally:
        timer.cancel()
        timer.join()  # otherwise it might interrupt a later statement
    if expired.is_set():  # an interrupted check gives no reliable result
        logger.warning("the database is large: its check stopped after %g s, and the rest was not checked", seconds)
    elif found != "ok":
        raise damaged(" ".join(found.split()))


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
