"""A step as the workers accept it: one of the allowed functions, called with its job's id, and nothing else.

A JSON serializer alone does not help: a job names its function, and rq imports whatever stands there. Whoever can
write to Redis must not be able to run code, so everything else that an rq job may name is switched off as well:
callbacks, bound instances, webhooks.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

from rq import Queue
from rq.exceptions import NoSuchJobError
from rq.job import Job
from rq.serializers import JSONSerializer


class FunctionRefused(Exception):
    """The queue holds a call that this worker does not make."""


class StepJob(Job):  # type: ignore[misc]  # rq is untyped here
    """An rq job that calls allowed functions only; the base allows none, `step_job` makes one that does."""

    allowed: frozenset[str] = frozenset()

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

    @property
    def success_callback(self) -> None:
        """None: a callback is a function name too."""

    @property
    def failure_callback(self) -> None:
        """None, see `success_callback`."""

    @property
    def stopped_callback(self) -> None:
        """None, see `success_callback`."""

    def send_webhooks(self, *_: Any, **__: Any) -> None:
        """Send nothing: a job must not make the worker call an address."""

    @property
    def catalog_id(self) -> str | None:
        """Id of the job in the catalog; None where the call is not one of ours."""
        try:
            return str(self.args[0])
        except Exception:  # the payload comes from outside and may be anything
            return None

    def start_again(self) -> None:
        """Have rq put the step back into its queue where it would mark it as failed; the steps behind it go on waiting.

        That is rq's own retry, granted when it is due and not before: how often, the catalog knows. What the
        attempt leaves behind goes: rq would take a place between queue and worker for a step that got stuck, and does
        not delete a job whose execution has expired.
        """
        self.retries_left = 1
        between = Queue(self.origin, connection=self.connection).intermediate_queue_key
        self.connection.lrem(between, 0, self.id)
        self.connection.delete(self.execution_registry.key)

    def drop_dependents(self) -> None:
        """Delete the steps that wait for this one, and those that wait for them."""
        waiting = self.dependent_ids
        self.connection.delete(self.dependents_key)  # before the descent: a forged circle ends too
        for name in waiting:
            with suppress(NoSuchJobError):
                dependent = type(self).fetch(name, connection=self.connection, serializer=JSONSerializer)
                dependent.drop_dependents()
                dependent.delete()


def step_job(allowed: frozenset[str]) -> type[StepJob]:
    """Return the job class that calls these dotted names only. rq takes a class, not an instance."""
    return type("AllowedStepJob", (StepJob,), {"allowed": allowed})
