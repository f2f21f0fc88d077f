"""Rates of the cost model: the newest calibration, and what past jobs say it is off by.

They lead predictions alone: of the tasks only the report's and the estimate's are given them, so
that what a job makes does not depend on what ran before it.
"""

from contextlib import suppress
from math import exp, isfinite, log
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from prtbake_storage.contract.rates import NewRates
from prtbake_storage.records.clock import utc_now
from prtbake_storage.records.database import Database
from prtbake_storage.records.models import CalibrationRow, StageFactorRow

MEMORY_JOBS = 8
"""A stage's factor is the mean of its first jobs' ratios in logarithms, then one that forgets: a
new job counts for one in so many."""

MOST_RATIO = 4.0
"""One job's ratio counts for no more than this, and no less than its inverse: a machine that slept
teaches nothing."""


class CostRates:
    """Reads the rates."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def current(self) -> dict[str, Any]:
        """Give the ``seconds`` that count (None for shipped), ``factors`` and ``calibration``."""
        with self._database.read() as session:
            newest = _newest(session)
            rows = session.scalars(
                sa.select(StageFactorRow).where(
                    StageFactorRow.calibration == ("" if newest is None else newest.job_id)
                )
            )
            return {
                "seconds": None if newest is None else newest.seconds,
                "factors": {row.stage: exp(row.log_factor) for row in rows},
                "calibration": None if newest is None else newest.job_id,
            }


def learn(session: Session, job_id: str, rates: NewRates) -> None:
    """Enter what a job says; what was predicted by rates that count no more is left out."""
    if rates.seconds is not None:
        # a job that was deleted leaves its id to another, and its calibration with it
        session.execute(sa.delete(StageFactorRow).where(StageFactorRow.calibration == job_id))
        session.merge(
            CalibrationRow(
                job_id=job_id,
                seconds={stage: dict(own) for stage, own in rates.seconds.items()},
                created=utc_now(),
            )
        )
        return
    newest = _newest(session)
    if rates.calibration != (None if newest is None else newest.job_id):
        return
    # in one order everywhere, or two jobs that end at once could wait for each other
    for stage, ratio in sorted(rates.ratios.items()):
        if isfinite(ratio) and ratio > 0.0:
            _observe(session, rates.calibration or "", stage, ratio)


def _observe(session: Session, calibration: str, stage: str, ratio: float) -> None:
    bounded = min(max(log(ratio), -log(MOST_RATIO)), log(MOST_RATIO))
    row = session.get(StageFactorRow, (calibration, stage), with_for_update=True)
    if row is None:
        # another job may enter the first ratio at this moment: then that one stands
        with suppress(IntegrityError), session.begin_nested():
            session.add(
                StageFactorRow(calibration=calibration, stage=stage, log_factor=bounded, jobs=1)
            )
        return
    row.jobs += 1
    row.log_factor += (bounded - row.log_factor) / min(row.jobs, MEMORY_JOBS)


def _newest(session: Session) -> CalibrationRow | None:
    return session.scalars(
        sa.select(CalibrationRow)
        .order_by(CalibrationRow.created.desc(), CalibrationRow.job_id.desc())
        .limit(1)
    ).first()
