"""Storage: its abstract interface, and implementations for SQLite and PostgreSQL."""
