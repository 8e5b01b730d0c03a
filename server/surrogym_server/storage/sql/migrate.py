"""Bring a database to this program's schema when it is opened."""

from __future__ import annotations

from pathlib import Path

import sqlalchemy as sa
from alembic import command
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from alembic.util import CommandError
from sqlalchemy.engine import Connection

from surrogym_server.errors import Unavailable
from surrogym_server.storage.sql.damage import damaged
from surrogym_server.storage.sql.database import Database

SCRIPTS = Path(__file__).parent / "migrations"
MIGRATION_LOCK = 0x5355_5252  # one server migrates at a time; any number will do


def migrate(database: Database) -> None:
    """Run the migrations that are missing.

    Raises:
        Unavailable: the database was written by a newer program.
        Damaged: its schema is none that a program ever made.
    """
    config = Config()
    config.set_main_option("script_location", str(SCRIPTS).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    script = ScriptDirectory.from_config(config)
    with database.write() as connection:
        _take_turn(connection)
        present = MigrationContext.configure(connection).get_current_heads()
        _refuse_newer(present, script)
        if set(present) != set(script.get_heads()):
            config.attributes["connection"] = connection
            try:
                command.upgrade(config, "head")
            except CommandError as error:  # what the database says of its own schema makes no sense
                raise damaged(error) from error


def _take_turn(connection: Connection) -> None:
    if connection.dialect.name == "postgresql":
        connection.execute(sa.text("SET LOCAL lock_timeout = 0"))  # the one before may take its time
        connection.execute(sa.select(sa.func.pg_advisory_xact_lock(MIGRATION_LOCK)))


def _refuse_newer(present: tuple[str, ...], script: ScriptDirectory) -> None:
    known = {revision.revision for revision in script.walk_revisions()}
    unknown = sorted(set(present) - known)
    if unknown:
        raise Unavailable(
            f"the database is of a newer Surrogym: its schema is {', '.join(unknown)}, this program knows "
            f"schemas up to {', '.join(script.get_heads())}; start the newer program"
        )
