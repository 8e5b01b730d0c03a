"""Samples in which an entry of the action was at a bound. Samples stored before are not marked.

Revision ID: 0104
Revises: 0103
"""

import sqlalchemy as sa
from alembic import op

revision = "0104"
down_revision = "0103"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("samples", sa.Column("at_bound", sa.Boolean(), nullable=False, server_default=sa.false()))
