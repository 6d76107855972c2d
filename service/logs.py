"""How every process of the service writes its log: one line an event, on stderr, for people or as JSON.

A line says which request or job it belongs to: `about` names it for everything that is logged inside, also by code that
knows of neither, in threads that the request is handed to, and in a process that is forked for a step.
"""

from __future__ import annotations

import contextlib
import json
import logging
import re
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any, Literal

LogFormat = Literal["text", "json"]

LOG_FORMAT = "%(asctime)s %(levelname)-7s %(name)s[%(process)d] %(message)s"

_ABOUT: ContextVar[Mapping[str, str]] = ContextVar("spicd_log_about", default={})  # noqa: B039 - never changed
_PLAIN = re.compile(r"[\w.:/-]{1,200}")


def set_up_logging(level: str, log_format: LogFormat = "text") -> None:
    """Set up the root logger; libraries that narrate every request or every few seconds speak from warnings on."""
    handler = logging.StreamHandler()
    handler.addFilter(_note_about)
    handler.setFormatter(JsonFormatter() if log_format == "json" else TextFormatter())
    logging.basicConfig(level=level.upper(), handlers=[handler])
    if level != "debug":
        for name in (
            "rq",
            "rq.worker",
            "rq.job",
            "rq.queue",
            "rq.registry",
            "alembic",
            "httpx",
            "uvicorn",
        ):
            logging.getLogger(name).setLevel(logging.WARNING)


@contextlib.contextmanager
def about(**ids: str | None) -> Iterator[None]:
    """Name what is logged inside by these ids, such as `request_id` and `job_id`; those that are None are left out."""
    token = _ABOUT.set({**_ABOUT.get(), **{name: value for name, value in ids.items() if value is not None}})
    try:
        yield
    finally:
        _ABOUT.reset(token)


def fields(**values: Any) -> dict[str, Any]:
    """Return the `extra` of a log call whose line has these members of its own, as JSON."""
    return {"fields": values}


class TextFormatter(logging.Formatter):
    """The line for people; what it is about stands at its end."""

    def __init__(self) -> None:
        super().__init__(LOG_FORMAT)

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's name
        """Return the line without a traceback."""
        ids = (f" {name}={_plain(value)}" for name, value in _about(record).items())
        return super().formatMessage(record) + "".join(ids)


class JsonFormatter(logging.Formatter):
    """One JSON object a line: time, level, logger, process, message, what it is about, and a traceback as text."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the object; a line break in a value is escaped, so that no value makes a line of its own."""
        line = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "process": record.process,
            "message": record.getMessage(),
            **_about(record),
            **getattr(record, "fields", {}),
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=True, default=str)


def _note_about(record: logging.LogRecord) -> bool:
    record.about = _ABOUT.get()
    return True


def _about(record: logging.LogRecord) -> Mapping[str, str]:
    return getattr(record, "about", {})


def _plain(value: str) -> str:
    """Return a value that cannot be taken for something else: ids as they are, whatever else quoted."""
    return value if _PLAIN.fullmatch(value) else repr(value)
