"""A step as the workers accept it: an allowed function, its job's id, and nothing else."""

from __future__ import annotations

import json
import zlib
from typing import Any
from unittest.mock import Mock

import pytest
from rq.serializers import JSONSerializer

from worker.rq_jobs import FunctionRefused, StepJob, step_job


def job(function: str, *args: Any, instance: Any = None, **kwargs: Any) -> StepJob:
    """What the queue holds, whoever wrote it."""
    found = step_job(frozenset({"json.loads"}))(
        "job-1-register", connection=Mock(), serializer=JSONSerializer
    )
    found.data = json.dumps([function, instance, args, kwargs]).encode()
    return found


def test_an_allowed_function_is_called_with_the_id_of_its_job() -> None:
    step = job("json.loads", "[1]")
    step.run()
    assert (step.catalog_id, step.step) == ("[1]", "register")


@pytest.mark.parametrize(
    "forged",
    [
        job("os.system", "true"),
        job("json.loads"),
        job("json.loads", "[1]", "[2]"),
        job("json.loads", 1),
        job("json.loads", "[1]", cls="x"),
        job("json.loads", "[1]", instance="x"),
    ],
    ids=["function", "nothing", "two", "number", "keyword", "instance"],
)
def test_anything_else_is_refused(forged: StepJob) -> None:
    with pytest.raises(FunctionRefused):
        forged.run()


def test_what_cannot_be_read_names_no_job() -> None:
    forged = job("json.loads")
    forged.data = zlib.compress(b"no json")
    assert forged.catalog_id is None
