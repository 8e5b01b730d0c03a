"""Migrations of the schema, a file each. A migration never changes after its release."""
