"""Storage in SQLite or PostgreSQL, and the records that it takes and returns."""
