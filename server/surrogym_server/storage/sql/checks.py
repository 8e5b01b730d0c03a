"""What is looked at when a database is opened: that its pages hang together, and that the tables are there."""

from __future__ import annotations

import logging
from threading import Event, Timer

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from surrogym_server.storage.sql.damage import damaged
from surrogym_server.storage.sql.tables import metadata

logger = logging.getLogger(__name__)

CHECK_SECONDS = 10.0  # some 25 GB that lie in memory
INDEXES_BYTES = 128 * 2**20  # of a file whose indexes are compared with their tables: 100 MB take 1.5 s, not 0.4 s


def check_pages(connection: Connection, seconds: float = CHECK_SECONDS) -> None:
    """Read a SQLite file once and check its structure, for at most ``seconds``, and the indexes of one that has no more
    than ``INDEXES_BYTES``; PostgreSQL looks after its own.

    Raises:
        Damaged: says where.
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
        timer.join()  # or it might interrupt a later statement
    if expired.is_set():  # what an interrupted check finds is not reliable
        logger.warning("the database is large: its check stopped after %g s, and the rest was not checked", seconds)
    elif found != "ok":
        raise damaged(" ".join(found.split()))


def _check(connection: Connection) -> str:
    pages, size = (connection.exec_driver_sql(f"PRAGMA {name}").scalar_one() for name in ("page_count", "page_size"))
    return "integrity_check" if pages * size <= INDEXES_BYTES else "quick_check"


def check_tables(connection: Connection) -> None:
    """Check that every table with every column is there; costs no look at a row.

    Raises:
        Damaged: names what is missing.
    """
    for table in metadata.sorted_tables:
        connection.execute(sa.select(table).limit(0))
