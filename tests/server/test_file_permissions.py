"""Files that hold secrets: a new database is its owner's alone, and what others may read is said at start."""

from __future__ import annotations

import logging
import os
import stat
from pathlib import Path

import pytest

from support.server import running_server
from surrogym_server.file_permissions import keep_private
from surrogym_server.settings import read_settings


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def started(folder: Path, **options: object) -> None:
    keep_private(read_settings({}, database=str(folder / "surrogym.db"), **options))


def test_a_new_database_and_its_side_files_are_readable_by_their_owner_only(tmp_path: Path):
    tokens = tmp_path / "tokens"
    tokens.write_text("train:a-long-token\n")
    tokens.chmod(0o644)
    before = os.umask(0o022)
    try:
        with running_server(tmp_path, "--token-file", str(tokens)) as server:
            modes = {path.name: mode(path) for path in tmp_path.glob("surrogym.db*") if ".lock" not in path.name}
            assert modes == dict.fromkeys(("surrogym.db", "surrogym.db-wal", "surrogym.db-shm"), 0o600)
    finally:
        os.umask(before)
    (line,) = (line for line in server.log.splitlines() if "other users" in line)
    assert line.startswith("WARNING surrogym_server.file_permissions: ")
    assert f"{tokens} may be read by other users of this machine (mode 644): chmod 600 {tokens} prevents this" in line


@pytest.mark.parametrize("permissions", [0o644, 0o640, 0o604])
def test_a_database_readable_by_others_is_warned_about_and_not_changed(tmp_path: Path, caplog, permissions: int):
    (tmp_path / "surrogym.db").touch()
    (tmp_path / "surrogym.db").chmod(permissions)
    started(tmp_path)
    assert mode(tmp_path / "surrogym.db") == permissions
    (record,) = caplog.records
    assert f"surrogym.db may be read by other users of this machine (mode {permissions:o})" in record.getMessage()


@pytest.mark.parametrize("field", ["token_file", "tls_key"])
def test_other_secret_files_readable_by_others_are_warned_about(tmp_path: Path, caplog, field: str):
    secret, certificate = tmp_path / "secret", tmp_path / "certificate"
    secret.write_text("a-long-token")
    certificate.touch()
    options = {field: secret} | ({"tls_certificate": certificate} if field == "tls_key" else {})
    secret.chmod(0o600)
    started(tmp_path, **options)
    assert not caplog.records
    secret.chmod(0o644)
    started(tmp_path, **options)
    assert [str(secret) in record.getMessage() for record in caplog.records] == [True]


@pytest.mark.parametrize("database", ["postgresql://user@host/name", "sqlite:///:memory:", "no://thing", "://"])
def test_no_file_is_created_for_databases_other_than_sqlite_files(database: str, tmp_path: Path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    keep_private(read_settings({}, database=database))
    assert list(tmp_path.iterdir()) == []
    assert not caplog.records


def test_a_database_in_a_new_folder_is_announced_once_and_readable_by_its_owner_only(tmp_path: Path, caplog):
    caplog.set_level(logging.INFO)
    database = tmp_path / "a" / "b" / "surrogym.db"
    for _ in range(2):
        keep_private(read_settings({}, database=f"sqlite:///{database}"))
    assert mode(database) == 0o600
    assert [record.getMessage() for record in caplog.records] == [f"{database} is a new, empty database"]
