"""`spicd up` as a process: what it starts, and that nothing of it is left."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from redis import Redis

from service.settings import Settings
from service.up.children import WorkerPool
from service.up.embedded_redis import LaunchFailed
from service.up.launcher import environment_of, up
from tests.support.processes import descendants, running, until

ROOT = Path(__file__).parents[2]

# A worker that ends by itself, and one that does not listen to SIGTERM.
SHORT = "import sys; sys.exit(3)"
STUBBORN = """
import signal, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
open(sys.argv[1], "w").close()
time.sleep(60)
"""


class Launched:
    """A running `spicd up`, everything it said, and every process it started."""

    def __init__(self, folder: Path, workers: int) -> None:
        ready = folder / "ready.json"
        command = [
            sys.executable,
            "-m",
            "tests.support.launch",
            str(folder / "data"),
            str(ready),
            str(workers),
        ]
        environment = {key: value for key, value in os.environ.items() if not key.startswith("SPICD_")}
        self.process = subprocess.Popen(command, cwd=ROOT, env={**environment, "PYTHONPATH": str(ROOT)})
        until(lambda: ready.exists() or self.process.poll() is not None)
        self.ready: dict[str, Any] = json.loads(ready.read_text())

    def await_workers(self) -> None:
        """Return when both workers listen: a worker that still imports ends more easily than one that works."""
        client = Redis.from_url(self.ready["redis_url"])
        until(lambda: client.scard("rq:workers") == 2)
        client.close()

    def pids(self) -> list[int]:
        return list(descendants(self.process.pid))


@pytest.fixture
def launched(tmp_path: Path) -> Iterator[Launched]:
    launched = Launched(tmp_path, workers=1)
    yield launched
    launched.process.kill()
    launched.process.wait()


linux = pytest.mark.skipif(
    sys.platform != "linux", reason="reads /proc, and the kernel's parent-death signal"
)


@linux
def test_the_ready_file_names_what_answers(launched: Launched) -> None:
    assert httpx.get(launched.ready["url"] + "/settings").json() == {
        "redis_url": launched.ready["redis_url"],
        "data_dir": launched.ready["data_dir"],
    }
    assert launched.ready["pid"] == launched.process.pid
    assert [worker["queue"] for worker in launched.ready["workers"]] == ["geometry", "inference"]
    assert launched.ready["redis_pid"] in launched.pids()


@linux
@pytest.mark.parametrize(("how", "when"), [(signal.SIGTERM, "at work"), (signal.SIGINT, "at the start")])
def test_asked_to_end_it_leaves_no_process_behind(launched: Launched, how: signal.Signals, when: str) -> None:
    if when == "at work":
        launched.await_workers()
    pids = launched.pids()
    assert len(pids) == 3
    launched.process.send_signal(how)
    assert launched.process.wait(20) == 0
    assert not [pid for pid in pids if running(pid)]


@linux
def test_killed_it_leaves_no_process_behind(launched: Launched) -> None:
    launched.await_workers()
    pids = launched.pids()
    assert len(pids) == 3
    launched.process.kill()
    until(lambda: not [pid for pid in pids if running(pid)])


def test_a_second_one_on_the_same_folder_is_refused_in_one_line(launched: Launched, tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / "data", port=0, geometry_workers=0, inference_workers=0)
    with pytest.raises(LaunchFailed, match=f"process {launched.process.pid}"):
        up(settings, on_ready=lambda running: None)


def test_a_start_sweeps_the_scratch_of_killed_steps_and_not_under_a_running_service(
    launched: Launched, tmp_path: Path
) -> None:
    step = tmp_path / "data" / "scratch" / "spicd-step-1"
    step.mkdir(parents=True)
    (step / "cloud.ply").touch()
    settings = Settings(data_dir=tmp_path / "data", port=0, geometry_workers=0, inference_workers=0)
    with pytest.raises(LaunchFailed):  # the folder is in use
        up(settings, on_ready=lambda running: None)
    assert step.exists()
    launched.process.terminate()
    launched.process.wait(20)
    (tmp_path / "ready.json").unlink()
    again = Launched(tmp_path, workers=0)
    again.process.kill()
    again.process.wait()
    assert not step.exists()


def test_a_start_takes_away_the_claims_of_workers_that_were_killed_with_the_service(
    launched: Launched, tmp_path: Path
) -> None:
    client = Redis.from_url(launched.ready["redis_url"])
    client.zadd("rq:wip:geometry", {"m1-register:1": time.time() + 60})
    client.close()
    launched.process.terminate()
    launched.process.wait(20)
    (tmp_path / "ready.json").unlink()
    again = Launched(tmp_path, workers=0)
    client = Redis.from_url(again.ready["redis_url"])
    claims = client.zcard("rq:wip:geometry")
    client.close()
    again.process.kill()
    again.process.wait()
    assert claims == 0


def test_a_dead_redis_is_started_again_with_what_it_held(launched: Launched) -> None:
    client = Redis.from_url(launched.ready["redis_url"])
    client.set("kept", "yes")
    os.kill(launched.ready["redis_pid"], signal.SIGTERM)
    until(lambda: not running(launched.ready["redis_pid"]))

    def kept() -> bool:
        try:
            return client.get("kept") == b"yes"
        except Exception:
            return False

    until(kept)
    client.close()


def test_a_taken_port_is_told_before_anything_starts(tmp_path: Path) -> None:
    import socket

    with socket.create_server(("127.0.0.1", 0)) as taken:
        settings = Settings(data_dir=tmp_path / "data", port=taken.getsockname()[1], geometry_workers=0)
        with pytest.raises(LaunchFailed, match="--port"):
            up(settings, on_ready=lambda running: None)
    assert not (tmp_path / "data").exists()


def test_a_data_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(LaunchFailed, match=r"file/data.*SPICD_DATA_DIR"):
        up(Settings(data_dir=tmp_path / "file" / "data", port=0), on_ready=lambda running: None)


def test_missing_worker_packages_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "open3d" else object())
    with pytest.raises(LaunchFailed, match=r"open3d not installed.*spicd\[worker\]"):
        up(Settings(data_dir=tmp_path), on_ready=lambda running: None)


def test_the_workers_environment_spells_every_setting_out(tmp_path: Path) -> None:
    environment = environment_of(Settings(data_dir=tmp_path, redis_url="unix:///r", job_timeout_s=7))
    assert environment["SPICD_REDIS_URL"] == "unix:///r"
    assert environment["SPICD_DATA_DIR"] == str(tmp_path)
    assert environment["SPICD_JOB_TIMEOUT_S"] == "7"
    assert "SPICD_BLOB_URL" not in environment


def test_a_dying_worker_is_started_again_and_each_time_later() -> None:
    pool = WorkerPool(geometry=1, inference=0, environment=os.environ, program=(sys.executable, "-c", SHORT))
    place = pool.workers[0]
    pids = set()
    with pool:
        for wait in (1, 3, 7):
            pids.add(place.pid)
            until(lambda: place.process is not None and place.process.poll() == 3)
            before = time.monotonic()
            pool.check()
            assert place.process is None
            assert place.due >= before + wait
            place.due = 0.0  # as if the wait were over
            pool.check()
    assert len(pids) == 3


def test_a_worker_that_ignores_the_request_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.up.children.GRACE_S", -1.9)
    program = (sys.executable, "-c", STUBBORN, str(tmp_path / "up"))
    with WorkerPool(geometry=1, inference=0, environment=os.environ, program=program) as pool:
        until((tmp_path / "up").exists)
        process = pool.workers[0].process
    assert process is not None
    assert process.returncode == -signal.SIGKILL
