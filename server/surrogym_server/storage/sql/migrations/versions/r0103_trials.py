"""Queries whose actions a policy chooses.

Revision ID: 0103
Revises: 0102
"""

import sqlalchemy as sa
from alembic import op

revision = "0103"
down_revision = "0102"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("queries", sa.Column("policy", sa.LargeBinary()))
