"""Logged samples: found again by what they are, and fitted without waiting for queries.

Revision ID: 0007
Revises: 0006
"""

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

INDEX = "ix_samples_surrogate_id_fingerprint"


def upgrade() -> None:
    op.add_column("surrogates", sa.Column("logged_revision", sa.BigInteger(), nullable=False, server_default="0"))
    op.create_index(INDEX, "samples", ["surrogate_id", "fingerprint"])


def downgrade() -> None:
    op.drop_index(INDEX, "samples")
    op.drop_column("surrogates", "logged_revision")
