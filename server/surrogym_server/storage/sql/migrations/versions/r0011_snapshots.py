"""Snapshots, and the queries that begin at one.

Revision ID: 0011
Revises: 0010
"""

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None

Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    op.add_column("queries", sa.Column("snapshot", sa.Text()))
    op.create_table(
        "snapshots",
        sa.Column("id", Id, nullable=False),
        sa.Column("surrogate_id", Id, nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("coordinates", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(
            ["surrogate_id"], ["surrogates.id"], name="fk_snapshots_surrogate_id", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_snapshots"),
        sa.UniqueConstraint("surrogate_id", "name", name="uq_snapshots_surrogate_id_name"),
        sqlite_autoincrement=True,
    )


def downgrade() -> None:
    op.drop_table("snapshots")
    op.drop_column("queries", "snapshot")
