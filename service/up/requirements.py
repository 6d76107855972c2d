"""Requirements: what has to be there before the service says that it is up, each named with its setting.

Found out at the start, by whoever starts it, and not by the first job hours later.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from service.catalog.models import Models
from service.catalog.sql.database import Database
from service.errors import DatabaseUnavailable, QueueUnavailable
from service.queue import JobQueue
from service.settings import Settings
from service.up.embedded_redis import LaunchFailed

REDIS_STARTS_S = 10.0  #: that a Redis which is started beside the service may take
_AGAIN_S = 0.5
_CHECK_S = 120.0  # torch may be imported for the first time


def require_queue(settings: Settings, *, within_s: float = REDIS_STARTS_S) -> None:
    """Raise LaunchFailed where the Redis of SPICD_REDIS_URL does not answer in time, or the URL is none."""
    until = time.monotonic() + within_s
    while (error := _queue_error(settings.redis_url or "")) is not None:
        if time.monotonic() > until or isinstance(error, ValueError):
            raise LaunchFailed(
                f"SPICD_REDIS_URL names no Redis that can be used ({error}); start it or mend the URL; without it "
                "`spicd up` starts its own"
            ) from error
        time.sleep(_AGAIN_S)


def _queue_error(url: str) -> Exception | None:
    try:
        queue = JobQueue(url, timeout_s=1)
        try:
            queue.ping()
        finally:
            queue.close()
    except QueueUnavailable as error:  # whose sentence is for clients
        return ConnectionError(f"it does not answer: {type(error.__cause__ or error).__name__}")
    except ValueError as error:
        return error
    return None


def require_model(settings: Settings) -> None:
    """Raise LaunchFailed where SPICD_MODEL is neither in the model store with its weights nor trained by the site."""
    name, _, version = settings.model.partition("/")
    folder = settings.model_store / name / version
    try:
        card = json.loads((folder / "card.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        if _is_trained(settings, name, version):
            return
        raise LaunchFailed(
            f"SPICD_MODEL is {settings.model!r}, and there is no such model in {settings.model_store} (SPICD_MODEL_STORE): "
            f"there is {_listed(settings.model_store)}; name one of them, or put the model there"
        ) from None
    weights = card.get("weights")
    if weights is not None and not (folder / weights).is_file():
        raise LaunchFailed(
            f"SPICD_MODEL is {settings.model!r}, and its weights {folder / weights} are not there; put them back"
        )


def _is_trained(settings: Settings, name: str, version: str) -> bool:
    if not (version.isascii() and version.isdigit() and len(version) < 10):
        return False
    database = Database(settings.resolved_database_url())
    try:
        model = Models(database).find(name, int(version))
    except DatabaseUnavailable:  # of a worker beside it, which goes on trying: nothing is known of the model
        return True
    finally:
        database.close()
    return model is not None and model.status == "ready"


def _listed(store: Path) -> str:
    cards = sorted(store.glob("*/*/card.json"))
    return ", ".join(f"{card.parent.parent.name}/{card.parent.name}" for card in cards) or "none"


def require_device(settings: Settings, environment: Mapping[str, str]) -> None:
    """Raise LaunchFailed where SPICD_DEVICE names a GPU and torch finds none; a worker is asked, for it has torch."""
    if settings.device != "cuda" or settings.inference_workers == 0:
        return
    command = [sys.executable, "-m", "worker", "check", "inference"]
    try:
        asked = subprocess.run(  # noqa: S603  # nosec B603 - our own program
            command, env=dict(environment), capture_output=True, text=True, timeout=_CHECK_S, check=False
        )
    except subprocess.TimeoutExpired:
        raise LaunchFailed(
            f"SPICD_DEVICE is cuda, and torch took over {_CHECK_S:g} s to find the GPU"
        ) from None
    if asked.returncode != 0:
        lines = asked.stderr.strip().splitlines() or [f"the check ended with status {asked.returncode}"]
        raise LaunchFailed(lines[-1])
