"""A write-ahead log is merged into the database that it was written for, and into no other; and a database that
somebody writes over is used no more."""

from __future__ import annotations

import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from surrogym_server.errors import Unavailable
from surrogym_server.storage.records import NewSurrogate
from surrogym_server.storage.sql import Storage, filelock, open_storage
from surrogym_server.storage.sql import storage as sql_storage

KILLED = """
import os, sys
from surrogym_server.storage.records import NewSurrogate
from surrogym_server.storage.sql import open_storage

storage = open_storage(f"sqlite:///{sys.argv[1]}")
for name in sys.argv[2:]:
    storage.surrogates.create(NewSurrogate(name, {"filler": "x" * 60_000}, 30, 0.9))
os._exit(9)
"""
MANY = [f"s{number}" for number in range(80)]  # more than one log's worth


def serve_and_kill(file: Path, *names: str) -> None:
    """A server that registers surrogates, and ends without closing anything."""
    subprocess.run([sys.executable, "-c", KILLED, str(file), *names], check=False)


def opened(file: Path) -> Storage:
    return open_storage(f"sqlite:///{file}")


def names(storage: Storage) -> list[str]:
    found: list[str] = []
    while page := storage.surrogates.summaries(storage.surrogates.get(found[-1]).id if found else 0):
        found += [summary.name for summary in page]
    return found


def served(file: Path) -> list[str]:
    storage = opened(file)
    try:
        return names(storage)
    finally:
        storage.close()


def register(file: Path, *surrogates: str) -> None:
    storage = opened(file)
    for name in surrogates:
        storage.surrogates.create(NewSurrogate(name, {}, 30, 0.9))
    storage.close()


def back_up(file: Path) -> Path:
    copy = file.with_name("copy.db")
    with closing(sqlite3.connect(file)) as source, closing(sqlite3.connect(copy)) as target:
        source.backup(target)
    return copy


def move(copy: Path, file: Path) -> None:
    copy.replace(file)


def overwrite(copy: Path, file: Path) -> None:
    shutil.copyfile(copy, file)  # the same inode


def contents(file: Path) -> dict[str, bytes]:
    return {
        each.name: each.read_bytes() for each in file.parent.glob(f"{file.name}*") if not each.name.endswith("lock")
    }


@pytest.mark.parametrize("restore", [move, overwrite])
def test_a_write_ahead_log_is_not_merged_into_another_database(
    tmp_path: Path, restore: Callable[[Path, Path], None]
) -> None:
    file, other = tmp_path / "a.db", tmp_path / "b.db"
    register(file, "r")
    register(other, "other")
    serve_and_kill(file, "zz")
    restore(other, file)
    before = contents(file)
    for _ in range(2):
        with pytest.raises(Unavailable, match=r"a\.db-wal, which was written for another .* nothing was changed"):
            opened(file)
    assert contents(file) == before
    for suffix in ("-wal", "-shm"):
        file.with_name(file.name + suffix).unlink()
    assert served(file) == ["other"]


@pytest.mark.parametrize("restore", [move, overwrite])
@pytest.mark.parametrize("copied", ["by_backup_of_a_killed_server", "between_two_servers"])
def test_a_write_ahead_log_is_not_merged_into_an_older_copy(
    tmp_path: Path, restore: Callable[[Path, Path], None], copied: str
) -> None:
    file = tmp_path / "a.db"
    register(file, "r")
    copy = Path(shutil.copyfile(file, tmp_path / "copy.db"))
    storage = opened(file)
    storage.surrogates.create(NewSurrogate("s", {}, 30, 0.9))
    if copied == "by_backup_of_a_killed_server":
        copy = back_up(file)
    storage.close()
    serve_and_kill(file, "zz")
    restore(copy, file)
    with pytest.raises(Unavailable, match=r"move a\.db-wal and a\.db-shm away"):
        opened(file)


def test_a_write_ahead_log_is_not_merged_into_a_copy_that_already_contains_it(tmp_path: Path) -> None:
    file = tmp_path / "a.db"
    serve_and_kill(file, "r")
    beside = {name: content for name, content in contents(file).items() if name != file.name}
    copy = back_up(file)  # merges the log, as its connection is the last one
    for name, content in beside.items():
        file.with_name(name).write_bytes(content)
    overwrite(copy, file)
    with pytest.raises(Unavailable, match="written for another"):
        opened(file)


def test_a_write_ahead_log_whose_database_is_missing_is_kept(tmp_path: Path) -> None:
    """SQLite deletes the log of an empty database."""
    file = tmp_path / "a.db"
    serve_and_kill(file, "r")
    file.rename(tmp_path / "elsewhere.db")
    with pytest.raises(Unavailable, match="written for another"):
        opened(file)
    assert not file.exists()
    (tmp_path / "elsewhere.db").rename(file)
    assert served(file) == ["r"]


@pytest.mark.parametrize("registered", [["r"], MANY])
def test_the_write_ahead_log_of_a_killed_server_is_merged_into_its_database(
    tmp_path: Path, registered: list[str]
) -> None:
    """Again and again, whether merging had begun or not, and after a move of all files to other inodes."""
    file = tmp_path / "a.db"
    serve_and_kill(file, *registered)
    serve_and_kill(file, "second")
    (tmp_path / "moved").mkdir()
    for name, content in contents(file).items():
        (tmp_path / "moved" / name).write_bytes(content)
    (tmp_path / "moved" / "a.db-shm").unlink()
    assert served(tmp_path / "moved" / file.name) == served(file) == [*registered, "second"]


@pytest.mark.parametrize("cut", [10, 100, 2_000, 6_000])
def test_a_write_ahead_log_truncated_by_power_loss_is_merged(tmp_path: Path, cut: int) -> None:
    file = tmp_path / "a.db"
    register(file, "r")
    serve_and_kill(file, "lost")
    wal = file.with_name("a.db-wal")
    content = wal.read_bytes()
    wal.write_bytes(content[:cut] + bytes(len(content) - cut))
    assert served(file) == ["r"]


def test_a_write_ahead_log_of_an_older_version_is_merged_into_its_database(tmp_path: Path) -> None:
    file = tmp_path / "a.db"
    with closing(sqlite3.connect(file)) as old:
        old.execute("PRAGMA journal_mode=WAL")
        old.execute("CREATE TABLE kept (x)")
        old.commit()
        for name, content in contents(file).items():
            (tmp_path / f"killed-{name}").write_bytes(content)
    assert filelock.belongs(tmp_path / "killed-a.db-wal", (tmp_path / "killed-a.db").read_bytes()[:100])
    assert served(tmp_path / "killed-a.db") == []


@pytest.mark.parametrize("copied", ["another", "backup"])
def test_a_database_file_overwritten_at_run_time_is_no_longer_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, copied: str
) -> None:
    """What was written over it stays as it is, byte for byte, and is what a server finds when the log is put away."""
    monkeypatch.setattr(sql_storage, "FRESH_SECONDS", 0.0)
    file, other = tmp_path / "a.db", tmp_path / "b.db"
    register(other, "other")
    storage = opened(file)
    storage.surrogates.create(NewSurrogate("r", {}, 30, 0.9))
    other = other if copied == "another" else back_up(file)
    overwrite(other, file)
    for use in (storage.surrogates.summaries, lambda: register_in(storage), storage.ping, storage.designs.due):
        with pytest.raises(Unavailable, match=r"a\.db was overwritten under the running server.*move a\.db-wal"):
            use()
    storage.close()
    assert file.read_bytes() == other.read_bytes()
    with pytest.raises(Unavailable, match="written for another"):
        opened(file)
    for suffix in ("-wal", "-shm"):
        file.with_name(file.name + suffix).unlink()
    assert served(file) == (["other"] if copied == "another" else ["r"])


def register_in(storage: Storage) -> None:
    storage.surrogates.create(NewSurrogate("later", {}, 30, 0.9))


def test_checkpointing_the_write_ahead_log_is_not_mistaken_for_overwriting(tmp_path: Path) -> None:
    """By this server, in the course of many writes, and by another program that has the file open."""
    file = tmp_path / "a.db"
    storage = opened(file)
    for number in range(120):
        storage.surrogates.create(NewSurrogate(f"s{number}", {"filler": "x" * 60_000}, 30, 0.9))
        if number % 12 == 0:
            with closing(sqlite3.connect(file)) as outside:
                outside.execute("PRAGMA wal_checkpoint")
            storage.surrogates.get(f"s{number}")
    storage.ping()
    storage.close()
    assert len(served(file)) == 120


def test_a_server_that_met_damaged_pages_is_not_ready(tmp_path: Path) -> None:
    file = tmp_path / "a.db"
    register(file, "r")
    storage = opened(file)
    storage.ping()
    with file.open("r+b") as damaged:
        damaged.seek(4096)
        damaged.write(b"\x55" * (file.stat().st_size - 4096))
    with pytest.raises(Unavailable, match="the database is damaged"):
        storage.surrogates.get("r")
    with pytest.raises(Unavailable, match=r"the database is damaged: .* restore a copy"):
        storage.ping()
    storage.close()
