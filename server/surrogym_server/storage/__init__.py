"""Storage: the port, and adapters for SQLite and PostgreSQL."""
