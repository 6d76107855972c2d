"""The steps of each kind of job: which function, on which queue, in which order.

A job that a client sees is a chain of small steps; each takes the job's id alone, finds the rest in the
catalog, and may be run twice. The workers run no function but these (an allow-list).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Queue = Literal["geometry", "inference"]
JobKind = Literal["map", "survey", "model"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Step:
    """One function call of a job."""

    name: str  #: unique within the job; the rq id is "{job_id}-{name}"
    function: str  #: dotted name, called with the job's id
    queue: Queue  #: geometry forks a process for each step, inference keeps the network warm


STEPS: dict[JobKind, tuple[Step, ...]] = {
    "map": (
        Step(name="register", function="worker.jobs.register_map", queue="geometry"),
        Step(name="encode", function="worker.jobs.encode_map", queue="inference"),
    ),
    "survey": (
        Step(name="register", function="worker.jobs.register_survey", queue="geometry"),
        Step(name="score", function="worker.jobs.score_survey", queue="inference"),
        Step(name="export", function="worker.jobs.export_survey", queue="geometry"),
    ),
    "model": (
        Step(name="pack", function="worker.jobs.pack_tiles", queue="geometry"),
        Step(name="train", function="worker.jobs.train_model", queue="inference"),
        Step(name="finish", function="worker.jobs.finish_model", queue="inference"),
    ),
}


def first_step(kind: JobKind) -> Step:
    """Return the step that a new job begins with."""
    return STEPS[kind][0]


def step_of(kind: JobKind, name: str) -> Step:
    """Return a job's step by its name; the first where an earlier build knew it by another one."""
    return next((step for step in STEPS[kind] if step.name == name), first_step(kind))


def step_after(kind: JobKind, name: str) -> Step | None:
    """Return the step that follows; None after the last."""
    steps = STEPS[kind]
    following = steps[steps.index(step_of(kind, name)) + 1 :]
    return following[0] if following else None


ALLOWED_FUNCTIONS = frozenset(step.function for steps in STEPS.values() for step in steps)
