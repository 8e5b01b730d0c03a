"""The tables of the database. Vectors are little-endian float64 bytes, which keeps all bits; JSON is text.

Rows of a surrogate are deleted with it (``ON DELETE CASCADE``). Ids are never used twice. An optional feature defines
the tables that only it reads in its own folder, with the same ``metadata``. Other parts read the policies and priors.
"""

from __future__ import annotations

import json
import reprlib
import struct
from typing import Any, get_args

import numpy as np
import sqlalchemy as sa
from sqlalchemy.engine import Dialect

from surrogym_server.storage.records import Array
from surrogym_server.storage.sql.database import damaged
from surrogym_shared.nouns import Vector
from surrogym_shared.states import EventKind, Phase, Purpose, QueryKind, QueryStatus, SamplePurpose

metadata = sa.MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "fk": "fk_%(table_name)s_%(column_0_name)s",
        "pk": "pk_%(table_name)s",
    }
)

AT_ONCE = "at once"  # key in the ``info`` of tables whose rows are removed in the first transaction of a deletion

Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


class Floats(sa.types.TypeDecorator[Vector]):
    """Column type of a vector of float64, stored as bytes."""

    impl = sa.LargeBinary
    cache_ok = True

    def process_bind_param(
        self,
        value: Vector | Array | None,
        dialect: Dialect,  # noqa: ARG002
    ) -> bytes | None:
        return None if value is None else np.asarray(value, dtype="<f8").tobytes()

    def process_result_value(self, value: bytes | None, dialect: Dialect) -> Vector | None:  # noqa: ARG002
        try:
            return None if value is None else struct.unpack(f"<{len(value) // 8}d", value)
        except (TypeError, struct.error) as error:
            raise damaged(
                f"expected a vector of float64 in a column of the database, got other bytes: {error}; "
                "restore a copy of it"
            ) from error


class Json(sa.types.TypeDecorator[Any]):
    """Column type of any JSON value, stored as text. ``place`` is the name of table and column for error messages."""

    impl = sa.Text
    cache_ok = True

    def __init__(self, place: str) -> None:
        super().__init__()
        self.place = place

    def process_bind_param(self, value: Any, dialect: Dialect) -> str:  # noqa: ARG002
        return json.dumps(value)

    def process_result_value(self, value: str | None, dialect: Dialect) -> Any:  # noqa: ARG002
        try:
            return None if value is None else json.loads(value)
        except (TypeError, ValueError) as error:
            raise damaged(
                f"expected JSON in {self.place}, got {reprlib.repr(value)}: {error}; restore a copy of the database"
            ) from error


class Word(sa.types.TypeDecorator[str]):
    """Column type of text that is one of the words of a ``Literal``.

    ``place`` is the name of table and column for error messages.
    """

    impl = sa.Text
    cache_ok = True

    def __init__(self, place: str, literal: Any) -> None:
        super().__init__()
        self.place = place
        self.words = get_args(literal)

    def process_result_value(self, value: str | None, dialect: Dialect) -> str | None:  # noqa: ARG002
        if value is not None and value not in self.words:
            raise damaged(
                f"expected one of {list(self.words)} in {self.place}, got {reprlib.repr(value)}; "
                "restore a copy of the database"
            )
        return value


PLAIN: dict[type[sa.types.TypeEngine[Any]], tuple[str, tuple[type, ...]]] = {
    sa.Integer: ("a whole number", (int,)),
    sa.BigInteger: ("a whole number", (int,)),
    sa.Double: ("a number", (int, float)),
    sa.Text: ("text", (str,)),
}


class Checked(sa.types.TypeDecorator[Any]):
    """Column type of numbers or text that checks the type of each value when it is read.

    SQLite stores values of any type in any column, so a damaged file may contain a value of a wrong type.
    """

    impl = sa.Text
    cache_ok = True

    def __init__(self, place: str, impl: sa.types.TypeEngine[Any]) -> None:
        super().__init__()
        self.place = place
        self.impl = impl  # type: ignore[assignment]  # SQLAlchemy's stubs have the class, an object has an instance
        self.expected, self.types = PLAIN[type(impl)]

    def process_result_value(self, value: Any, dialect: Dialect) -> Any:  # noqa: ARG002
        if value is not None and not isinstance(value, self.types):
            raise damaged(
                f"expected {self.expected} in {self.place}, got {reprlib.repr(value)}; restore a copy of the database"
            )
        return value


def checked(table: sa.Table) -> sa.Table:
    """Replace the types of a table's plain columns by ``Checked``, so that values are checked when they are read.

    Returns the table. Columns of ids are not checked. ``Floats``, ``Json`` and ``Word`` check their values themselves.
    """
    for column in table.columns:
        if type(column.type) in PLAIN and column.type is not Id:
            column.type = Checked(f"{table.name}.{column.name}", column.type)
    return table


def row_id() -> sa.Column[int]:
    """Return the column ``id`` of a table, its primary key."""
    return sa.Column("id", Id, primary_key=True, autoincrement=True)


def owner(**options: Any) -> sa.Column[int]:
    """Return the column ``surrogate_id`` of a table, a foreign key to the surrogate to which a row belongs. Rows are
    deleted with their surrogate."""
    key = sa.ForeignKey("surrogates.id", ondelete="CASCADE")
    return sa.Column("surrogate_id", Id, key, nullable=False, **options)


surrogates = sa.Table(
    "surrogates",
    metadata,
    row_id(),
    sa.Column("name", sa.Text, nullable=False, unique=True),
    sa.Column("spec", Json("surrogates.spec"), nullable=False),
    sa.Column("budget", sa.Integer, nullable=False),
    sa.Column("target", sa.Double, nullable=False),
    sa.Column("tolerances", Json("surrogates.tolerances"), nullable=False, server_default="{}"),
    sa.Column("phase", Word("surrogates.phase", Phase), nullable=False),
    sa.Column("paused", sa.Boolean, nullable=False),
    sa.Column("round", sa.Integer, nullable=False),
    sa.Column("state", Json("surrogates.state"), nullable=False),
    sa.Column("error", sa.Text),
    sa.Column("extra_queries", sa.Integer, nullable=False),
    sa.Column("checkpoint", sa.Text),
    sa.Column("revision", sa.BigInteger, nullable=False),  # increases with each change that makes a fit due
    # Number of changes (``revision``) of the surrogate up to which its last fit read the data.
    sa.Column("fitted_revision", sa.BigInteger, nullable=False),
    # Number of changes (``revision``) with which the last log was complete; ``revision`` + 1 while a log is incomplete.
    # Pending or leased queries don't delay the fit of a new log.
    sa.Column("logged_revision", sa.BigInteger, nullable=False, server_default="0"),
    sa.Column("fit_token", sa.Text),
    sa.Column("fit_owner", sa.Text),
    sa.Column("fit_expires", sa.Double),
    sa.Column("fit_seconds", sa.Double),  # duration of the last lease of a fit
    sa.Column("policy_versions", sa.Integer, nullable=False, server_default="0"),  # number of policy versions ever used
    sa.Column("created_at", sa.Double, nullable=False),
    sqlite_autoincrement=True,
)

queries = sa.Table(
    "queries",
    metadata,
    row_id(),
    owner(),
    sa.Column("purpose", Word("queries.purpose", Purpose), nullable=False),
    sa.Column("status", Word("queries.status", QueryStatus), nullable=False),
    sa.Column("round", sa.Integer, nullable=False),
    sa.Column("kind", Word("queries.kind", QueryKind), nullable=False, server_default="step"),
    sa.Column("coordinates", Floats, nullable=False),  # state at which the query's step begins; empty for a rollout
    sa.Column("action", Floats, nullable=False),  # all actions of a rollout, concatenated
    sa.Column("steps", sa.Integer, nullable=False, server_default="1"),
    sa.Column("snapshot", sa.Text),  # name of the snapshot at which a rollout begins; NULL: a reset
    sa.Column(
        "replan", sa.Boolean, nullable=False, server_default=sa.false()
    ),  # whether the sampler plans actions anew
    sa.Column("policy", sa.LargeBinary),  # file of the policy that chooses the actions of a trial; NULL: no trial
    # Whether the query was chosen only because ``improve`` requested more.
    sa.Column("extra", sa.Boolean, nullable=False, server_default=sa.false()),
    sa.Column("attempts", sa.Integer, nullable=False),
    sa.Column("sampler", sa.Text),
    sa.Column("error", sa.Text),
    sa.Index(None, "surrogate_id", "status", "id"),
    sqlite_autoincrement=True,
)

leases = sa.Table(
    "leases",
    metadata,
    row_id(),
    owner(),
    sa.Column("query_id", Id, sa.ForeignKey("queries.id", ondelete="CASCADE"), nullable=False, index=True),
    sa.Column("token", sa.Text, nullable=False, unique=True),
    sa.Column("sampler", sa.Text, nullable=False),
    sa.Column("attempt", sa.Integer, nullable=False),
    sa.Column("begun", sa.Double, nullable=False),
    sa.Column("expires", sa.Double, nullable=False),
    sa.Column("seconds", sa.Double, nullable=False, server_default="0"),  # duration of the lease at its last renewal
    # "open", or how the lease ended: answered, failed, unbegun, refused, expired.
    sa.Column("outcome", sa.Text, nullable=False),
    sa.Index(None, "surrogate_id", "outcome", "expires"),
    sa.Index(  # unique, so that a query has at most one open lease
        "uq_leases_open",
        "query_id",
        unique=True,
        sqlite_where=sa.text("outcome = 'open'"),
        postgresql_where=sa.text("outcome = 'open'"),
    ),
    sqlite_autoincrement=True,
)

samples = sa.Table(
    "samples",
    metadata,
    row_id(),
    owner(),
    sa.Column("query_id", Id, sa.ForeignKey("queries.id", ondelete="CASCADE"), index=True),
    sa.Column("lease_id", Id, sa.ForeignKey("leases.id", ondelete="CASCADE")),
    sa.Column("step", sa.Integer, nullable=False, server_default="0"),
    sa.Column("purpose", Word("samples.purpose", SamplePurpose), nullable=False),
    sa.Column("sampler", sa.Text, nullable=False),
    sa.Column("attempt", sa.Integer, nullable=False),
    sa.Column("late", sa.Boolean, nullable=False),
    # Whether an entry of a continuous action was at a bound; false for logged samples.
    sa.Column("at_bound", sa.Boolean, nullable=False, server_default=sa.false()),
    sa.Column("coordinates", Floats, nullable=False),
    sa.Column("action", Floats, nullable=False),
    sa.Column("next_coordinates", Floats, nullable=False),
    sa.Column("reward", sa.Double, nullable=False),
    sa.Column("terminated", sa.Boolean, nullable=False),
    sa.Column("truncated", sa.Boolean, nullable=False),
    sa.Column("observation", Floats),
    sa.Column("next_observation", Floats),
    sa.Column("seconds", sa.Double),  # since the end of the step before in the same rollout
    sa.Column("fingerprint", sa.Text, nullable=False),
    sa.Column("created_at", sa.Double, nullable=False),
    sa.UniqueConstraint("lease_id", "step"),
    sa.Index(None, "surrogate_id", "id"),
    sa.Index(None, "surrogate_id", "fingerprint"),
    sqlite_autoincrement=True,
)

snapshots = sa.Table(  # names and coordinates of snapshots (saved states) to which samplers can return
    "snapshots",
    metadata,
    row_id(),
    owner(),
    sa.Column("name", sa.Text, nullable=False),
    sa.Column("coordinates", Floats, nullable=False),
    sa.UniqueConstraint("surrogate_id", "name"),
    sqlite_autoincrement=True,
)

evaluations = sa.Table(
    "evaluations",
    metadata,
    row_id(),
    owner(index=True),
    sa.Column("steps", sa.BigInteger, nullable=False),
    sa.Column("episodes", sa.BigInteger, nullable=False),
    sa.Column("note", sa.Text, nullable=False),
    sa.Column("created_at", sa.Double, nullable=False),
    # how the episodes kept declared limits; NULL: without limits
    sa.Column("violations", sa.BigInteger),
    sa.Column("fallbacks", sa.BigInteger),
    sa.Column("fallback_episodes", sa.BigInteger),
    sqlite_autoincrement=True,
)

requests = sa.Table(  # results of requests by idempotency key
    "requests",
    metadata,
    owner(primary_key=True),
    sa.Column("operation", sa.Text, primary_key=True),
    sa.Column("key", sa.Text, primary_key=True),
    sa.Column("fingerprint", sa.Text, nullable=False),
    sa.Column("result", Json("requests.result"), nullable=False),
)

models = sa.Table(
    "models",
    metadata,
    owner(primary_key=True),
    sa.Column("version", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("created_at", sa.Double, nullable=False),
    sa.Column("samples", sa.Integer, nullable=False),
    sa.Column("data_hash", sa.Text, nullable=False),
    sa.Column("fidelity", Json("models.fidelity"), nullable=False),
    sa.Column("description", Json("models.description"), nullable=False),
    sa.Column("fit_seconds", sa.Double, nullable=False),
    sa.Column("blob", sa.LargeBinary, nullable=False),
    sa.Column("checksum", sa.Text, nullable=False, server_default=""),  # SHA-256 of the blob
    sa.Column("damage", sa.Text),  # description of damage that was found; NULL: none
)

priors = sa.Table(  # prior of a surrogate; if its blob (file of a model) is NULL, the design waits for the prior
    "priors",
    metadata,
    owner(primary_key=True),
    sa.Column("created_at", sa.Double, nullable=False),
    sa.Column("about", Json("priors.about"), nullable=False),
    sa.Column("blob", sa.LargeBinary),
    sa.Column("checksum", sa.Text, nullable=False),  # SHA-256 of the blob
)

occupancies = sa.Table(
    "occupancies",
    metadata,
    row_id(),
    owner(),
    sa.Column("checkpoint", sa.Text, nullable=False),
    sa.Column("round", sa.Integer, nullable=False),
    sa.Column("created_at", sa.Double, nullable=False),
    sa.Column("columns", sa.Integer, nullable=False),
    sa.Column("states", Floats, nullable=False),
    sa.UniqueConstraint("surrogate_id", "checkpoint"),
    sqlite_autoincrement=True,
)

sessions = sa.Table(
    "sessions",
    metadata,
    sa.Column("id", sa.Text, primary_key=True),
    sa.Column("surrogate", sa.Text, nullable=False),
    sa.Column("data", sa.LargeBinary, nullable=False),
)

events = sa.Table(
    "events",
    metadata,
    row_id(),
    owner(),
    sa.Column("kind", Word("events.kind", EventKind), nullable=False),
    sa.Column("created_at", sa.Double, nullable=False),
    sa.Column("body", Json("events.body"), nullable=False),
    sa.Index(None, "surrogate_id", "id"),
    sqlite_autoincrement=True,
)

policies = sa.Table(
    "policies",
    metadata,
    owner(primary_key=True),
    sa.Column("version", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("created_at", sa.Double, nullable=False),
    sa.Column("card", Json("policies.card"), nullable=False),
    sa.Column("curve", Json("policies.curve"), nullable=False),
)


def policy_key() -> sa.ForeignKeyConstraint:
    """Return the foreign key of a table to the policy to which a row belongs. Rows are deleted with their policy."""
    columns = ["surrogate_id", "version"]
    return sa.ForeignKeyConstraint(columns, [f"policies.{name}" for name in columns], ondelete="CASCADE")


policy_aliases = sa.Table(
    "policy_aliases",
    metadata,
    sa.Column("surrogate_id", Id, primary_key=True, autoincrement=False),
    sa.Column("alias", sa.Text, primary_key=True),
    sa.Column("version", sa.Integer, nullable=False),
    policy_key(),
)

policy_evaluations = sa.Table(
    "policy_evaluations",
    metadata,
    row_id(),
    sa.Column("surrogate_id", Id, nullable=False),
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("key", sa.Text, nullable=False),
    sa.Column("created_at", sa.Double, nullable=False),
    sa.Column("summary", Json("policy_evaluations.summary"), nullable=False),
    sa.Column("bytes", sa.BigInteger, nullable=False),
    sa.Column("digest", sa.Text, nullable=False),  # SHA-256 of the file with the episodes of the evaluation
    sa.Column("blob", sa.Text),  # name of the blob with the episodes; NULL: not stored
    sa.UniqueConstraint("surrogate_id", "version", "key"),
    policy_key(),
    sqlite_autoincrement=True,
)

for _table in metadata.tables.values():
    checked(_table)
