"""One server per SQLite file: a lock beside it that ends with whoever holds it, however they end."""

from __future__ import annotations

import sqlite3
from pathlib import Path

from surrogym_server.errors import Unavailable


class FileLock:
    """Held from construction to ``close`` or the end of the process; never inherited by a child process.

    It is SQLite's own exclusive lock on an empty database beside the real one: as portable as SQLite is.

    Raises:
        Unavailable: another server holds it, or the folder can't be written.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._connection = sqlite3.connect(path, timeout=0, isolation_level=None, check_same_thread=False)
        except sqlite3.OperationalError as error:
            raise Unavailable(f"expected a folder to write the database to, got {path.parent}: {error}") from None
        try:
            self._connection.execute("BEGIN EXCLUSIVE")
        except sqlite3.OperationalError as error:
            self._connection.close()
            raise Unavailable(
                f"expected to be the only server on this database, but {path} can't be locked: {error}"
            ) from None

    def close(self) -> None:
        self._connection.close()
