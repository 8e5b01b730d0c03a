"""Alembic's scripts; ``surrogym_server.storage.sql.migrate`` runs them."""
