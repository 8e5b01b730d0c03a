"""Jobs for trainer workers.

Revision ID: 0009
Revises: 0008
"""

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    op.create_table(
        "jobs",
        sa.Column("id", Id, autoincrement=True, nullable=False),
        sa.Column("surrogate_id", Id, nullable=False),
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
        sa.Column("evaluation", Id),
        sa.ForeignKeyConstraint(["surrogate_id"], ["surrogates.id"], name="fk_jobs_surrogate_id", ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name="pk_jobs"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_jobs_surrogate_id_status_id", "jobs", ["surrogate_id", "status", "id"])
    op.create_index("ix_jobs_status_expires", "jobs", ["status", "expires"])


def downgrade() -> None:
    op.drop_table("jobs")
