"""Migration of a database to this program's schema when it is opened."""

from __future__ import annotations

from pathlib import Path

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from surrogym_server.errors import Unavailable
from surrogym_server.storage.sql.damage import damaged
from surrogym_server.storage.sql.database import Database

SCRIPTS = Path(__file__).parent / "migrations"
VERSION = sa.table("alembic_version", sa.column("version_num", sa.Text))
MIGRATION_LOCK = 0x5355_5252  # one server migrates at a time; any number will do


def migrate(database: Database) -> None:
    """Run the missing migrations.

    Raises:
        Unavailable: the database was written by a newer program, or by an unreleased one.
        Damaged: no program has ever made its schema.
    """
    revisions = [script.name[1:5] for script in sorted(SCRIPTS.glob("versions/r*.py"))]
    with database.write() as connection:
        _take_turn(connection)
        present = _present(connection)
        _refuse_others(present, revisions)
        if present != revisions[-1:]:
            _upgrade(connection)


def _present(connection: Connection) -> list[str]:
    """Return the schema's revisions: one; none in a new database; several if somebody has changed the table."""
    if not sa.inspect(connection).has_table(VERSION.name):
        return []
    return list(connection.execute(sa.select(VERSION.c.version_num)).scalars())


def _upgrade(connection: Connection) -> None:
    from alembic import command  # late: it takes a fifteenth of a server's start, and most schemas are up to date
    from alembic.config import Config
    from alembic.util import CommandError

    config = Config(attributes={"connection": connection})
    config.set_main_option("script_location", str(SCRIPTS).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    try:
        command.upgrade(config, "head")
    except CommandError as error:  # the database's record of its own schema is invalid
        raise damaged(error) from error


def _take_turn(connection: Connection) -> None:
    if connection.dialect.name == "postgresql":
        connection.execute(sa.text("SET LOCAL lock_timeout = 0"))  # another migration may take long
        connection.execute(sa.text("SET LOCAL idle_in_transaction_session_timeout = 0"))  # it may pause to compute
        connection.execute(sa.select(sa.func.pg_advisory_xact_lock(MIGRATION_LOCK)))


def _refuse_others(present: list[str], revisions: list[str]) -> None:
    unknown = sorted(map(str, set(present) - set(revisions)))
    if unknown and max(unknown) < revisions[0]:
        raise Unavailable(
            f"the database was written by an unreleased Surrogym: its schema is {', '.join(unknown)}, "
            f"the first released one is {revisions[0]}; export its samples with that version, or begin anew with "
            "another --database"
        )
    if unknown:
        raise Unavailable(
            f"the database was written by a newer Surrogym: its schema is {', '.join(unknown)}, this program knows "
            f"schemas up to {revisions[-1]}; start the newer program"
        )
