"""Queries whose actions the sampler plans anew.

Revision ID: 0102
Revises: 0101
"""

import sqlalchemy as sa
from alembic import op

revision = "0102"
down_revision = "0101"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("queries", sa.Column("replan", sa.Boolean(), nullable=False, server_default=sa.false()))
