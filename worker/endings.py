"""How a step ended that could not tell so itself: by an error that its worker caught, or with its process."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from typing import Literal

from service.errors import Unavailable, is_disk_full
from worker.errors import DeviceLost, NoSpaceLeft, PipelineError
from worker.rq_jobs import FunctionRefused, StepJob, StepTimedOut

_OUTSIDE = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT)

How = Literal["lost", "interrupted", "failed", "stopped", "dismissed"]


class WorkerStopped(BaseException):
    """The worker was told to end and its time is up. Not an `Exception`, so that no step swallows it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Ending:
    """How a step's process ended that could not tell itself."""

    how: How
    sentence: str = ""  #: or the first half of one
    code: str = ""  #: of the problem, where it failed


def ending_of(error: BaseException, job: StepJob) -> Ending:
    """Return how a step ended that an error left."""
    if isinstance(error, WorkerStopped):
        return Ending(how="stopped")
    if isinstance(error, Unavailable):  # the step could not even say that it was interrupted
        return Ending(how="interrupted", sentence=str(error))
    if DeviceLost.is_told_by(error):
        what = str(error).partition("\n")[0]
        return Ending(how="interrupted", sentence=f"the device of the networks failed ({what})")
    code, sentence = _problem(error, job)
    return Ending(how="failed", code=code, sentence=sentence)


def _problem(error: BaseException, job: StepJob) -> tuple[str, str]:
    """Return code and sentence for an error that fails a job."""
    match error:
        case PipelineError():
            return error.code, str(error)
        case FunctionRefused():
            return "function_refused", str(error)
        case StepTimedOut():
            return "timed_out", f"step {job.id} took longer than {job.timeout} s; send fewer or smaller scans"
        case _ if is_disk_full(error):
            return NoSpaceLeft.code, "the disk is full; make room, then run it again"
        case _:
            what = f"an unexpected {type(error).__name__}"
            return "internal", f"step {job.id} stopped on {what}; see the worker's log"


def ending_of_status(status: int, job: StepJob, *, out_of_memory: bool) -> Ending:
    """Return how a process ended without a word, from its wait status.

    A signal that a fault in the process itself raises costs an attempt; one that is sent from outside does not, unless
    the kernel says that it killed a process for want of memory.
    """
    of = f"the process of step {job.id} ended"
    if not os.WIFSIGNALED(status):
        return Ending(how="lost", sentence=f"{of} with exit status {os.waitstatus_to_exitcode(status)}")
    number = signal.Signals(os.WTERMSIG(status))
    if number == signal.SIGKILL and out_of_memory:
        return Ending(how="lost", sentence=f"{of} by signal {number.name}: out of memory")
    how: How = "interrupted" if number in _OUTSIDE else "lost"
    return Ending(how=how, sentence=f"{of} by signal {number.name}")
