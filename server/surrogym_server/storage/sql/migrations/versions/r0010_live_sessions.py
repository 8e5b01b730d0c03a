"""Sessions of a cluster, with their leases and checkpoints.

Revision ID: 0010
Revises: 0009
"""

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None

Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    op.create_table(
        "live_sessions",
        sa.Column("id", sa.Text(), nullable=False),
        sa.Column("surrogate_id", Id, nullable=False),
        sa.Column("key", sa.Text()),
        sa.Column("digest", sa.Text()),
        sa.Column("machine", sa.Text(), nullable=False),
        sa.Column("owner", sa.Text(), nullable=False),
        sa.Column("fence", sa.BigInteger(), nullable=False),
        sa.Column("expires", sa.Double(), nullable=False),
        sa.Column("seconds", sa.Double(), nullable=False),
        sa.Column("seq", sa.BigInteger(), nullable=False),
        sa.Column("data", sa.LargeBinary()),
        sa.ForeignKeyConstraint(
            ["surrogate_id"], ["surrogates.id"], name="fk_live_sessions_surrogate_id", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_live_sessions"),
        sa.UniqueConstraint("surrogate_id", "key", name="uq_live_sessions_surrogate_id_key"),
    )
    op.create_index("ix_live_sessions_owner", "live_sessions", ["owner"])


def downgrade() -> None:
    op.drop_table("live_sessions")
