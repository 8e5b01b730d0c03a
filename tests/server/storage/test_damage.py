"""A damaged database: refused when it is opened, in one sentence, or named by whatever reads what is broken."""

from __future__ import annotations

import shutil
import sqlite3
import struct
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa

from surrogym_server.errors import Damaged, NoModel, SurrogymError
from surrogym_server.storage.records import NewDesign, NewSample, NewSurrogate
from surrogym_server.storage.sql import Storage, open_storage
from surrogym_server.storage.sql.database import connect
from surrogym_server.storage.sql.storage import check_pages
from surrogym_server.storage.sql.tables import Checked, metadata, models

NAME = "pendulum"
READS: dict[str, Callable[[Storage], Any]] = {
    "surrogates": lambda storage: storage.surrogates.summaries(),
    "due": lambda storage: storage.designs.due(),
    "queries": lambda storage: storage.queries.list(NAME),
    "samples": lambda storage: storage.samples.page(NAME, 0, 1_000),
    "arrays": lambda storage: storage.samples.arrays(NAME),
    "ledger": lambda storage: storage.ledger.read(NAME),
    "models": lambda storage: storage.models.list(NAME),
    "blob": lambda storage: storage.models.blob(NAME),
    "occupancy": lambda storage: storage.occupancy.latest(NAME),
    "events": lambda storage: storage.events.list(NAME),
}


def execute(url: str, statement: str) -> None:
    engine = sa.create_engine(url.replace("postgresql:", "postgresql+psycopg:"), poolclass=sa.NullPool)
    with engine.begin() as connection:
        connection.execute(sa.text(statement))


@pytest.fixture
def full(
    storage: Storage,
    make: Callable[..., str],
    answer_all: Callable[[str], None],
    design: Callable[..., NewDesign],
    by_hand: Callable[..., NewSample],
) -> Storage:
    """Something in every table."""
    name = make(queries=20)
    answer_all(name)
    lease = storage.designs.begin(name, "me", 60)
    assert lease is not None
    storage.designs.commit(lease, design(queries=3))
    storage.samples.add(name, "worker", [by_hand(float(i)) for i in range(20)], key="by hand")
    storage.occupancy.put(name, "visited", np.ones((50, 2)))
    storage.queries.claim(name, "worker", 1, 60.0)
    return storage


@pytest.fixture
def file(full: Storage, tmp_path: Path) -> Path:
    """A SQLite file that is filled and closed."""
    full.close()
    return tmp_path / "surrogym.db"


def opened_and_read(url: str) -> list[SurrogymError]:
    try:
        storage = open_storage(url)
    except SurrogymError as error:
        return [error]
    with closing(storage):
        return list(all_read(storage))


def all_read(storage: Storage) -> Iterator[SurrogymError]:
    """The errors of all reads; any that is no ``SurrogymError`` is raised."""
    for read in READS.values():
        try:
            read(storage)
        except SurrogymError as error:
            yield error


@pytest.mark.parametrize("url", ["sqlite"], indirect=True)
@pytest.mark.parametrize("flips", [1, 10, 60])
@pytest.mark.parametrize("seed", range(5))
def test_errors_from_flipped_database_bytes_are_one_line(url: str, file: Path, flips: int, seed: int) -> None:
    content = bytearray(file.read_bytes())
    random = np.random.default_rng(seed)
    for place in random.integers(len(content), size=flips):
        content[place] ^= int(random.integers(1, 256))
    file.write_bytes(content)
    assert not any("\n" in str(error) for error in opened_and_read(url))


@pytest.mark.parametrize("url", ["sqlite"], indirect=True)
def test_opening_a_database_with_damaged_pages_is_refused_with_repair_instructions(url: str, file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[4096:8192] = bytes(4096)
    file.write_bytes(content)
    with pytest.raises(Damaged, match=r"the database is damaged: .*restore a copy.*sqlite3 .*\.recover"):
        open_storage(url)
    assert file.read_bytes() == bytes(content), "it is left as it was"


@pytest.mark.parametrize("statement", ["DROP TABLE evaluations", "ALTER TABLE surrogates DROP COLUMN state"])
def test_opening_a_database_with_a_missing_table_or_column_is_refused(url: str, full: Storage, statement: str) -> None:
    full.close()
    execute(url, statement)
    with pytest.raises(Damaged, match=r"(evaluations|state).*restore a copy"):
        open_storage(url)


def test_opening_a_database_with_an_unknown_schema_is_refused(url: str, full: Storage) -> None:
    full.close()
    execute(url, "DELETE FROM alembic_version")
    with pytest.raises(Damaged, match="already exists"):
        open_storage(url)


def test_the_error_for_a_table_dropped_at_run_time_names_the_table(url: str, full: Storage) -> None:
    execute(url, "DROP TABLE evaluations")
    with pytest.raises(Damaged, match="evaluations"):
        full.ledger.read(NAME)


BROKEN_ROWS = [
    ("UPDATE surrogates SET spec = '{\"a'", "surrogates", r"JSON in surrogates\.spec, got '{\"a'"),
    ("UPDATE surrogates SET phase = 'reaxy'", "surrogates", r"surrogates\.phase, got 'reaxy'"),
    ("UPDATE queries SET status = ''", "queries", r"queries\.status"),
    ("UPDATE models SET fidelity = ''", "surrogates", "the confidence index of a model can't be read"),
    ("UPDATE models SET fidelity = ''", "models", r"JSON in models\.fidelity"),
    ("UPDATE events SET body = 'x'", "events", r"JSON in events\.body"),
]


@pytest.mark.parametrize(("statement", "read", "named"), BROKEN_ROWS)
def test_every_read_of_a_damaged_row_raises_an_error_that_names_it(
    url: str, full: Storage, statement: str, read: str, named: str
) -> None:
    execute(url, statement)
    with pytest.raises(Damaged, match=named):
        READS[read](full)


@pytest.mark.parametrize("url", ["sqlite"], indirect=True)
@pytest.mark.parametrize(
    ("statement", "read"),
    [
        ("UPDATE queries SET error = CAST(x'ff41' AS TEXT)", "queries"),
        ("UPDATE queries SET coordinates = x'000102'", "queries"),
    ],
)
def test_reading_bytes_that_cannot_be_decoded_raises_a_damage_error(
    url: str, full: Storage, statement: str, read: str
) -> None:
    with closing(sqlite3.connect(url.removeprefix("sqlite:///"))) as other:
        other.execute(statement)
        other.commit()
    with pytest.raises(Damaged):
        READS[read](full)


def test_the_page_check_of_a_large_database_stops_at_its_time_limit(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """And then says so, and lets the server start."""
    with closing(sqlite3.connect(tmp_path / "large.db")) as large:
        large.execute("CREATE TABLE a (b BLOB)")
        large.executemany("INSERT INTO a VALUES (zeroblob(1000000))", [()] * 200)
        large.commit()
    database = connect(f"sqlite:///{tmp_path}/large.db")
    with database.read() as connection:
        check_pages(connection, seconds=0.0)
        assert connection.exec_driver_sql("SELECT count(*) FROM a").scalar() == 200, "nothing else is interrupted"
    database.close()
    assert "its check stopped after 0 s" in caplog.text


def test_reading_everything_in_a_sound_database_raises_no_damage_error(full: Storage) -> None:
    assert list(all_read(full)) == []


def flip(url: str, version: int) -> None:
    """Another byte in the middle of a stored model."""
    engine = sa.create_engine(url.replace("postgresql:", "postgresql+psycopg:"), poolclass=sa.NullPool)
    own = models.c.version == version
    with engine.begin() as connection:
        blob = bytearray(connection.execute(sa.select(models.c.blob).where(own)).scalar_one())
        blob[len(blob) // 2] ^= 1
        connection.execute(sa.update(models).where(own).values(blob=bytes(blob)))


def test_a_model_changed_in_the_database_is_refused(url: str, full: Storage) -> None:
    assert full.models.blob(NAME, 1) == b"\0model"
    flip(url, 1)
    for version in (1, None):
        with pytest.raises(Damaged, match="model 1 of 'pendulum'"):
            full.models.blob(NAME, version)


def test_setting_a_damaged_model_aside_makes_the_previous_one_the_newest(
    full: Storage, design: Callable[..., NewDesign], answer_all: Callable[[str], None]
) -> None:
    surrogate = full.surrogates.get(NAME).id
    assert full.models.add(NAME, design().model) == 2
    assert full.models.set_aside(NAME, 2, "a flipped bit") is True
    assert full.models.set_aside(NAME, 2, "a flipped bit") is False
    assert (full.models.newest(), full.models.get(NAME).version) == ({surrogate: 1}, 1)
    assert [model.version for model in full.models.list(NAME)] == [1, 2], "its history stays"
    told = [event.body for event in full.events.list(NAME) if event.kind == "damaged"]
    assert told == [{"version": 2, "error": "a flipped bit"}]
    assert full.models.add(NAME, design().model) == 3, "no number is used twice"


def test_setting_a_damaged_model_aside_makes_a_fit_due(
    storage: Storage, make: Callable[..., str], answer_all: Callable[[str], None], design: Callable[..., NewDesign]
) -> None:
    name = make()
    answer_all(name)
    lease = storage.designs.begin(name, "me", 60)
    assert lease is not None
    storage.designs.commit(lease, design())
    assert storage.designs.due() == []
    storage.models.set_aside(name, 1, "a flipped bit")
    assert (storage.designs.due(), storage.models.newest()) == ([name], {})
    with pytest.raises(NoModel):
        storage.models.get(name)


@pytest.mark.parametrize("url", ["sqlite"], indirect=True)
def test_reading_a_value_of_wrong_type_raises_an_error_that_names_it(file: Path) -> None:
    """SQLite keeps text in a column of numbers, and bytes in a column of text."""
    columns = [column for table in metadata.tables.values() for column in table.columns]
    places = [f"{c.table.name}.{c.name}" for c in columns if isinstance(c.type, Checked) and not c.primary_key]
    named = []
    for place in places:
        database = connect(f"sqlite:///{changed_copy(file, place)}")
        with closing(Storage(database)) as storage:
            damage = [str(error) for error in all_read(storage) if isinstance(error, Damaged)]
        assert not damage or any(f" in {place}, got b'" in said for said in damage), (place, damage)
        named += [place] * bool(damage)
    assert {"surrogates.budget", "queries.attempts", "samples.reward", "models.samples", "events.created_at"} <= {
        *named
    }


def changed_copy(file: Path, place: str) -> Path:
    """A copy of a database in which a column ("table.column") holds bytes that are neither text nor a number."""
    table, column = place.split(".")
    copy = file.with_name(f"{place}.db")
    shutil.copy(file, copy)
    with closing(sqlite3.connect(copy)) as connection, connection:
        connection.execute(f"UPDATE {table} SET {column} = x'ff00' WHERE rowid = (SELECT min(rowid) FROM {table})")
    return copy


def test_opening_a_database_with_an_incomplete_index_is_refused(tmp_path: Path) -> None:
    """As after one file was copied over another under a running server; ``quick_check`` does not see it."""
    file = tmp_path / "surrogym.db"
    storage = open_storage(f"sqlite:///{file}")
    storage.surrogates.create(NewSurrogate("r", {}, 30, 0.9))
    storage.close()
    with closing(sqlite3.connect(file)) as database:
        wanted = "SELECT rootpage FROM sqlite_master WHERE type = 'index' AND tbl_name = 'surrogates'"
        [page], [size] = database.execute(wanted).fetchone(), database.execute("PRAGMA page_size").fetchone()
    with file.open("r+b") as damaged:
        damaged.seek((page - 1) * size)
        damaged.write(struct.pack(">BHHHB", 10, 0, 0, size, 0).ljust(size, b"\0"))  # a leaf without entries
    with closing(sqlite3.connect(file)) as database:
        assert database.execute("PRAGMA quick_check").fetchall() == [("ok",)]
    with pytest.raises(Damaged, match="missing from index"):
        open_storage(f"sqlite:///{file}")
