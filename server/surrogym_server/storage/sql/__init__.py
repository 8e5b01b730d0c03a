"""Implementation of the storage interface for SQLite and PostgreSQL, which share their SQL statements."""

from surrogym_server.storage.sql.storage import SqlStorage, open_storage

__all__ = ["SqlStorage", "open_storage"]
