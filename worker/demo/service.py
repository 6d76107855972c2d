"""The service as a child process: `spicd up` on a free port, and its end."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Self

STARTS_WITHIN_S = 60.0
ENDS_WITHIN_S = 20.0

#: Where a service listens and keeps things. The demo's own must not meet one that the environment names.
_OWN = {
    "AUTH",
    "HOST",
    "PORT",
    "DATA_DIR",
    "REDIS_URL",
    "DATABASE_URL",
    "BLOB_URL",
    "GEOMETRY_WORKERS",
    "INFERENCE_WORKERS",
}


class DemoFailed(Exception):
    """The service did not do its job; `str()` is one sentence."""


class ServiceChild:
    """A context manager: the service runs within it, and nothing of it is left behind it.

    It starts at once and answers from `await_ready` on, so that other work can be done meanwhile.
    """

    def __init__(self, data_dir: Path, log: Path, *, model: str | None = None) -> None:
        """`model` is made the service's default; None leaves that as it is."""
        self._model = model
        self._ready = data_dir / "ready.json"
        self._data_dir = data_dir
        self._log = log
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        self._data_dir.mkdir(parents=True, exist_ok=True)
        self._ready.unlink(missing_ok=True)
        command = [sys.executable, "-m", "service", "up", "--port", "0", "--end-with-parent"]
        command += ["--data-dir", str(self._data_dir), "--ready-file", str(self._ready)]
        hidden = {f"SPICD_{name}" for name in _OWN}
        environment = {name: value for name, value in os.environ.items() if name not in hidden}
        if self._model is not None:
            environment["SPICD_MODEL"] = self._model
        with self._log.open("wb") as log:
            # A session of its own: Ctrl-C reaches the demo alone, which then ends the service in order.
            # a list of ours: no shell reads it
            self._process = subprocess.Popen(  # noqa: S603  # nosec B603
                command, env=environment, stdout=log, stderr=log, start_new_session=True
            )
        return self

    def await_ready(self) -> dict[str, Any]:
        """Return `url` and the rest of the ready file. Raises DemoFailed where the service does not come up."""
        until = time.monotonic() + STARTS_WITHIN_S
        while not self._ready.exists():
            if self._started.poll() is not None:
                raise DemoFailed(f"the service ended at once: {self._last_words()}")
            if time.monotonic() > until:
                raise DemoFailed(f"the service did not start in {STARTS_WITHIN_S:g} s; see {self._log}")
            time.sleep(0.05)
        ready: dict[str, Any] = json.loads(self._ready.read_text())
        return ready

    def await_end(self) -> None:
        """Return on Ctrl-C. Raises DemoFailed where the service ends by itself."""
        with contextlib.suppress(KeyboardInterrupt):
            self._started.wait()
            raise DemoFailed(f"the service ended: {self._last_words()}")

    def __exit__(self, *_: object) -> None:
        self._started.terminate()
        try:
            self._started.wait(ENDS_WITHIN_S)
        except subprocess.TimeoutExpired:
            self._started.kill()
            self._started.wait()

    @property
    def _started(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            raise RuntimeError("the service has not been started")
        return self._process

    def _last_words(self) -> str:
        lines = self._log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else f"see {self._log}"
