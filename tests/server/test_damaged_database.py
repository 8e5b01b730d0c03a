"""A real server on a damaged database: it starts where it can, names what is broken, and serves the rest."""

from __future__ import annotations

import shutil
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from support import pendulum
from support.server import ServerProcess, refusal, running_server

NAME = "pendulum"
SECONDS = 60.0


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database that a stopped server has left: with a surrogate, its models and an open session."""
    folder = tmp_path_factory.mktemp("whole")
    with running_server(folder) as running, httpx.Client(base_url=running.url, timeout=SECONDS) as client:
        pendulum.teach(client, NAME, seconds=10 * SECONDS)
        client.post(f"/v1/surrogates/{NAME}/sessions", json={"num_envs": 1, "seed": 0}).raise_for_status()
    return folder / "surrogym.db"


def execute(file: Path, statement: str, *parameters: Any) -> None:
    with closing(sqlite3.connect(file)) as database:
        database.execute(statement, parameters)
        database.commit()


def flip(file: Path, table: str, column: str) -> None:
    """Flip one bit in the middle of a blob, of the row that was stored last."""
    with closing(sqlite3.connect(file)) as database:
        last = f"SELECT max(rowid) FROM {table}"
        [blob] = database.execute(f"SELECT {column} FROM {table} WHERE rowid = ({last})").fetchone()
        flipped = bytearray(blob)
        flipped[len(blob) // 2] ^= 1
        database.execute(f"UPDATE {table} SET {column} = ? WHERE rowid = ({last})", [bytes(flipped)])
        database.commit()


@contextmanager
def changed(file: Path, column: str, value: str) -> Iterator[None]:
    """Another value in a column of every surrogate, for the time of the context."""
    with closing(sqlite3.connect(file)) as database:
        [before] = database.execute(f"SELECT {column} FROM surrogates WHERE name = '{NAME}'").fetchone()
    execute(file, f"UPDATE surrogates SET {column} = ? WHERE name = '{NAME}'", value)
    try:
        yield
    finally:
        execute(file, f"UPDATE surrogates SET {column} = ? WHERE name = '{NAME}'", before)


@pytest.fixture(scope="module")
def server(database: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    folder = tmp_path_factory.mktemp("damaged")
    file = Path(shutil.copy(database, folder))
    flip(file, "sessions", "data")
    with running_server(folder) as running:
        yield running


@pytest.fixture
def client(server: ServerProcess) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server.url, timeout=SECONDS) as opened:
        yield opened


def until(happened: Callable[[], bool]) -> None:
    deadline = time.monotonic() + SECONDS
    while not happened():
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.1)


def test_the_server_starts_despite_a_damaged_saved_session_and_names_it(server: ServerProcess, client: httpx.Client):
    assert "the saved session" in server.log
    assert "is lost: expected a saved session" in server.log
    assert client.get("/readyz").json() == {"status": "ready", "storage": "ok"}


@pytest.mark.parametrize(("column", "value"), [("spec", '{"coordinates'), ("spec", "{}"), ("phase", "reaxy")])
def test_a_damaged_row_gives_an_error_naming_it_and_others_are_served(
    server: ServerProcess, client: httpx.Client, column: str, value: str
):
    with changed(server.folder / "surrogym.db", column, value):
        answer = client.get(f"/v1/surrogates/{NAME}")
        other = client.post("/v1/surrogates", json={"name": "other", "spec": pendulum.spec()})
        deleted = client.delete("/v1/surrogates/other")
    assert (answer.status_code, answer.json()["code"]) == (500, "damaged")
    assert column in answer.json()["detail"]
    assert (other.status_code, deleted.status_code) == (201, 204)
    assert client.get(f"/v1/surrogates/{NAME}").status_code == 200
    assert "Traceback" not in server.log


def test_a_missing_table_gives_an_error_naming_it_and_the_server_is_not_ready(
    server: ServerProcess, client: httpx.Client
):
    file = server.folder / "surrogym.db"
    execute(file, "ALTER TABLE evaluations RENAME TO gone")
    until(lambda: client.get("/readyz").status_code == 503)
    assert "evaluations" in client.get("/readyz").json()["detail"]
    answer = client.get(f"/v1/surrogates/{NAME}")
    assert (answer.status_code, answer.json()["code"]) == (500, "damaged")
    execute(file, "ALTER TABLE gone RENAME TO evaluations")
    until(lambda: client.get("/readyz").status_code == 200)
    assert "Traceback" not in server.log


def test_the_previous_model_is_served_if_the_newest_has_a_flipped_bit(server: ServerProcess, client: httpx.Client):
    view = client.get(f"/v1/surrogates/{NAME}").json()
    newest, said = view["model_version"], {"coordinates": [[0.3, -0.2]], "action": [[0.7]]}
    flip(server.folder / "surrogym.db", "models", "blob")
    exported = client.get(f"/v1/surrogates/{NAME}/models/{newest}?format=safetensors")
    assert (exported.status_code, exported.json()["code"]) == (500, "damaged")
    assert f"model {newest} of '{NAME}' has changed" in exported.json()["detail"]
    predicted = client.post(f"/v1/surrogates/{NAME}/predict", json=said)
    assert predicted.raise_for_status().json()["model_version"] == newest - 1
    assert client.get(f"/v1/surrogates/{NAME}").json()["model_version"] == newest - 1
    assert f"ERROR surrogym_server.services.models: model {newest} of {NAME} is set aside" in server.log


def test_damaged_database_pages_end_the_start_with_repair_instructions(database: Path, tmp_path: Path):
    file = Path(shutil.copy(database, tmp_path))
    content = bytearray(file.read_bytes())
    content[4096:8192] = bytes(4096)
    file.write_bytes(content)
    file.chmod(0o600)  # or a line of its own would say that others may read it
    line = refusal(tmp_path, "--port", "0", "--database", str(file))
    assert line.startswith("error: the database is damaged: ")
    assert f"sqlite3 {file} .recover" in line
