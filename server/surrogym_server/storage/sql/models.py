"""Models by version, versions and aliases of policies,
and saved sessions."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import msgspec
import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from surrogym_server.errors import NoModel, UnknownModel, UnknownPolicy
from surrogym_server.storage.records import ModelRecord, NewModel, SavedSession
from surrogym_server.storage.sql.database import Database, conflict_insert, damaged
from surrogym_server.storage.sql.rows import NAMELESS, Span, append_event, checksum, find, hold, touch, within
from surrogym_server.storage.sql.tables import models, policies, policy_aliases, policy_evaluations
from surrogym_server.storage.sql.tables import sessions as saved

LATEST = "latest"  # reserved alias of the newest policy

COLUMNS = [
    getattr(models.c, name)
    for name in ("version", "created_at", "samples", "data_hash", "fidelity", "description", "fit_seconds")
]
INTACT = models.c.damage.is_(None)


class _Judged(msgspec.Struct):
    confidence_index: float


_JUDGED = msgspec.json.Decoder(_Judged)


class Models:
    """The storage of models, which have versions 1, 2, ... As an argument, version None stands for the newest version
    that is not marked as damaged."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def list(self, name: str) -> list[ModelRecord]:
        """Return the records of all models of a surrogate, oldest first."""
        with self._database.read() as connection:
            own = models.c.surrogate_id == find(connection, name)
            rows = connection.execute(sa.select(*COLUMNS).where(own).order_by(models.c.version))
            return [ModelRecord(**row._mapping) for row in rows]

    def get(self, name: str, version: int | None = None) -> ModelRecord:
        """Return the record of a model; of the newest undamaged one if ``version`` is None.

        Raises:
            UnknownModel: the surrogate has no model of this version.
            NoModel: ``version`` is None, and the surrogate has no undamaged model.
        """
        with self._database.read() as connection:
            return ModelRecord(**_one(connection, name, version, *COLUMNS)._mapping)

    def newest(self) -> dict[int, int]:
        """Return the newest undamaged model version of each surrogate that has one, by the surrogate's id."""
        with self._database.read() as connection:
            newest = sa.select(models.c.surrogate_id, sa.func.max(models.c.version))
            statement = newest.where(INTACT, models.c.surrogate_id.not_in(NAMELESS)).group_by(models.c.surrogate_id)
            return {int(surrogate): int(version) for surrogate, version in connection.execute(statement)}

    def blob(self, name: str, version: int | None = None) -> bytes:
        """Return the stored file of a model; of the newest undamaged one if ``version`` is None.

        Raises:
            UnknownModel, NoModel: there is no such model.
            Damaged: the file differs from the one that was stored.
        """
        with self._database.read() as connection:
            row = _one(connection, name, version, models.c.version, models.c.blob, models.c.checksum)
        if checksum(row.blob) != row.checksum:
            raise damaged(
                f"model {row.version} of {name!r} has changed since it was stored, as its checksum shows; restore a "
                "copy of the database"
            )
        return bytes(row.blob)

    def set_aside(self, name: str, version: int, damage: str) -> bool:
        """Mark a model version as damaged, so that the version before it is used instead, and a fit becomes due.

        ``damage`` describes the damage. Returns False if the version was marked before. The number of the version is
        not used again.
        """
        with self._database.write() as connection:
            surrogate = hold(connection, name)
            own = (models.c.surrogate_id == surrogate.id) & (models.c.version == version) & INTACT
            if not connection.execute(sa.update(models).where(own).values(damage=damage)).rowcount:
                return False
            append_event(connection, surrogate, "damaged", version=version, error=damage)
            touch(connection, surrogate)
            return True

    def add(self, name: str, model: NewModel) -> int:
        """Store an imported model as the newest version, and return its version. The design is not changed."""
        with self._database.write() as connection:
            return insert_model(connection, hold(connection, name), model)


def newest_of(connection: Connection, span: Span) -> dict[int, tuple[int, float]]:
    """Return version and confidence index of the newest undamaged model of each surrogate in a range of ids, by id."""
    latest = sa.select(models.c.surrogate_id, sa.func.max(models.c.version).label("version"))
    newest = latest.where(within(models, span), INTACT).group_by(models.c.surrogate_id).subquery()
    same = (models.c.surrogate_id == newest.c.surrogate_id) & (models.c.version == newest.c.version)
    fidelity = sa.type_coerce(models.c.fidelity, sa.Text)
    rows = connection.execute(sa.select(models.c.surrogate_id, models.c.version, fidelity).join(newest, same)).all()
    return {surrogate: (version, _confidence_index(fidelity)) for surrogate, version, fidelity in rows}


def insert_model(connection: Connection, surrogate: Row[Any], model: NewModel) -> int:
    """Store a model as the newest version, and return its version.

    The caller must have locked the surrogate (``rows.hold``), so that versions have no gaps.
    """
    newest = sa.select(sa.func.max(models.c.version)).where(models.c.surrogate_id == surrogate.id)
    version = (connection.execute(newest).scalar() or 0) + 1
    connection.execute(
        sa.insert(models).values(
            surrogate_id=surrogate.id,
            version=version,
            created_at=surrogate.now,
            samples=model.samples,
            data_hash=model.data_hash,
            fidelity=model.fidelity,
            description=model.description,
            fit_seconds=model.fit_seconds,
            blob=model.blob,
            checksum=checksum(model.blob),
        )
    )
    fields = {"samples": model.samples, "fit_seconds": model.fit_seconds, "fidelity": model.fidelity}
    append_event(connection, surrogate, "fit", version=version, **fields)
    return version


def _confidence_index(fidelity: str) -> float:
    """Return the confidence index in a stored fidelity (JSON). Parsing all its fields would take ten times as long."""
    try:
        return _JUDGED.decode(fidelity).confidence_index
    except msgspec.DecodeError:  # the JSON may contain NaN, which only Python's parser reads
        try:
            return float(json.loads(fidelity)["confidence_index"])
        except (ValueError, KeyError, TypeError) as error:
            raise damaged(
                f"the confidence index of a model can't be read: {error!r}; restore a copy of the database"
            ) from error


def _one(connection: Connection, name: str, version: int | None, *columns: sa.ColumnElement[Any]) -> Row[Any]:
    statement = sa.select(*columns).where(models.c.surrogate_id == find(connection, name))
    statement = statement.where(INTACT if version is None else models.c.version == version)
    row = connection.execute(statement.order_by(models.c.version.desc()).limit(1)).one_or_none()
    if row is not None:
        return row
    if version is None:
        raise NoModel(f"expected a model of {name!r}, but no model has been fitted yet: start surrogym sample")
    raise UnknownModel(
        f"expected a version of the models of {name!r}, got {version}, which does not exist: "
        "leave out the version for the newest model"
    )


class PolicyNames:
    """Versions and aliases of policies, which several features read. The feature ``policies`` stores them."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def version(self, name: str, which: str) -> int:
        """Return the policy version that ``which`` names: a number, an alias, or ``latest``. Raises
        ``UnknownPolicy``."""
        with self._database.read() as connection:
            return resolve(connection, find(connection, name), name, which)

    def has_evaluation(self, name: str, version: int, id: int) -> bool:
        """Return whether a policy has an evaluation with this id. Raises ``UnknownPolicy`` if there is no such
        version."""
        table = policy_evaluations
        with self._database.read() as connection:
            surrogate = find(connection, name)
            require_version(connection, surrogate, name, version)
            own = sa.select(table.c.id).where(table.c.surrogate_id == surrogate, table.c.version == version)
            return connection.execute(own.where(table.c.id == id)).scalar() is not None


def resolve(connection: Connection, surrogate: int, name: str, which: str) -> int:
    """Return the policy version that ``which`` names: a number, an alias or ``latest``.

    ``surrogate`` is the surrogate's id, ``name`` its name. Raises ``UnknownPolicy``.
    """
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
    return UnknownPolicy(
        f"expected a version or an alias of the policies of {name!r}, got {which}, which does not exist: surrogym "
        "policies lists them"
    )


class Sessions:
    """The storage of sessions that a server saves at shutdown and restores at the next start."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def save(self, sessions: Sequence[SavedSession]) -> None:
        """Store sessions. A stored session with the same id is replaced."""
        rows = [{"id": one.id, "surrogate": one.surrogate, "data": one.data} for one in sessions]
        if not rows:
            return
        with self._database.write() as connection:
            insert = conflict_insert(connection, saved)
            values = {"surrogate": insert.excluded.surrogate, "data": insert.excluded.data}
            connection.execute(insert.on_conflict_do_update(index_elements=["id"], set_=values), rows)

    def take(self) -> list[SavedSession]:
        """Return all saved sessions and remove them from the storage, so that each is restored once."""
        with self._database.write() as connection:
            rows = connection.execute(sa.delete(saved).returning(*saved.c)).all()
        return [SavedSession(row.id, row.surrogate, bytes(row.data)) for row in rows]
