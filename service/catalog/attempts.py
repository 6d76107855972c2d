"""What becomes of a job whose step ended without a word: started again, and not for ever.

A crash may be the file's fault, and then every attempt ends so; or the machine's, and then the next one does not.
"""

from __future__ import annotations

from sqlalchemy import func, update

from service.catalog import tables
from service.catalog.clock import now
from service.catalog.database import Database
from service.catalog.jobs import Jobs
from service.catalog.records import Problem

MAX_ATTEMPTS = 3  #: of a whole job, whichever of its steps they are lost in
WORKER_DIED = "worker_died"  #: code of the problem of a job that is given up

_OPEN = tables.Job.status.in_(("accepted", "running"))


class Attempts:
    """The attempts of the catalog's jobs; every change is guarded as in jobs.py, so a job that ended stays ended."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def lose(self, job_id: str, how: str) -> bool:
        """Count an attempt that ended without a result; `how` says why, as the first half of a sentence.

        True when the step shall be started again. False when this was the last attempt, and the job failed with
        `WORKER_DIED`; and when the job had ended or gone before.
        """
        lost = tables.Job.attempts + 1
        with self._database.write() as session:
            statement = update(tables.Job).where(tables.Job.id == job_id, _OPEN)
            attempts = session.scalar(statement.values(attempts=lost).returning(tables.Job.attempts))
            if attempts is None:
                return False
            if attempts < MAX_ATTEMPTS:
                message = f"started again ({attempts + 1} of {MAX_ATTEMPTS}): {how}"
                session.execute(statement.values(_waiting(message)))
                return True
        detail = f"{how}; given up after {attempts} attempts, look at the worker's log and memory"
        Jobs(self._database).fail(job_id, Problem(code=WORKER_DIED, detail=detail))
        return False

    def put_back(self, job_id: str) -> bool:
        """A step was stopped with its worker, which is nobody's fault and counts for nothing.

        False when the job had ended or gone, and the step is not wanted any more.
        """
        statement = update(tables.Job).where(tables.Job.id == job_id, _OPEN).returning(tables.Job.id)
        message = "stopped with its worker; goes on with the next that is free"
        with self._database.write() as session:
            return session.scalar(statement.values(_waiting(message))) is not None


def _waiting(message: str) -> dict[str, object]:
    """The columns of a job whose step is in the queue once more: it runs, as it did before."""
    instant = now()
    started = func.coalesce(tables.Job.started, instant)
    return {"status": "running", "started": started, "message": message, "updated": instant}
