"""The first schema.

Revision ID: 0100
Revises:
"""

import sqlalchemy as sa
from alembic import op

revision = "0100"  # unreleased versions used 0001 to 0011
down_revision = None
branch_labels = None
depends_on = None

ID = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
OPEN = sa.text("outcome = 'open'")


def _owner(table: str) -> sa.ForeignKeyConstraint:
    """Return the foreign key of a table to the surrogate to which a row belongs. Rows are deleted with their
    surrogate."""
    return sa.ForeignKeyConstraint(
        ["surrogate_id"], ["surrogates.id"], name=f"fk_{table}_surrogate_id", ondelete="CASCADE"
    )


def upgrade() -> None:
    _blobs()
    _sessions()
    _surrogates()
    _evaluations()
    _events()
    _jobs()
    _live_sessions()
    _models()
    _occupancies()
    _policies()
    _priors()
    _queries()
    _requests()
    _snapshots()
    _leases()
    _policy_aliases()
    _policy_evaluations()
    _policy_files()
    _samples()


def _blobs() -> None:
    op.create_table(
        "blobs",
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Double(), nullable=False),
        sa.Column("content", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint("name", name="pk_blobs"),
    )


def _sessions() -> None:
    op.create_table(
        "sessions",
        sa.Column("id", sa.Text(), nullable=False),
        sa.Column("surrogate", sa.Text(), nullable=False),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_sessions"),
    )


def _surrogates() -> None:
    op.create_table(
        "surrogates",
        sa.Column("id", ID, autoincrement=True, nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("spec", sa.Text(), nullable=False),
        sa.Column("budget", sa.Integer(), nullable=False),
        sa.Column("target", sa.Double(), nullable=False),
        sa.Column("tolerances", sa.Text(), nullable=False, server_default="{}"),
        sa.Column("phase", sa.Text(), nullable=False),
        sa.Column("paused", sa.Boolean(), nullable=False),
        sa.Column("round", sa.Integer(), nullable=False),
        sa.Column("state", sa.Text(), nullable=False),
        sa.Column("error", sa.Text()),
        sa.Column("extra_queries", sa.Integer(), nullable=False),
        sa.Column("checkpoint", sa.Text()),
        sa.Column("revision", sa.BigInteger(), nullable=False),
        sa.Column("fitted_revision", sa.BigInteger(), nullable=False),
        sa.Column("logged_revision", sa.BigInteger(), nullable=False, server_default="0"),
        sa.Column("fit_token", sa.Text()),
        sa.Column("fit_owner", sa.Text()),
        sa.Column("fit_expires", sa.Double()),
        sa.Column("fit_seconds", sa.Double()),
        sa.Column("policy_versions", sa.Integer(), nullable=False, server_default="0"),
        sa.Column("created_at", sa.Double(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_surrogates"),
        sa.UniqueConstraint("name", name="uq_surrogates_name"),
        sqlite_autoincrement=True,
    )


def _evaluations() -> None:
    op.create_table(
        "evaluations",
        sa.Column("id", ID, autoincrement=True, nullable=False),
        sa.Column("surrogate_id", ID, nullable=False),
        sa.Column("steps", sa.BigInteger(), nullable=False),
        sa.Column("episodes", sa.BigInteger(), nullable=False),
        sa.Column("note", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Double(), nullable=False),
        _owner("evaluations"),
        sa.PrimaryKeyConstraint("id", name="pk_evaluations"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_evaluations_surrogate_id", "evaluations", ["surrogate_id"])


def _events() -> None:
    op.create_table(
        "events",
        sa.Column("id", ID, autoincrement=True, nullable=False),
        sa.Column("surrogate_id", ID, nullable=False),
        sa.Column("kind", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Double(), nullable=False),
        sa.Column("body", sa.Text(), nullable=False),
        _owner("events"),
        sa.PrimaryKeyConstraint("id", name="pk_events"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_events_surrogate_id_id", "events", ["surrogate_id", "id"])


def _jobs() -> None:
    op.create_table(
        "jobs",
        sa.Column("id", ID, autoincrement=True, nullable=False),
        sa.Column("surrogate_id", ID, nullable=False),
        sa.Column("kind", sa.Text(), nullable=False),
        sa.Column("status", sa.Text(), nullable=False),
        sa.Column("task", sa.Text(), nullable=False),
        sa.Column("episodes", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.Double(), nullable=False),
        sa.Column("attempts", sa.Integer(), nullable=False),
        sa.Column("worker", sa.Text()),
        sa.Column("token", sa.Text()),
        sa.Column("begun", sa.Double()),
        sa.Column("expires", sa.Double()),
        sa.Column("seconds", sa.Double()),
        sa.Column("cancelling", sa.Boolean(), nullable=False),
        sa.Column("lost", sa.Boolean(), nullable=False),
        sa.Column("finished_at", sa.Double()),
        sa.Column("state", sa.Text(), nullable=False),
        sa.Column("curve", sa.Text(), nullable=False),
        sa.Column("error", sa.Text()),
        sa.Column("version", sa.Integer()),
        sa.Column("evaluation", ID),
        _owner("jobs"),
        sa.PrimaryKeyConstraint("id", name="pk_jobs"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_jobs_status_expires", "jobs", ["status", "expires"])
    op.create_index("ix_jobs_surrogate_id_status_id", "jobs", ["surrogate_id", "status", "id"])


def _live_sessions() -> None:
    op.create_table(
        "live_sessions",
        sa.Column("id", sa.Text(), nullable=False),
        sa.Column("surrogate_id", ID, nullable=False),
        sa.Column("key", sa.Text()),
        sa.Column("digest", sa.Text()),
        sa.Column("machine", sa.Text(), nullable=False),
        sa.Column("owner", sa.Text(), nullable=False),
        sa.Column("fence", sa.BigInteger(), nullable=False),
        sa.Column("expires", sa.Double(), nullable=False),
        sa.Column("seconds", sa.Double(), nullable=False),
        sa.Column("seq", sa.BigInteger(), nullable=False),
        sa.Column("data", sa.LargeBinary()),
        _owner("live_sessions"),
        sa.PrimaryKeyConstraint("id", name="pk_live_sessions"),
        sa.UniqueConstraint("surrogate_id", "key", name="uq_live_sessions_surrogate_id_key"),
    )
    op.create_index("ix_live_sessions_owner", "live_sessions", ["owner"])


def _models() -> None:
    op.create_table(
        "models",
        sa.Column("surrogate_id", ID, nullable=False),
        sa.Column("version", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("created_at", sa.Double(), nullable=False),
        sa.Column("samples", sa.Integer(), nullable=False),
        sa.Column("data_hash", sa.Text(), nullable=False),
        sa.Column("fidelity", sa.Text(), nullable=False),
        sa.Column("description", sa.Text(), nullable=False),
        sa.Column("fit_seconds", sa.Double(), nullable=False),
        sa.Column("blob", sa.LargeBinary(), nullable=False),
        sa.Column("checksum", sa.Text(), nullable=False, server_default=""),
        sa.Column("damage", sa.Text()),
        _owner("models"),
        sa.PrimaryKeyConstraint("surrogate_id", "version", name="pk_models"),
    )


def _occupancies() -> None:
    op.create_table(
        "occupancies",
        sa.Column("id", ID, autoincrement=True, nullable=False),
        sa.Column("surrogate_id", ID, nullable=False),
        sa.Column("checkpoint", sa.Text(), nullable=False),
        sa.Column("round", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.Double(), nullable=False),
        sa.Column("columns", sa.Integer(), nullable=False),
        sa.Column("states", sa.LargeBinary(), nullable=False),
        _owner("occupancies"),
        sa.PrimaryKeyConstraint("id", name="pk_occupancies"),
        sa.UniqueConstraint("surrogate_id", "checkpoint", name="uq_occupancies_surrogate_id_checkpoint"),
        sqlite_autoincrement=True,
    )


def _policies() -> None:
    op.create_table(
        "policies",
        sa.Column("surrogate_id", ID, nullable=False),
        sa.Column("version", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("created_at", sa.Double(), nullable=False),
        sa.Column("card", sa.Text(), nullable=False),
        sa.Column("curve", sa.Text(), nullable=False),
        _owner("policies"),
        sa.PrimaryKeyConstraint("surrogate_id", "version", name="pk_policies"),
    )


def _priors() -> None:
    op.create_table(
        "priors",
        sa.Column("surrogate_id", ID, nullable=False),
        sa.Column("created_at", sa.Double(), nullable=False),
        sa.Column("about", sa.Text(), nullable=False),
        sa.Column("blob", sa.LargeBinary(), nullable=True),
        sa.Column("checksum", sa.Text(), nullable=False),
        _owner("priors"),
        sa.PrimaryKeyConstraint("surrogate_id", name="pk_priors"),
    )


def _queries() -> None:
    op.create_table(
        "queries",
        sa.Column("id", ID, autoincrement=True, nullable=False),
        sa.Column("surrogate_id", ID, nullable=False),
        sa.Column("purpose", sa.Text(), nullable=False),
        sa.Column("status", sa.Text(), nullable=False),
        sa.Column("round", sa.Integer(), nullable=False),
        sa.Column("kind", sa.Text(), nullable=False, server_default="step"),
        sa.Column("coordinates", sa.LargeBinary(), nullable=False),
        sa.Column("action", sa.LargeBinary(), nullable=False),
        sa.Column("steps", sa.Integer(), nullable=False, server_default="1"),
        sa.Column("snapshot", sa.Text()),
        sa.Column("extra", sa.Boolean(), nullable=False, server_default=sa.false()),
        sa.Column("attempts", sa.Integer(), nullable=False),
        sa.Column("sampler", sa.Text()),
        sa.Column("error", sa.Text()),
        _owner("queries"),
        sa.PrimaryKeyConstraint("id", name="pk_queries"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_queries_surrogate_id_status_id", "queries", ["surrogate_id", "status", "id"])


def _requests() -> None:
    op.create_table(
        "requests",
        sa.Column("surrogate_id", ID, nullable=False),
        sa.Column("operation", sa.Text(), nullable=False),
        sa.Column("key", sa.Text(), nullable=False),
        sa.Column("fingerprint", sa.Text(), nullable=False),
        sa.Column("result", sa.Text(), nullable=False),
        _owner("requests"),
        sa.PrimaryKeyConstraint("surrogate_id", "operation", "key", name="pk_requests"),
    )


def _snapshots() -> None:
    op.create_table(
        "snapshots",
        sa.Column("id", ID, autoincrement=True, nullable=False),
        sa.Column("surrogate_id", ID, nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("coordinates", sa.LargeBinary(), nullable=False),
        _owner("snapshots"),
        sa.PrimaryKeyConstraint("id", name="pk_snapshots"),
        sa.UniqueConstraint("surrogate_id", "name", name="uq_snapshots_surrogate_id_name"),
        sqlite_autoincrement=True,
    )


def _leases() -> None:
    op.create_table(
        "leases",
        sa.Column("id", ID, autoincrement=True, nullable=False),
        sa.Column("surrogate_id", ID, nullable=False),
        sa.Column("query_id", ID, nullable=False),
        sa.Column("token", sa.Text(), nullable=False),
        sa.Column("sampler", sa.Text(), nullable=False),
        sa.Column("attempt", sa.Integer(), nullable=False),
        sa.Column("begun", sa.Double(), nullable=False),
        sa.Column("expires", sa.Double(), nullable=False),
        sa.Column("seconds", sa.Double(), nullable=False, server_default="0"),
        sa.Column("outcome", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(["query_id"], ["queries.id"], name="fk_leases_query_id", ondelete="CASCADE"),
        _owner("leases"),
        sa.PrimaryKeyConstraint("id", name="pk_leases"),
        sa.UniqueConstraint("token", name="uq_leases_token"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_leases_query_id", "leases", ["query_id"])
    op.create_index("ix_leases_surrogate_id_outcome_expires", "leases", ["surrogate_id", "outcome", "expires"])
    op.create_index("uq_leases_open", "leases", ["query_id"], unique=True, sqlite_where=OPEN, postgresql_where=OPEN)


def _policy_aliases() -> None:
    op.create_table(
        "policy_aliases",
        sa.Column("surrogate_id", ID, autoincrement=False, nullable=False),
        sa.Column("alias", sa.Text(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(
            ["surrogate_id", "version"],
            ["policies.surrogate_id", "policies.version"],
            name="fk_policy_aliases_surrogate_id",
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("surrogate_id", "alias", name="pk_policy_aliases"),
    )


def _policy_evaluations() -> None:
    op.create_table(
        "policy_evaluations",
        sa.Column("id", ID, autoincrement=True, nullable=False),
        sa.Column("surrogate_id", ID, nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("key", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Double(), nullable=False),
        sa.Column("summary", sa.Text(), nullable=False),
        sa.Column("bytes", sa.BigInteger(), nullable=False),
        sa.Column("digest", sa.Text(), nullable=False),
        sa.Column("blob", sa.Text()),
        sa.ForeignKeyConstraint(
            ["surrogate_id", "version"],
            ["policies.surrogate_id", "policies.version"],
            name="fk_policy_evaluations_surrogate_id",
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("id", name="pk_policy_evaluations"),
        sa.UniqueConstraint("surrogate_id", "version", "key", name="uq_policy_evaluations_surrogate_id_version_key"),
        sqlite_autoincrement=True,
    )


def _policy_files() -> None:
    op.create_table(
        "policy_files",
        sa.Column("surrogate_id", ID, autoincrement=False, nullable=False),
        sa.Column("version", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("form", sa.Text(), nullable=False),
        sa.Column("main", sa.Boolean(), nullable=False),
        sa.Column("bytes", sa.BigInteger(), nullable=False),
        sa.Column("digest", sa.Text(), nullable=False),
        sa.Column("blob", sa.Text()),
        sa.ForeignKeyConstraint(
            ["surrogate_id", "version"],
            ["policies.surrogate_id", "policies.version"],
            name="fk_policy_files_surrogate_id",
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("surrogate_id", "version", "form", name="pk_policy_files"),
    )


def _samples() -> None:
    op.create_table(
        "samples",
        sa.Column("id", ID, autoincrement=True, nullable=False),
        sa.Column("surrogate_id", ID, nullable=False),
        sa.Column("query_id", ID),
        sa.Column("lease_id", ID),
        sa.Column("step", sa.Integer(), nullable=False, server_default="0"),
        sa.Column("purpose", sa.Text(), nullable=False),
        sa.Column("sampler", sa.Text(), nullable=False),
        sa.Column("attempt", sa.Integer(), nullable=False),
        sa.Column("late", sa.Boolean(), nullable=False),
        sa.Column("coordinates", sa.LargeBinary(), nullable=False),
        sa.Column("action", sa.LargeBinary(), nullable=False),
        sa.Column("next_coordinates", sa.LargeBinary(), nullable=False),
        sa.Column("reward", sa.Double(), nullable=False),
        sa.Column("terminated", sa.Boolean(), nullable=False),
        sa.Column("truncated", sa.Boolean(), nullable=False),
        sa.Column("observation", sa.LargeBinary()),
        sa.Column("next_observation", sa.LargeBinary()),
        sa.Column("fingerprint", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Double(), nullable=False),
        sa.ForeignKeyConstraint(["lease_id"], ["leases.id"], name="fk_samples_lease_id", ondelete="CASCADE"),
        sa.ForeignKeyConstraint(["query_id"], ["queries.id"], name="fk_samples_query_id", ondelete="CASCADE"),
        _owner("samples"),
        sa.PrimaryKeyConstraint("id", name="pk_samples"),
        sa.UniqueConstraint("lease_id", "step", name="uq_samples_lease_id_step"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_samples_query_id", "samples", ["query_id"])
    op.create_index("ix_samples_surrogate_id_fingerprint", "samples", ["surrogate_id", "fingerprint"])
    op.create_index("ix_samples_surrogate_id_id", "samples", ["surrogate_id", "id"])
