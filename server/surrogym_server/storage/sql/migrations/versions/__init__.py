"""Migrations of the schema, one file each. A released migration must never change."""
