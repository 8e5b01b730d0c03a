"""The SQL adapters of the storage port for SQLite and PostgreSQL, which share their statements."""

from surrogym_server.storage.sql.storage import SqlStorage, open_storage

__all__ = ["SqlStorage", "open_storage"]
