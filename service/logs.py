"""How every process of the service writes its log: one line an event, on stderr."""

from __future__ import annotations

import logging

LOG_FORMAT = "%(asctime)s %(levelname)-7s %(name)s[%(process)d] %(message)s"


def set_up_logging(level: str) -> None:
    """Set up the root logger; libraries that narrate every request or every few seconds speak from warnings on."""
    logging.basicConfig(level=level.upper(), format=LOG_FORMAT)
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
