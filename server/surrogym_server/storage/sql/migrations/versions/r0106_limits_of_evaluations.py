"""How the episodes of evaluations kept declared limits. Evaluations stored before have no counts.

Revision ID: 0106
Revises: 0105
"""

import sqlalchemy as sa
from alembic import op

revision = "0106"
down_revision = "0105"
branch_labels = None
depends_on = None


def upgrade() -> None:
    for name in ("violations", "fallbacks", "fallback_episodes"):
        op.add_column("evaluations", sa.Column(name, sa.BigInteger()))
