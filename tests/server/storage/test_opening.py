"""Opening a database: the schema, what is refused, and what survives a kill."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory

from support.postgresql import Postgresql
from surrogym_server import app  # noqa: F401  # its features define tables
from surrogym_server.errors import InvalidInput, Unavailable
from surrogym_server.storage.records import NewSurrogate
from surrogym_server.storage.sql import Storage, database, filelock, open_storage
from surrogym_server.storage.sql.database import connect
from surrogym_server.storage.sql.filelock import FileLock
from surrogym_server.storage.sql.storage import SCRIPTS
from surrogym_server.storage.sql.tables import metadata

WRITER = """
import sys
from surrogym_server.storage.records import NewSample, NewSurrogate
from surrogym_server.storage.sql import database, open_storage
from surrogym_server.storage.sql.database import connect

storage = open_storage(sys.argv[1])
storage.surrogates.create(NewSurrogate("a", {}, 30, 0.9))
for number in range(100_000):
    sample = NewSample((1.0,), (1.0,), (1.0,), float(number), False)
    [id] = storage.samples.add("a", "w", [sample], key=str(number)).ids
    print(number, id, flush=True)
"""

OPENER = """
import sys
from surrogym_server.storage.sql import open_storage
open_storage(sys.argv[1]).ping()
"""


def engine(url: str) -> sa.Engine:
    return sa.create_engine(url.replace("postgresql:", "postgresql+psycopg:"), poolclass=sa.NullPool)


def test_database_migrations_create_the_tables_the_program_uses(url: str) -> None:
    """Besides, there may be tables of features that this program lacks."""
    open_storage(url).close()

    def is_known(table: sa.Table, name: str, kind: str, reflected: bool, known: sa.Table | None) -> bool:
        return kind != "table" or known is not None

    with engine(url).connect() as connection:
        opts = {"compare_type": True, "include_object": is_known}
        assert compare_metadata(MigrationContext.configure(connection, opts=opts), metadata) == []


def test_reopening_a_database_keeps_everything(url: str, storage: Storage, make: Callable[..., str]) -> None:
    make(name="kept")
    before = storage.surrogates.get("kept")
    storage.close()
    again = open_storage(url)
    assert again.surrogates.get("kept") == before
    again.close()


def test_a_database_of_a_newer_version_is_refused_and_left_unchanged(url: str) -> None:
    open_storage(url).close()
    with engine(url).begin() as connection:
        connection.execute(sa.text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(Unavailable, match=r"newer Surrogym.*9999"):
        open_storage(url)
    with engine(url).connect() as connection:
        assert connection.execute(sa.text("SELECT version_num FROM alembic_version")).scalar() == "9999"


def test_a_database_of_an_unreleased_version_is_refused_and_left_unchanged(url: str) -> None:
    open_storage(url).close()
    with engine(url).begin() as connection:
        connection.execute(sa.text("UPDATE alembic_version SET version_num = '0011'"))
    with pytest.raises(Unavailable, match=r"unreleased Surrogym.*0011.*export its samples .* or begin anew"):
        open_storage(url)
    with engine(url).connect() as connection:
        assert connection.execute(sa.text("SELECT version_num FROM alembic_version")).scalar() == "0011"


def test_migration_file_names_are_their_revision_numbers_in_order() -> None:
    """Opening compares the names with the database, so that Alembic is loaded only where something is missing."""
    scripts = ScriptDirectory(str(SCRIPTS)).walk_revisions()
    assert [f"r{script.revision}" for script in reversed(list(scripts))] == [
        path.name[:5] for path in sorted(SCRIPTS.glob("versions/r*.py"))
    ]


def test_a_database_with_the_current_schema_is_opened_without_alembic(url: str) -> None:
    open_storage(url).close()
    opening = f"from surrogym_server.storage.sql import open_storage; open_storage({url!r}).close(); import sys"
    done = subprocess.run(
        [sys.executable, "-c", f"{opening}; print('alembic' in sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "False"


@pytest.mark.postgresql
def test_text_is_stored_as_utf8_in_an_sql_ascii_postgresql_database(postgresql: Postgresql) -> None:
    url = postgresql.new_database("TEMPLATE template0 ENCODING 'SQL_ASCII' LC_COLLATE 'C' LC_CTYPE 'C'")
    opened = open_storage(url)
    opened.surrogates.create(NewSurrogate("a", {"environment": "Fräse 3 µm"}, 30, 0.9))
    opened.close()
    again = open_storage(url)
    assert again.surrogates.get("a").spec == {"environment": "Fräse 3 µm"}
    again.close()


def test_a_database_answers_ping_and_can_be_closed_twice(storage: Storage) -> None:
    storage.ping()
    storage.close()
    storage.close()


@pytest.mark.parametrize("url", ["mysql://host/name", "sqlite://", "sqlite:///:memory:", "surrogym.db"])
def test_unsupported_database_urls_are_refused(url: str) -> None:
    with pytest.raises(InvalidInput, match="expected"):
        open_storage(url)


def test_the_error_for_a_refused_database_url_hides_its_password() -> None:
    with pytest.raises(InvalidInput) as refused:
        open_storage("mysql://user:secret@host/name")
    assert "secret" not in str(refused.value)


def test_a_second_server_on_the_same_sqlite_file_is_refused(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/surrogym.db"
    first = open_storage(url)
    with pytest.raises(Unavailable, match="only server"):
        open_storage(url)
    first.ping()
    first.close()
    open_storage(url).close()


def by_symbolic_link(file: Path) -> Path:
    link = file.with_name("symbolic.db")
    link.symlink_to(file)
    return link


def by_hard_link(file: Path) -> Path:
    link = file.with_name("hard.db")
    link.hardlink_to(file)
    return link


def after_a_move(file: Path) -> Path:
    return file.rename(file.with_name("moved.db"))


def without_files_beside_it(file: Path) -> Path:
    for other in file.parent.glob("*lock*"):
        other.unlink()
    return file


OTHER_NAMES = [by_symbolic_link, by_hard_link, after_a_move, without_files_beside_it]


@pytest.mark.parametrize("other_name", OTHER_NAMES)
def test_a_second_server_on_a_link_to_the_same_sqlite_file_is_refused(
    tmp_path: Path, other_name: Callable[[Path], Path]
) -> None:
    """In another process, for a lock may be kept by process; and this one's locks outlive the refusals."""
    file = tmp_path / "surrogym.db"
    first = open_storage(f"sqlite:///{file}")
    second = other_name(file)
    for _ in range(2):
        with pytest.raises(Unavailable, match="only server"):
            open_storage(f"sqlite:///{second}")
        opening = subprocess.run([sys.executable, "-c", OPENER, f"sqlite:///{second}"], capture_output=True, text=True)
        assert "only server" in opening.stderr, opening
    first.close()
    open_storage(f"sqlite:///{second}").close()


def test_without_byte_range_locks_a_lock_file_refuses_a_second_server(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(filelock, "WHOLE_DESCRIPTION", None)
    monkeypatch.setattr(filelock, "_locked_files", set())  # as if the second were another process
    first = FileLock(tmp_path / "surrogym.db")
    monkeypatch.setattr(filelock, "_locked_files", set())
    with pytest.raises(Unavailable, match="only server"):
        FileLock(by_symbolic_link(tmp_path / "surrogym.db"))
    first.close()
    FileLock(tmp_path / "surrogym.db").close()


def delete(file: Path) -> None:
    file.unlink()


def replace_by_a_copy(file: Path) -> None:
    copy = file.with_name("copy.db")
    copy.write_bytes(file.read_bytes())
    copy.replace(file)


@pytest.mark.parametrize("change", [delete, after_a_move, replace_by_a_copy])
def test_writing_is_refused_if_the_database_file_was_moved_replaced_or_deleted(
    tmp_path: Path, change: Callable[[Path], Any]
) -> None:
    file = tmp_path / "surrogym.db"
    storage = open_storage(f"sqlite:///{file}")
    change(file)
    with pytest.raises(Unavailable, match="moved, replaced or deleted"):
        storage.surrogates.create(NewSurrogate("a", {}, 30, 0.9))
    storage.close()
    assert change is replace_by_a_copy or not file.exists(), "no empty database in its place"


@pytest.mark.parametrize("suffix", ["-wal", "-shm"])
@pytest.mark.parametrize("replaced", [False, True])
def test_deleting_the_write_ahead_log_at_run_time_loses_no_acknowledged_data(
    tmp_path: Path, suffix: str, replaced: bool
) -> None:
    """What was acknowledged before is there after a restart; nothing is acknowledged into a log that nobody finds."""
    file = tmp_path / "surrogym.db"
    storage = open_storage(f"sqlite:///{file}")
    storage.surrogates.create(NewSurrogate("acknowledged", {}, 30, 0.9))
    beside = file.with_name(file.name + suffix)
    beside.unlink()
    if replaced:
        beside.write_bytes(b"")
    with pytest.raises(Unavailable, match=f"{suffix} was moved, replaced or deleted .* stop the server"):
        storage.surrogates.create(NewSurrogate("later", {}, 30, 0.9))
    with pytest.raises(Unavailable, match="stop the server"):
        storage.surrogates.summaries()
    with pytest.raises(Unavailable, match="stop the server"):
        storage.ping()
    storage.close()
    again = open_storage(f"sqlite:///{file}")
    assert [summary.name for summary in again.surrogates.summaries()] == ["acknowledged"]
    again.close()


def test_reading_is_refused_if_the_database_file_was_replaced(tmp_path: Path) -> None:
    file = tmp_path / "surrogym.db"
    storage = open_storage(f"sqlite:///{file}")
    replace_by_a_copy(file)
    with pytest.raises(Unavailable, match="moved, replaced or deleted"):
        storage.surrogates.summaries()
    storage.close()


def test_a_folder_in_the_place_of_the_database_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "surrogym.db").mkdir()
    with pytest.raises(Unavailable, match=r"expected a file to read and write .*surrogym\.db"):
        open_storage(f"sqlite:///{tmp_path}/surrogym.db")


def test_opening_a_file_that_is_not_a_database_is_refused(tmp_path: Path) -> None:
    (tmp_path / "surrogym.db").write_text("a diary\n" * 1000)
    with pytest.raises(Unavailable, match="not a database"):
        open_storage(f"sqlite:///{tmp_path}/surrogym.db")


def test_a_database_in_a_folder_that_cannot_be_created_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(Unavailable, match="folder"):
        open_storage(f"sqlite:///{tmp_path}/file/surrogym.db")


@pytest.mark.postgresql
def test_an_unreachable_postgresql_raises_unavailable(tmp_path: Path) -> None:
    with pytest.raises(Unavailable, match="check that PostgreSQL runs, and the address in --database"):
        open_storage(f"postgresql://postgres@/x?host={tmp_path}")


@pytest.mark.postgresql
def test_the_error_for_a_missing_postgresql_database_shows_the_createdb_command(postgresql: Postgresql) -> None:
    missing = sa.make_url(postgresql.new_database()).set(database="nowhere").render_as_string()
    with pytest.raises(Unavailable, match='"nowhere" does not exist; createdb nowhere makes it, or check --database'):
        open_storage(missing)


def test_sqlite_syncs_to_disk_before_acknowledging_a_commit(tmp_path: Path):
    opened = connect(f"sqlite:///{tmp_path}/surrogym.db")
    with opened.write() as connection:
        pragmas = {
            name: connection.exec_driver_sql(f"PRAGMA {name}").scalar()
            for name in ("journal_mode", "synchronous", "foreign_keys")
        }
    opened.close()
    assert pragmas == {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1}


def test_a_second_writer_gives_up_after_waiting_for_the_first_too_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(database, "BUSY_SECONDS", 0.05)
    opened = connect(f"sqlite:///{tmp_path}/surrogym.db")

    def second() -> None:
        with opened.write():
            pytest.fail("two writers at once")

    with (
        ThreadPoolExecutor(1) as thread,
        opened.write(),
        pytest.raises(Unavailable, match="other writers have held it"),
    ):
        thread.submit(second).result()
    with opened.write():
        pass
    opened.close()


def test_a_killed_writer_loses_no_acknowledged_data(url: str) -> None:
    writer = subprocess.Popen([sys.executable, "-c", WRITER, url], stdout=subprocess.PIPE, text=True)
    assert writer.stdout is not None
    acknowledged = [writer.stdout.readline().split() for _ in range(20)]
    os.kill(writer.pid, signal.SIGKILL)
    acknowledged += [line.split() for line in writer.stdout.read().splitlines()]
    writer.stdout.close()
    writer.wait()

    storage = open_storage(url)
    stored = {sample.id: sample.reward for sample in storage.samples.page("a", 0, 100_000)}
    storage.close()
    assert {int(id): float(number) for number, id in acknowledged}.items() <= stored.items()
    assert len(stored) <= len(acknowledged) + 1, "at most the one that was on its way"


def test_a_database_path_that_is_a_pipe_is_refused_without_blocking(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InvalidInput, match=r"expected a file for the database, got .*pipe"):
        open_storage(f"sqlite:///{tmp_path}/pipe")


def test_sqlite_and_postgresql_refuse_unstorable_values_with_the_same_error(storage: Storage) -> None:
    said = set()
    for name in ("nul \0", "half \ud800"):
        with pytest.raises(InvalidInput) as refused:
            storage.surrogates.create(NewSurrogate(name, {}, 1, 0.9))
        said.add(str(refused.value))
    with pytest.raises(InvalidInput) as refused:
        storage.surrogates.name_of(2**64)
    assert said == {str(refused.value)} == {database.STORABLE}
    assert storage.surrogates.summaries() == []
