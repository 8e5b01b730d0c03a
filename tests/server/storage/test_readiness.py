"""Whether a storage is ready is known by writing, and who asks never waits long."""

from __future__ import annotations

import sqlite3
import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
import sqlalchemy as sa

from surrogym_server.errors import Unavailable
from surrogym_server.storage.sql import Storage, open_storage
from surrogym_server.storage.sql import storage as sql_storage
from surrogym_server.storage.sql.database import BUSY_SECONDS

Until = Callable[[Callable[[], bool]], None]


def execute(url: str, *statements: str) -> None:
    engine = sa.create_engine(url.replace("postgresql:", "postgresql+psycopg:"), poolclass=sa.NullPool)
    with engine.begin() as connection:
        for statement in statements:
            connection.execute(sa.text(statement))


def refusal(storage: Storage) -> str | None:
    try:
        storage.ping()
    except Unavailable as error:
        return str(error)
    return None


@pytest.fixture(autouse=True)
def _always_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sql_storage, "FRESH_SECONDS", 0.0)


def test_a_storage_with_a_missing_table_is_not_ready_until_it_is_restored(storage: Storage, url: str) -> None:
    storage.ping()
    execute(url, "ALTER TABLE evaluations RENAME TO gone")
    assert "evaluations" in (refusal(storage) or "")
    execute(url, "ALTER TABLE gone RENAME TO evaluations")
    assert refusal(storage) is None


@pytest.mark.parametrize("url", ["postgresql"], indirect=True)
@pytest.mark.postgresql
def test_a_database_that_can_only_be_read_is_not_ready(storage: Storage, url: str) -> None:
    """As a standby, or where a provider stops writes on a full disk."""
    storage.ping()
    everyone_out = (
        "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = current_database() AND pid != "
    )
    name = sa.make_url(url).database
    execute(url, f"ALTER DATABASE {name} SET default_transaction_read_only = on", f"{everyone_out} pg_backend_pid()")
    assert "read-only" in (refusal(storage) or "")


def test_readiness_checks_of_a_locked_database_fail_quickly(
    tmp_path: Path, until: Until, monkeypatch: pytest.MonkeyPatch
) -> None:
    storage = open_storage(f"sqlite:///{tmp_path}/surrogym.db")
    monkeypatch.setattr(sql_storage, "PATIENCE_SECONDS", 0.2)
    with closing(sqlite3.connect(tmp_path / "surrogym.db", isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        started = time.monotonic()
        said = [refusal(storage) for _ in range(5)]
        assert time.monotonic() - started < BUSY_SECONDS, "each took the patience, not the lock's"
        assert all(said)
    until(lambda: refusal(storage) is None)
    storage.close()


def test_simultaneous_readiness_checks_cause_one_write(storage: Storage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sql_storage, "FRESH_SECONDS", 3600.0)
    writes: list[None] = []
    write = sql_storage.Readiness._write
    monkeypatch.setattr(sql_storage.Readiness, "_write", lambda self: (writes.append(None), write(self)))
    callers = [threading.Thread(target=storage.ping) for _ in range(20)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert len(writes) == 1


def test_the_readiness_check_writes_to_disk_without_changing_data(tmp_path: Path) -> None:
    storage = open_storage(f"sqlite:///{tmp_path}/surrogym.db")
    log = tmp_path / "surrogym.db-wal"
    storage.ping()
    with closing(sqlite3.connect(tmp_path / "surrogym.db")) as other:
        other.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
        before = other.execute("SELECT version_num FROM alembic_version").fetchall()
        assert log.stat().st_size == 0
        storage.ping()
        assert log.stat().st_size > 0
        assert other.execute("SELECT version_num FROM alembic_version").fetchall() == before
    storage.close()
