"""Checksums of stored models, and which of them are damaged.

Models that are there get the checksum of what they are now: damage from before is not found by it.

Revision ID: 0005
Revises: 0004
"""

import hashlib

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None

models = sa.table(
    "models",
    sa.column("surrogate_id", sa.BigInteger),
    sa.column("version", sa.Integer),
    sa.column("blob", sa.LargeBinary),
    sa.column("checksum", sa.Text),
)


def upgrade() -> None:
    op.add_column("models", sa.Column("checksum", sa.Text(), nullable=False, server_default=""))
    op.add_column("models", sa.Column("damage", sa.Text()))
    connection = op.get_bind()
    for key in connection.execute(sa.select(models.c.surrogate_id, models.c.version)).all():
        own = (models.c.surrogate_id == key.surrogate_id) & (models.c.version == key.version)
        blob = bytes(connection.execute(sa.select(models.c.blob).where(own)).scalar_one())
        connection.execute(sa.update(models).where(own).values(checksum=hashlib.sha256(blob).hexdigest()))


def downgrade() -> None:
    op.drop_column("models", "damage")
    op.drop_column("models", "checksum")
