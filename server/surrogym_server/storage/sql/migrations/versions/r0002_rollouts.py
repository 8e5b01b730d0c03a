"""Rollouts: a query may ask for an action sequence from a reset, and is answered by as many samples.

Revision ID: 0002
Revises: 0001
"""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

LAST_ID = sa.text("SELECT seq FROM sqlite_sequence WHERE name = 'samples'")
FORGET_LAST_ID = sa.text("DELETE FROM sqlite_sequence WHERE name = 'samples'")
KEEP_LAST_ID = sa.text("INSERT INTO sqlite_sequence (name, seq) VALUES ('samples', :seq)")


def upgrade() -> None:
    op.add_column("queries", sa.Column("kind", sa.Text(), nullable=False, server_default="step"))
    op.add_column("queries", sa.Column("steps", sa.Integer(), nullable=False, server_default="1"))
    op.add_column("samples", sa.Column("step", sa.Integer(), nullable=False, server_default="0"))
    _unique(drop="uq_samples_lease_id", create="uq_samples_lease_id_step", columns=["lease_id", "step"])


def downgrade() -> None:
    _unique(drop="uq_samples_lease_id_step", create="uq_samples_lease_id", columns=["lease_id"])
    op.drop_column("samples", "step")
    op.drop_column("queries", "steps")
    op.drop_column("queries", "kind")


def _unique(drop: str, create: str, columns: list[str]) -> None:
    """Replace a constraint. SQLite has to copy the table for it, and would forget which ids were used."""
    connection = op.get_bind()
    sqlite = connection.dialect.name == "sqlite"
    last = connection.execute(LAST_ID).scalar() if sqlite else None
    with op.batch_alter_table("samples", table_kwargs={"sqlite_autoincrement": True}) as samples:
        samples.drop_constraint(drop, type_="unique")
        samples.create_unique_constraint(create, columns)
    if last is not None:
        connection.execute(FORGET_LAST_ID)
        connection.execute(KEEP_LAST_ID, {"seq": last})
