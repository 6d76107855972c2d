"""Logs: lines for people and for machines, and what they are about."""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
from collections.abc import Iterator
from contextvars import copy_context
from io import StringIO

import pytest

from service import logs
from service.logs import about, fields, set_up_logging


@pytest.fixture(params=["text", "json"])
def written(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[StringIO]:
    """What is logged in one format; the root logger is as before afterwards."""
    root, stream = logging.getLogger(), StringIO()
    before, level = root.handlers[:], root.level
    monkeypatch.setattr(sys, "stderr", stream)
    root.handlers[:] = []
    set_up_logging("info", request.param)
    yield stream
    root.handlers[:] = before
    root.setLevel(level)


def objects(written: StringIO) -> list[dict[str, object]]:
    return [json.loads(line) for line in written.getvalue().splitlines()]


@pytest.mark.parametrize("written", ["text"], indirect=True)
def test_a_line_for_people_is_as_it_was_and_ends_with_what_it_is_about(written: StringIO) -> None:
    log = logging.getLogger("spicd.test")
    log.info("plain")
    with about(request_id="abc"), about(job_id="job-1", other=None):
        log.warning("more")
    plain, more = written.getvalue().splitlines()
    assert plain.endswith(f" INFO    spicd.test[{os.getpid()}] plain")
    assert more.endswith(f" WARNING spicd.test[{os.getpid()}] more request_id=abc job_id=job-1")


@pytest.mark.parametrize("written", ["json"], indirect=True)
def test_a_line_for_machines_is_one_object_with_everything(written: StringIO) -> None:
    log = logging.getLogger("spicd.test")
    with about(request_id="abc"):
        log.info("%s\nforged", "said", extra=fields(status=200))
    try:
        raise ValueError("no\nnumber")
    except ValueError:
        log.exception("failed")
    first, second = objects(written)
    assert first.pop("time")
    assert first == {
        "level": "info",
        "logger": "spicd.test",
        "process": os.getpid(),
        "message": "said\nforged",
        "request_id": "abc",
        "status": 200,
    }
    assert "ValueError: no" in str(second["exception"])
    assert "request_id" not in second


def test_an_id_cannot_make_a_line_of_its_own(written: StringIO) -> None:
    with about(job_id="x\n2026-01-01 INFO forged"):
        logging.getLogger("spicd.test").info("said")
    assert len(written.getvalue().splitlines()) == 1


@pytest.mark.parametrize("written", ["json"], indirect=True)
def test_threads_with_the_context_and_forked_processes_know_it(written: StringIO) -> None:
    def say() -> None:
        logging.getLogger("spicd.test").info("said")

    with about(job_id="job-1"):
        thread = threading.Thread(target=copy_context().run, args=(say,))
        thread.start()
        thread.join()
        context = logs._ABOUT.get()
    assert objects(written)[0]["job_id"] == "job-1"
    assert context == {"job_id": "job-1"}
    assert logs._ABOUT.get() == {}
