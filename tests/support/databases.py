"""Fixtures of storage. Tests that use them run on each adapter: a fresh SQLite file, a fresh database of PostgreSQL."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa

from support.postgresql import Postgresql, running_postgresql
from support.queries import steps
from surrogym_server.storage.records import NewSurrogate
from surrogym_server.storage.sql import Storage, open_storage
from surrogym_server.storage.sql.tables import metadata
from surrogym_shared.nouns import Query

SPEC = {"environment": "Pendulum-v1", "coordinates": [{"name": "angle"}, {"name": "speed"}]}
NAME = "pendulum"
TIMES = ("created_at", "begun", "expires", "fit_expires", "finished_at")


@pytest.fixture(scope="session")
def postgresql() -> Iterator[Postgresql]:
    with running_postgresql() as running:
        yield running


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgresql)])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """The address of an empty database."""
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path}/surrogym.db"
    running: Postgresql = request.getfixturevalue("postgresql")
    return running.new_database()


@pytest.fixture(scope="session")
def prepared_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file with the schema; to make it takes three times as long as to open it."""
    path = tmp_path_factory.mktemp("prepared") / "surrogym.db"
    open_storage(f"sqlite:///{path}").close()
    return path


@pytest.fixture
def storage(request: pytest.FixtureRequest, url: str) -> Iterator[Storage]:
    """At the address, with the schema."""
    address = sa.make_url(url)
    if address.get_backend_name() == "sqlite":
        shutil.copy(request.getfixturevalue("prepared_file"), str(address.database))
    opened = open_storage(url)
    yield opened
    opened.close()


@pytest.fixture
def make(storage: Storage) -> Callable[..., str]:
    """Create a surrogate with these queries, or with as many of C = 2 and F = 1."""

    def create(queries: int | tuple[Query, ...] = 3, name: str = NAME, **changes: Any) -> str:
        if isinstance(queries, int):
            queries = steps(np.arange(2.0 * queries).reshape(queries, 2), np.full((queries, 1), 0.5))
        values: dict[str, Any] = {"name": name, "spec": SPEC, "budget": 30, "target": 0.999, "queries": queries}
        storage.surrogates.create(NewSurrogate(**values | changes))
        return name

    return create


@pytest.fixture
def until() -> Callable[[Callable[[], bool]], None]:
    """Wait for something the database's clock brings about."""

    def wait(happened: Callable[[], bool]) -> None:
        deadline = time.monotonic() + 30
        while not happened():
            assert time.monotonic() < deadline, "it never happened"
            time.sleep(0.01)

    return wait


@pytest.fixture
def set_clock_back(url: str) -> Callable[[float], None]:
    """Set the database's clock back, as seen from what is stored: every stored time lies so much later."""

    def change(seconds: float) -> None:
        engine = sa.create_engine(url.replace("postgresql:", "postgresql+psycopg:"), poolclass=sa.NullPool)
        with engine.begin() as connection:
            for table in metadata.sorted_tables:
                times = {name: table.c[name] + seconds for name in TIMES if name in table.c}
                if times:
                    connection.execute(sa.update(table).values(times))

    return change
