"""`spicd up` in a process of its own, and its API as a client sees it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import httpx

from tests.support.processes import descendants

ROOT = Path(__file__).parents[2]
STARTS_WITHIN_S, ENDS_WITHIN_S, JOB_WITHIN_S = 60, 20, 120
ORDER = ("accepted", "running", "successful", "failed", "dismissed")


class Service:
    """`spicd up`, and its API as a client sees it."""

    #: processes at least: the API, Redis, and a worker of each queue
    least = 4

    def __init__(self, folder: Path, model_store: Path, **settings: str | int) -> None:
        """Start it in `folder`; `settings` are those of SPICD_*; a name in capitals is a variable as it is."""
        ready, self.log = folder / "ready.json", folder / "log"
        command = [sys.executable, "-m", "service", "up", "--port", "0", "--end-with-parent"]
        command += ["--data-dir", str(folder / "data"), "--ready-file", str(ready)]
        environment = {key: value for key, value in os.environ.items() if not key.startswith("SPICD_")}
        environment["SPICD_MODEL_STORE"] = str(model_store)
        for name, value in settings.items():
            environment[name if name.isupper() else f"SPICD_{name.upper()}"] = str(value)
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=log, stderr=log)
        until = time.monotonic() + STARTS_WITHIN_S
        while not ready.exists():
            assert self.process.poll() is None, self.log.read_text()
            assert time.monotonic() < until, self.log.read_text()
            time.sleep(0.05)
        self.url = str(json.loads(ready.read_text())["url"])
        self.http = httpx.Client(base_url=self.url, timeout=30)

    def get(self, path: str) -> Any:
        answer = self.http.get(path)
        assert answer.status_code == 200, answer.text
        return answer.json()

    def upload(self, path: Path, **about: str) -> str:
        """As a raw body; the scan's id."""
        answer = self.http.post(
            "/scans",
            params={"filename": path.name, **about},
            content=path.read_bytes(),
            headers={"Content-Type": "application/octet-stream"},
        )
        assert answer.status_code == 201, answer.text
        return str(answer.json()["scan_id"])

    def post(self, path: str, *files: Path, **body: Any) -> dict[str, Any]:
        """JSON, or a form with `scans`; the 202 answer."""
        scans = [("scans", (file.name, file.read_bytes())) for file in files]
        answer = self.http.post(path, data=body, files=scans) if files else self.http.post(path, json=body)
        assert answer.status_code == 202, answer.text
        accepted: dict[str, Any] = answer.json()
        assert answer.headers["Location"] == f"/jobs/{accepted['job_id']}"
        return accepted

    def ended(self, job_id: str) -> dict[str, Any]:
        """The job's last document; on the way states only move forward, and progress never falls."""
        seen: list[dict[str, Any]] = []
        until = time.monotonic() + JOB_WITHIN_S
        while not seen or seen[-1]["status"] in ("accepted", "running"):
            assert time.monotonic() < until, f"{seen[-1]}\n{self.log.read_text()[-4000:]}"
            seen.append(self.get(f"/jobs/{job_id}"))
            time.sleep(0.05)
        states = [ORDER.index(job["status"]) for job in seen]
        progress = [job["progress"] for job in seen]
        assert states == sorted(states)
        assert progress == sorted(progress)
        return seen[-1]

    def succeeded(self, job_id: str) -> dict[str, Any]:
        job = self.ended(job_id)
        assert job["status"] == "successful", f"{job}\n{self.log.read_text()[-4000:]}"
        assert job["progress"] == 100
        return job

    def processes(self) -> set[int]:
        """The service and everything that it started."""
        return {self.process.pid, *descendants(self.process.pid)}

    def end(self) -> None:
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(ENDS_WITHIN_S)


class OneOfMany(Service):
    """A host that has Redis, PostgreSQL and S3 elsewhere."""

    least = 3


class TwoHosts(Service):
    """Two hosts that share Redis, PostgreSQL and S3, and no folder: every job crosses from one to the other.

    The first has the API that the tests ask and the worker of the geometry queue, the second that of the inference
    queue, and an API as well.
    """

    least = 4

    def __init__(self, folder: Path, model_store: Path, **settings: str | int) -> None:
        first, second = folder / "first", folder / "second"
        first.mkdir()
        second.mkdir()
        super().__init__(first, model_store, **{**settings, "inference_workers": 0})
        self.other = Service(second, model_store, **{**settings, "geometry_workers": 0})

    def processes(self) -> set[int]:
        return super().processes() | self.other.processes()

    def end(self) -> None:
        self.other.end()
        super().end()
