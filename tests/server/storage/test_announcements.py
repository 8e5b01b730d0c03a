"""Servers of one database wake each other; one server on a SQLite file has nobody to tell."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from support.postgresql import Postgresql
from surrogym_server.storage.sql import Storage, events, open_storage

PATIENCE = 60.0
LISTENING = "FROM pg_stat_activity WHERE starts_with(query, 'LISTEN') AND datname = current_database()"
Heard = queue.Queue[str | None]


@pytest.fixture
def other(postgresql: Postgresql) -> Iterator[Callable[[], tuple[Storage, Heard]]]:
    """Another server of one PostgreSQL database, and what it hears."""
    url, opened = postgresql.new_database(), []

    def start() -> tuple[Storage, Heard]:
        storage = open_storage(url)
        opened.append(storage)
        heard: Heard = queue.Queue()
        storage.announcements.listen(heard.put)
        until_they_listen(storage, len(opened))
        return storage, heard

    yield start
    for storage in opened:
        storage.close()
    assert not [thread for thread in threading.enumerate() if thread.name in ("announce", "listen")]


def until_they_listen(storage: Storage, count: int) -> None:
    """Until PostgreSQL knows of the connections that listen."""
    database = storage.announcements._database
    for _ in range(int(PATIENCE / 0.01)):
        with database.read() as connection:
            if connection.exec_driver_sql(f"SELECT count(*) {LISTENING}").scalar_one() >= count:
                return
        time.sleep(0.01)
    raise AssertionError("they never listened")


def test_announcements_between_servers_do_nothing_on_sqlite(tmp_path) -> None:
    storage, heard = open_storage(f"sqlite:///{tmp_path}/surrogym.db"), []
    storage.announcements.listen(heard.append)
    storage.announcements.announce("a")
    storage.close()
    storage.announcements.close()
    assert heard == []


@pytest.mark.postgresql
def test_a_server_receives_announcements_of_others_but_not_its_own(other) -> None:
    (first, heard_by_first), (second, heard_by_second) = other(), other()
    first.announcements.announce("über pendulum")
    assert heard_by_second.get(timeout=PATIENCE) == "über pendulum"
    second.announcements.announce("cartpole")
    assert heard_by_first.get(timeout=PATIENCE) == "cartpole"
    assert heard_by_first.empty()
    assert heard_by_second.empty()


@pytest.mark.postgresql
def test_after_a_lost_connection_a_server_is_told_that_announcements_may_be_missing(other) -> None:
    (first, _), (second, heard) = other(), other()
    with first.announcements._database.write() as connection:
        connection.exec_driver_sql(f"SELECT pg_terminate_backend(pid) {LISTENING}")
    assert heard.get(timeout=PATIENCE) is None
    until_they_listen(first, 2)
    first.announcements.announce("a")
    assert heard.get(timeout=PATIENCE) == "a"
    second.close()
    second.announcements.close()
    first.announcements.announce("b")


@pytest.mark.postgresql
def test_announcements_in_quick_succession_are_merged_and_none_is_lost(other, monkeypatch) -> None:
    monkeypatch.setattr(events, "GAP_SECONDS", 3_600.0)
    (first, _), (_, heard) = other(), other()
    first.announcements.announce("a")
    assert heard.get(timeout=PATIENCE) == "a"
    for _ in range(3):
        first.announcements.announce("b")
    assert heard.empty()
    first.close()
    assert heard.get(timeout=PATIENCE) == "b"
    assert heard.empty()
