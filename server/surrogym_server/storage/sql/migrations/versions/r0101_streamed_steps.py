"""The steps of streams.

Revision ID: 0101
Revises: 0100
"""

import sqlalchemy as sa
from alembic import op

revision = "0101"
down_revision = "0100"
branch_labels = None
depends_on = None

ID = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    op.create_table(
        "streamed_steps",
        sa.Column("id", ID, autoincrement=True, nullable=False),
        sa.Column("surrogate_id", ID, nullable=False),
        sa.Column("stream", sa.Text(), nullable=False),
        sa.Column("number", sa.BigInteger(), nullable=False),
        sa.Column("created_at", sa.Double(), nullable=False),
        sa.Column("step", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(
            ["surrogate_id"], ["surrogates.id"], name="fk_streamed_steps_surrogate_id", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id", name="pk_streamed_steps"),
        sa.UniqueConstraint("surrogate_id", "stream", "number", name="uq_streamed_steps_surrogate_id_stream_number"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_streamed_steps_surrogate_id_id", "streamed_steps", ["surrogate_id", "id"])
