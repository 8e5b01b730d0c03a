"""Storage of blobs (contents of policy files) as files in a folder or as rows of a table.

With a SQLite database, which has one server, blobs are files in a folder beside it. Several servers may share a
PostgreSQL database but no disk, so there blobs are rows of a table, which a backup may leave out.
"""

from __future__ import annotations

import os
import re
import time
from contextlib import suppress
from pathlib import Path
from uuid import uuid4

import sqlalchemy as sa

from surrogym_server.errors import Unavailable
from surrogym_server.features.policies.records import Blobs, Freed
from surrogym_server.storage.sql import Storage
from surrogym_server.storage.sql.database import NOW, Database, damaged
from surrogym_server.storage.sql.tables import checked, metadata

blobs = checked(
    sa.Table(  # contents of files, if they are not in a folder; a backup may leave this table out
        "blobs",
        metadata,
        sa.Column("name", sa.Text, primary_key=True),
        sa.Column("created_at", sa.Double, nullable=False),
        sa.Column("content", sa.LargeBinary, nullable=False),
    )
)

NAME = re.compile(r"[0-9a-f]{32}")
PART = ".part"  # suffix of the name of a file that is being written


def open_blobs(storage: Storage, url: str, folder: Path | None) -> Blobs:
    """Open the storage of policy files.

    Args:
        storage: storage of the server.
        url: address of its database.
        folder: folder for the files. None: the folder ``<database>.files`` beside a SQLite file, or a table of a
            PostgreSQL database.
    """
    address = sa.make_url(url)
    if folder is None and address.get_backend_name() == "sqlite":
        folder = Path(f"{address.database}.files")
    return storage.part(RowBlobs) if folder is None else FolderBlobs(folder)


class FolderBlobs(Blobs):
    """Storage of policy files in a folder, which is created with the first file. Only the files' owner may read
    them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def put(self, content: bytes) -> str:
        name = uuid4().hex
        part = self._folder / f"{name}{PART}"
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with open(os.open(part, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            part.rename(self._folder / name)
            self._sync()
        except OSError as error:
            with suppress(OSError):
                part.unlink()
            raise Unavailable(
                f"a file can't be stored in {self._folder} now: {error.strerror}; free space, then send it again"
            ) from error
        return name

    def get(self, name: str) -> bytes:
        try:
            return (self._folder / _checked(name)).read_bytes()
        except OSError as error:
            raise damaged(
                f"a file of a policy can't be read from {self._folder}: {error.strerror}; restore it from a backup"
            ) from error

    def remove(self, names: Freed) -> None:
        for name in names:
            with suppress(OSError):  # a file that can't be removed now is removed by the next periodic sweep
                (self._folder / _checked(name)).unlink()

    def older(self, seconds: float) -> set[str]:
        begun = time.time() - seconds
        found = set()
        with suppress(FileNotFoundError):
            for entry in os.scandir(self._folder):
                with suppress(FileNotFoundError):
                    if entry.stat().st_mtime < begun and NAME.fullmatch(entry.name.removesuffix(PART)):
                        found.add(entry.name)
        return found

    def _sync(self) -> None:
        """Sync the folder, so that a renamed file survives a crash."""
        descriptor = os.open(self._folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


class RowBlobs(Blobs):
    """Storage of policy files as rows of the table ``blobs``."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def put(self, content: bytes) -> str:
        name = uuid4().hex
        with self._database.write() as connection:
            row = sa.insert(blobs).values(name=name, created_at=NOW, content=content)
            connection.execute(row)
        return name

    def get(self, name: str) -> bytes:
        with self._database.read() as connection:
            content = connection.execute(sa.select(blobs.c.content).where(blobs.c.name == name)).scalar()
        if content is None:
            raise damaged(f"the file {name} of a policy is missing in the table blobs: restore it from a backup")
        return bytes(content)

    def remove(self, names: Freed) -> None:
        if not names:
            return
        with self._database.write() as connection:
            connection.execute(sa.delete(blobs).where(blobs.c.name.in_(names)))

    def older(self, seconds: float) -> set[str]:
        with self._database.read() as connection:
            old = blobs.c.created_at < NOW - seconds
            return set(connection.execute(sa.select(blobs.c.name).where(old)).scalars())


def _checked(name: str) -> str:
    if not NAME.fullmatch(name.removesuffix(PART)):
        raise damaged(
            f"expected the name of a stored file (blob), 32 hexadecimal digits, got {name!r}; restore a copy of the "
            "database"
        )
    return name
