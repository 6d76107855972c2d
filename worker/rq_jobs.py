"""A step as the workers accept it: one of the allowed functions, called with its job's id, and nothing else.

A JSON serializer alone does not help: a job names its function, and rq imports whatever stands there. Whoever can
write to Redis must not be able to run code, so a worker calls the function itself and asks rq for nothing else that a
job may name: callbacks, bound instances, webhooks.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rq.executions import Execution
from rq.job import Job
from rq.timeouts import JobTimeoutException

from service.queue import step_of_id

StepTimedOut = JobTimeoutException  #: what the time limit of a step raises


class FunctionRefused(Exception):
    """The queue holds a call that this worker does not make."""


class StepJob(Job):  # type: ignore[misc]  # rq is untyped here
    """An rq job that calls allowed functions only; the base allows none, `step_job` makes one that does."""

    allowed: frozenset[str] = frozenset()
    claim: Execution | None = None  #: of the worker that has taken it

    @property
    def func(self) -> Callable[..., Any]:
        """The function to call; refused before its module is imported."""
        name = self.func_name
        if name not in self.allowed:
            raise FunctionRefused(f"step {self.id}: {str(name)[:100]!r} is not a function of this service")
        if (
            self.instance is not None
            or self.kwargs
            or not (len(self.args) == 1 and isinstance(self.args[0], str))
        ):
            raise FunctionRefused(f"step {self.id}: {name} takes the id of its job and nothing else")
        return super().func  # type: ignore[no-any-return]

    def run(self) -> None:
        """Call the step. Raises FunctionRefused, and what the step raises."""
        self.func(self.args[0])

    @property
    def catalog_id(self) -> str | None:
        """Id of the job in the catalog; None where the call is not one of ours."""
        try:
            return str(self.args[0])
        except Exception:  # the payload comes from outside and may be anything
            return None

    @property
    def step(self) -> str:
        """Name of the step."""
        return step_of_id(str(self.id))[1]


def step_job(allowed: frozenset[str]) -> type[StepJob]:
    """Return the job class that calls these dotted names only. rq takes a class, not an instance."""
    return type("AllowedStepJob", (StepJob,), {"allowed": allowed})
