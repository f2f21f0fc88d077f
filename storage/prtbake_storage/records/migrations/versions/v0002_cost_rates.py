"""Calibrated rates of the cost model, and what past jobs say they are off by."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply."""
    op.create_table(
        "calibrations",
        sa.Column("job_id", sa.String(length=64), nullable=False),
        sa.Column("seconds", sa.JSON(), nullable=False),
        sa.Column("created", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("job_id", name="pk_calibrations"),
    )
    op.create_table(
        "stage_factors",
        sa.Column("calibration", sa.String(length=64), nullable=False),
        sa.Column("stage", sa.String(length=40), nullable=False),
        sa.Column("log_factor", sa.Float(precision=53), nullable=False),
        sa.Column("jobs", sa.Integer(), nullable=False),
        sa.PrimaryKeyConstraint("calibration", "stage", name="pk_stage_factors"),
    )


def downgrade() -> None:
    """Take back."""
    for table in ("stage_factors", "calibrations"):
        op.drop_table(table)
