"""Policies with their files, evaluations and aliases.

Revision ID: 0008
Revises: 0007
"""

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None

Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def _policy(table: str) -> sa.ForeignKeyConstraint:
    columns = ["surrogate_id", "version"]
    name = f"fk_{table}_surrogate_id"
    return sa.ForeignKeyConstraint(columns, [f"policies.{c}" for c in columns], name=name, ondelete="CASCADE")


def upgrade() -> None:
    op.add_column("surrogates", sa.Column("policy_versions", sa.Integer(), nullable=False, server_default="0"))
    op.create_table(
        "policies",
        sa.Column("surrogate_id", Id, nullable=False),
        sa.Column("version", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("created_at", sa.Double(), nullable=False),
        sa.Column("card", sa.Text(), nullable=False),
        sa.Column("curve", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(
            ["surrogate_id"], ["surrogates.id"], name="fk_policies_surrogate_id", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("surrogate_id", "version", name="pk_policies"),
    )
    op.create_table(
        "policy_files",
        sa.Column("surrogate_id", Id, autoincrement=False, nullable=False),
        sa.Column("version", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("form", sa.Text(), nullable=False),
        sa.Column("main", sa.Boolean(), nullable=False),
        sa.Column("bytes", sa.BigInteger(), nullable=False),
        sa.Column("digest", sa.Text(), nullable=False),
        sa.Column("blob", sa.Text()),
        _policy("policy_files"),
        sa.PrimaryKeyConstraint("surrogate_id", "version", "form", name="pk_policy_files"),
    )
    op.create_table(
        "policy_aliases",
        sa.Column("surrogate_id", Id, autoincrement=False, nullable=False),
        sa.Column("alias", sa.Text(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        _policy("policy_aliases"),
        sa.PrimaryKeyConstraint("surrogate_id", "alias", name="pk_policy_aliases"),
    )
    op.create_table(
        "policy_evaluations",
        sa.Column("id", Id, autoincrement=True, nullable=False),
        sa.Column("surrogate_id", Id, nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("key", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Double(), nullable=False),
        sa.Column("summary", sa.Text(), nullable=False),
        sa.Column("bytes", sa.BigInteger(), nullable=False),
        sa.Column("digest", sa.Text(), nullable=False),
        sa.Column("blob", sa.Text()),
        _policy("policy_evaluations"),
        sa.PrimaryKeyConstraint("id", name="pk_policy_evaluations"),
        sa.UniqueConstraint("surrogate_id", "version", "key", name="uq_policy_evaluations_surrogate_id_version_key"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "blobs",
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Double(), nullable=False),
        sa.Column("content", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint("name", name="pk_blobs"),
    )


def downgrade() -> None:
    for table in ("blobs", "policy_evaluations", "policy_aliases", "policy_files", "policies"):
        op.drop_table(table)
    op.drop_column("surrogates", "policy_versions")
