"""Adapter of ``PolicyNames``: versions and aliases of policies."""

from __future__ import annotations

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from surrogym_server.errors import UnknownPolicy
from surrogym_server.storage import port
from surrogym_server.storage.port import LATEST
from surrogym_server.storage.sql.database import Database
from surrogym_server.storage.sql.rows import find
from surrogym_server.storage.sql.tables import policies, policy_aliases, policy_evaluations


class SqlPolicyNames(port.PolicyNames):
    def __init__(self, database: Database) -> None:
        self._database = database

    def version(self, name: str, which: str) -> int:
        with self._database.read() as connection:
            return resolve(connection, find(connection, name), name, which)

    def has_evaluation(self, name: str, version: int, id: int) -> bool:
        table = policy_evaluations
        with self._database.read() as connection:
            surrogate = find(connection, name)
            require_version(connection, surrogate, name, version)
            own = sa.select(table.c.id).where(table.c.surrogate_id == surrogate, table.c.version == version)
            return connection.execute(own.where(table.c.id == id)).scalar() is not None


def resolve(connection: Connection, surrogate: int, name: str, which: str) -> int:
    """The version that a version, an alias or ``latest`` means. Raises ``UnknownPolicy``."""
    if which.isascii() and which.isdecimal() and len(which) < 10:
        require_version(connection, surrogate, name, int(which))
        return int(which)
    if which == LATEST:
        statement = sa.select(sa.func.max(policies.c.version)).where(policies.c.surrogate_id == surrogate)
    else:
        aliases = policy_aliases.c
        statement = sa.select(aliases.version).where(aliases.surrogate_id == surrogate, aliases.alias == which)
    version = connection.execute(statement).scalar()
    if version is None:
        raise unknown_policy(name, which)
    return int(version)


def require_version(connection: Connection, surrogate: int, name: str, version: int) -> None:
    """Raise ``UnknownPolicy`` if the surrogate has no policy of this version."""
    own = (policies.c.surrogate_id == surrogate) & (policies.c.version == version)
    if connection.execute(sa.select(policies.c.version).where(own)).scalar() is None:
        raise unknown_policy(name, version)


def unknown_policy(name: str, which: object) -> UnknownPolicy:
    return UnknownPolicy(f"expected a version or an alias of {name!r}'s policies, got {which}, which does not exist")
