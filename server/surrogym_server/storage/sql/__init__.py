"""Storage in SQLite and PostgreSQL, which share their SQL statements."""

from surrogym_server.storage.sql.storage import Storage, open_storage

__all__ = ["Storage", "open_storage"]
