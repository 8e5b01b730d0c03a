"""Check that the database accepts writes, at most once a second, in a thread for which nobody has to wait."""

from __future__ import annotations

import time
from concurrent.futures import Future, ThreadPoolExecutor, wait
from threading import Lock

import sqlalchemy as sa

from surrogym_server.errors import Unavailable
from surrogym_server.storage.sql.checks import check_tables
from surrogym_server.storage.sql.database import Database

FRESH_SECONDS = 1.0  # lifetime of a result, so that frequent checks cause one small write a second
PATIENCE_SECONDS = 2.0  # longest wait of a caller for a new result

schema = sa.table("alembic_version", sa.column("version_num"))


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
            raise Unavailable(f"the database can't be used now: no write succeeded within {PATIENCE_SECONDS:g} s")
        if (error := probe.exception()) is not None:
            raise Unavailable(str(error)) from error

    def close(self) -> None:
        self._thread.shutdown(wait=False)

    def _latest(self) -> Future[None]:
        """The last probe, or a new one if the last is finished and old."""
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
