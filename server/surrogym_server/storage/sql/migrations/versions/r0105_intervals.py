"""Seconds between the steps of a rollout. Samples stored before have none.

Revision ID: 0105
Revises: 0104
"""

import sqlalchemy as sa
from alembic import op

revision = "0105"
down_revision = "0104"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("samples", sa.Column("seconds", sa.Double()))
