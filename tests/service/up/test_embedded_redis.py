"""The embedded server: one a folder, what it keeps, and when it ends."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest
from redis import Redis

from service.catalog.steps import STEPS
from service.errors import QueueUnavailable, is_disk_full
from service.queue import JobQueue
from service.up import embedded_redis
from service.up.embedded_redis import DataFolderInUse, EmbeddedRedis, LaunchFailed, find_server
from tests.support.processes import until
from tests.support.small_disk import small_disk

ROOT = Path(__file__).parents[3]
HOLDER = """
import sys, time
from pathlib import Path
from service.up.embedded_redis import EmbeddedRedis
server = EmbeddedRedis(Path(sys.argv[1]))
server.start()
print(server.pid, flush=True)
time.sleep(60)
"""


def test_a_second_server_on_the_same_folder_is_refused_by_name(tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path / "redis"), pytest.raises(DataFolderInUse) as found:
        EmbeddedRedis(tmp_path / "redis").start()
    assert str(tmp_path) in str(found.value)
    assert str(os.getpid()) in str(found.value)
    assert "\n" not in str(found.value)


def test_what_was_written_is_there_after_a_restart(tmp_path: Path) -> None:
    server = EmbeddedRedis(tmp_path / "redis")
    for value in (b"1", b"2"):
        with server:
            client = Redis.from_url(server.url)
            assert client.incr("count") == int(value)
            client.close()
        assert not server.alive


def test_only_this_user_may_connect_and_no_port_is_open(tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path / "redis") as server:
        socket_path = tmp_path / "redis" / "redis.sock"
        assert stat.S_IMODE(socket_path.stat().st_mode) == 0o700
        client = Redis.from_url(server.url, decode_responses=True)
        assert client.config_get("port") == {"port": "0"}
        client.close()


def test_a_folder_too_deep_for_a_socket_works_too(tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path / ("deep " * 20) / "redis") as server:
        client = Redis.from_url(server.url)
        assert client.ping()
        client.close()


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's parent-death signal is Linux's")
def test_the_server_ends_when_its_parent_is_killed_and_the_folder_is_free_again(tmp_path: Path) -> None:
    folder = tmp_path / "redis"
    command = [sys.executable, "-c", HOLDER, str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as holder:
        assert holder.stdout is not None
        server_pid = int(holder.stdout.readline())
        os.kill(server_pid, signal.SIGSTOP)  # it cannot end yet, and might still write
        holder.send_signal(signal.SIGKILL)
    try:
        with pytest.raises(DataFolderInUse):
            EmbeddedRedis(folder).start()
    finally:
        os.kill(server_pid, signal.SIGCONT)
    end = time.monotonic() + 10
    while Path(f"/proc/{server_pid}").exists():
        assert time.monotonic() < end, "the server outlived its parent"
        time.sleep(0.02)
    with EmbeddedRedis(folder) as server:
        assert server.alive


def test_a_server_on_the_path_is_preferred(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "valkey-server"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert find_server() == program


def test_a_server_that_does_not_start_is_named_with_its_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(embedded_redis, "find_server", lambda: Path("/bin/false"))
    with pytest.raises(LaunchFailed, match=r"redis\.log"):
        EmbeddedRedis(tmp_path / "redis").start()


REGISTER = STEPS["survey"][0]


def test_on_a_full_disk_the_queue_takes_no_job_says_why_and_recovers(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 48) as disk, EmbeddedRedis(disk.folder / "redis") as redis:
        queue = JobQueue(redis.url)
        queue.arrange("geometry", [("job-before", REGISTER)])
        disk.fill()

        def refused() -> bool:
            """Whether a job is refused; Redis notices when it writes its file, once a second."""
            try:
                queue.arrange(
                    "geometry", [("job-before", REGISTER), (f"job-{time.monotonic_ns()}", REGISTER)]
                )
            except QueueUnavailable as error:
                assert is_disk_full(error)
                return True
            return False

        until(refused)
        assert "job-before-register" in queue.snapshot().held  # who reads is answered
        disk.clear()
        until(lambda: not refused())
        queue.ping()
        queue.close()


def test_on_a_full_disk_it_starts(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 48) as disk:
        with EmbeddedRedis(disk.folder / "redis") as redis:
            JobQueue(redis.url).arrange("geometry", [("job-before", REGISTER)])
        disk.fill(leave=4 << 20)
        with EmbeddedRedis(disk.folder / "redis") as redis:
            assert "job-before-register" in JobQueue(redis.url).snapshot().held
