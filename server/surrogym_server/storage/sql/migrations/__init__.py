"""Migrations of the database's schema as Alembic scripts, which ``storage.sql.storage.migrate`` runs."""
