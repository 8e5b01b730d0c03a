"""The SQL adapters of the storage port: SQLite and PostgreSQL, by one set of statements."""

from surrogym_server.storage.sql.storage import SqlStorage, open_storage

__all__ = ["SqlStorage", "open_storage"]
