"""Permissions of files with secrets: the database, the file of tokens, the TLS key."""

from __future__ import annotations

import logging
import os
from contextlib import suppress
from pathlib import Path

import sqlalchemy as sa

from surrogym_server.settings import Settings
from surrogym_shared.secret_files import open_to_others

logger = logging.getLogger(__name__)


def keep_private(settings: Settings) -> None:
    """Create a missing SQLite file that only its owner can read, and log a warning for each secret file that others can
    read: database, token file and TLS key.

    SQLite gives the files ``-wal`` and ``-shm`` beside a database its file mode. An existing database keeps its mode.
    """
    database = _sqlite_file(settings.database_url)
    if database is not None:
        with suppress(OSError):  # raised if the file exists; other errors come again when the database is opened
            database.parent.mkdir(parents=True, exist_ok=True)
            os.close(os.open(database, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
            logger.info("%s is a new, empty database", database)
    for path in (database, settings.token_file, settings.tls_key):
        if path is not None and (warning := open_to_others(path)):
            logger.warning(warning)


def _sqlite_file(url: str) -> Path | None:
    try:
        parsed = sa.make_url(url)
    except sa.exc.ArgumentError:
        return None  # the address is invalid, which is reported when the database is opened
    is_file = parsed.get_backend_name() == "sqlite" and parsed.database not in (None, "", ":memory:")
    return Path(str(parsed.database)) if is_file else None
