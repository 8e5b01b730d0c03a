"""For how long a lease and the right to fit were given out: they never have more time left than that.

Revision ID: 0006
Revises: 0005
"""

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

FIT_SECONDS = 30.0  # of every right to fit until now


def upgrade() -> None:
    op.add_column("leases", sa.Column("seconds", sa.Double(), nullable=False, server_default="0"))
    op.execute("UPDATE leases SET seconds = expires - begun")
    op.add_column("surrogates", sa.Column("fit_seconds", sa.Double()))
    op.execute(f"UPDATE surrogates SET fit_seconds = {FIT_SECONDS} WHERE fit_expires IS NOT NULL")


def downgrade() -> None:
    op.drop_column("surrogates", "fit_seconds")
    op.drop_column("leases", "seconds")
