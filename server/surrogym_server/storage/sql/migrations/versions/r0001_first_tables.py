"""The first tables.

Revision ID: 0001
Revises:
"""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

ID = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
OPEN = sa.text("outcome = 'open'")


def upgrade() -> None:
    _surrogates()
    _queries()
    _leases()
    _samples()
    _evaluations()
    _requests()
    _models()
    _occupancies()
    _sessions()
    _events()


def downgrade() -> None:
    for table in (
        "events",
        "sessions",
        "occupancies",
        "models",
        "requests",
        "evaluations",
        "samples",
        "leases",
        "queries",
        "surrogates",
    ):
        op.drop_table(table)


def _surrogates() -> None:
    op.create_table(
        "surrogates",
        sa.Column("id", ID, autoincrement=True, nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("spec", sa.Text(), nullable=False),
        sa.Column("budget", sa.Integer(), nullable=False),
        sa.Column("target", sa.Double(), nullable=False),
        sa.Column("phase", sa.Text(), nullable=False),
        sa.Column("paused", sa.Boolean(), nullable=False),
        sa.Column("round", sa.Integer(), nullable=False),
        sa.Column("state", sa.Text(), nullable=False),
        sa.Column("error", sa.Text()),
        sa.Column("extra_queries", sa.Integer(), nullable=False),
        sa.Column("checkpoint", sa.Text()),
        sa.Column("revision", sa.BigInteger(), nullable=False),
        sa.Column("fitted_revision", sa.BigInteger(), nullable=False),
        sa.Column("fit_token", sa.Text()),
        sa.Column("fit_owner", sa.Text()),
        sa.Column("fit_expires", sa.Double()),
        sa.Column("created_at", sa.Double(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_surrogates"),
        sa.UniqueConstraint("name", name="uq_surrogates_name"),
        sqlite_autoincrement=True,
    )


def _queries() -> None:
    op.create_table(
        "queries",
        sa.Column("id", ID, autoincrement=True, nullable=False),
        sa.Column("surrogate_id", ID, nullable=False),
        sa.Column("purpose", sa.Text(), nullable=False),
        sa.Column("status", sa.Text(), nullable=False),
        sa.Column("round", sa.Integer(), nullable=False),
        sa.Column("coordinates", sa.LargeBinary(), nullable=False),
        sa.Column("action", sa.LargeBinary(), nullable=False),
        sa.Column("attempts", sa.Integer(), nullable=False),
        sa.Column("sampler", sa.Text()),
        sa.Column("error", sa.Text()),
        sa.ForeignKeyConstraint(
            ["surrogate_id"], ["surrogates.id"], name="fk_queries_surrogate_id", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_queries"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_queries_surrogate_id_status_id", "queries", ["surrogate_id", "status", "id"], unique=False)


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
        sa.Column("outcome", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(["query_id"], ["queries.id"], name="fk_leases_query_id", ondelete="CASCADE"),
        sa.ForeignKeyConstraint(["surrogate_id"], ["surrogates.id"], name="fk_leases_surrogate_id", ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name="pk_leases"),
        sa.UniqueConstraint("token", name="uq_leases_token"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_leases_query_id", "leases", ["query_id"], unique=False)
    op.create_index(
        "ix_leases_surrogate_id_outcome_expires",
        "leases",
        ["surrogate_id", "outcome", "expires"],
        unique=False,
    )
    op.create_index("uq_leases_open", "leases", ["query_id"], unique=True, sqlite_where=OPEN, postgresql_where=OPEN)


def _samples() -> None:
    op.create_table(
        "samples",
        sa.Column("id", ID, autoincrement=True, nullable=False),
        sa.Column("surrogate_id", ID, nullable=False),
        sa.Column("query_id", ID),
        sa.Column("lease_id", ID),
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
        sa.ForeignKeyConstraint(
            ["surrogate_id"], ["surrogates.id"], name="fk_samples_surrogate_id", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_samples"),
        sa.UniqueConstraint("lease_id", name="uq_samples_lease_id"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_samples_query_id", "samples", ["query_id"], unique=False)
    op.create_index("ix_samples_surrogate_id_id", "samples", ["surrogate_id", "id"], unique=False)


def _evaluations() -> None:
    op.create_table(
        "evaluations",
        sa.Column("id", ID, autoincrement=True, nullable=False),
        sa.Column("surrogate_id", ID, nullable=False),
        sa.Column("steps", sa.BigInteger(), nullable=False),
        sa.Column("episodes", sa.BigInteger(), nullable=False),
        sa.Column("note", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Double(), nullable=False),
        sa.ForeignKeyConstraint(
            ["surrogate_id"], ["surrogates.id"], name="fk_evaluations_surrogate_id", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_evaluations"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_evaluations_surrogate_id", "evaluations", ["surrogate_id"], unique=False)


def _requests() -> None:
    op.create_table(
        "requests",
        sa.Column("surrogate_id", ID, nullable=False),
        sa.Column("operation", sa.Text(), nullable=False),
        sa.Column("key", sa.Text(), nullable=False),
        sa.Column("fingerprint", sa.Text(), nullable=False),
        sa.Column("result", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(
            ["surrogate_id"], ["surrogates.id"], name="fk_requests_surrogate_id", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("surrogate_id", "operation", "key", name="pk_requests"),
    )


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
        sa.ForeignKeyConstraint(["surrogate_id"], ["surrogates.id"], name="fk_models_surrogate_id", ondelete="CASCADE"),
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
        sa.ForeignKeyConstraint(
            ["surrogate_id"], ["surrogates.id"], name="fk_occupancies_surrogate_id", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_occupancies"),
        sa.UniqueConstraint("surrogate_id", "checkpoint", name="uq_occupancies_surrogate_id_checkpoint"),
        sqlite_autoincrement=True,
    )


def _sessions() -> None:
    op.create_table(
        "sessions",
        sa.Column("id", sa.Text(), nullable=False),
        sa.Column("surrogate", sa.Text(), nullable=False),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_sessions"),
    )


def _events() -> None:
    op.create_table(
        "events",
        sa.Column("id", ID, autoincrement=True, nullable=False),
        sa.Column("surrogate_id", ID, nullable=False),
        sa.Column("kind", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Double(), nullable=False),
        sa.Column("body", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(["surrogate_id"], ["surrogates.id"], name="fk_events_surrogate_id", ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name="pk_events"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_events_surrogate_id_id", "events", ["surrogate_id", "id"], unique=False)
