"""Tolerances that a person set after the surrogate was created.

Revision ID: 0003
Revises: 0002
"""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("surrogates", sa.Column("tolerances", sa.Text(), nullable=False, server_default="{}"))


def downgrade() -> None:
    op.drop_column("surrogates", "tolerances")
