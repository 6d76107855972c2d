"""Servers for tests, and servers that fail them.

PostgreSQL is a server of its own in a temporary folder, where its programs are installed.

Looked for on the PATH, then where Debian puts them. Started by root it runs as the user `postgres` or `nobody`, for it
refuses to run as root.
"""

from __future__ import annotations

import contextlib
import os
import pwd
import shutil
import signal
import socket
import sqlite3
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

import httpx
import psycopg
import pytest

from service.up.embedded_redis import EmbeddedRedis
from tests.support.processes import until

SERVERS = Path(__file__).parents[2] / "build" / "servers"  #: where `make acceptance-shared` installs one
NO_S3 = "no S3 server on this machine: `make servers` installs one"
NO_POSTGRESQL = "no PostgreSQL on this machine: initdb and postgres are not on the PATH"
_STARTS_S = 30
_SIGNED = {"Authorization": "AWS4-HMAC-SHA256 Credential=key/20260301/us-east-1/s3/aws4_request"}


class PostgreSQL:
    """A server on a free port of the loopback address, which trusts everybody there."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._programs = _programs()
        self._user = _user()
        self.port = free_port()
        self.process: subprocess.Popen[bytes] | None = None
        if self._user is not None:
            os.chown(folder, self._user.pw_uid, self._user.pw_gid)
        options = ["--auth=trust", "--username=spicd", "--encoding=UTF8", "--no-sync"]
        self._run("initdb", "-D", str(folder / "data"), *options).wait(60)
        self.start()

    def start(self) -> None:
        """Start the server, or start it again."""
        settings = [
            f"port={self.port}",
            "listen_addresses=127.0.0.1",
            "fsync=off",
            "unix_socket_directories=",
        ]
        options = [word for setting in settings for word in ("-c", setting)]
        self.process = self._run("postgres", "-D", str(self._folder / "data"), *options)
        until(self._answers, _STARTS_S)

    def freeze(self) -> None:
        """Stop every process of the server in its tracks: connections stay open, and nobody answers."""
        self._signal(signal.SIGSTOP)

    def thaw(self) -> None:
        self._signal(signal.SIGCONT)

    def kill(self) -> None:
        """End the server as a crash does; `start` recovers it."""
        assert self.process is not None
        self._signal(signal.SIGKILL)
        self.process.wait()

    def stop(self) -> None:
        """End the server for good."""
        if self.process is not None and self.process.poll() is None:
            self.thaw()
            self.process.send_signal(signal.SIGINT)
            self.process.wait(30)

    def database(self) -> str:
        """Make a new database; returns its URL."""
        name = f"spicd_{uuid4().hex[:12]}"
        with psycopg.connect(self.url("postgres"), autocommit=True) as connection:
            connection.execute(f"CREATE DATABASE {name}")
        return self.url(name)

    def url(self, name: str) -> str:
        return f"postgresql://spicd@127.0.0.1:{self.port}/{name}"

    def _answers(self) -> bool:
        assert self.process is not None
        assert self.process.poll() is None, "PostgreSQL ended"
        with contextlib.suppress(psycopg.OperationalError):
            psycopg.connect(self.url("postgres"), connect_timeout=2).close()
            return True
        return False

    def _run(self, program: str, *arguments: str) -> subprocess.Popen[bytes]:
        user = {} if self._user is None else {"user": self._user.pw_uid, "group": self._user.pw_gid}
        with (self._folder / f"{program}.log").open("ab") as log:
            return subprocess.Popen(
                [str(self._programs / program), *arguments],
                cwd=self._folder,
                env={"PATH": os.environ["PATH"], "LC_ALL": "C"},
                stdout=log,
                stderr=log,
                start_new_session=True,
                **user,  # type: ignore[call-overload]
            )

    def _signal(self, number: signal.Signals) -> None:
        """Signal the whole family: each connection has a process, all in sessions of their own."""
        assert self.process is not None
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        for pid in (self.process.pid, *map(int, children)):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)


@contextlib.contextmanager
def postgresql() -> Iterator[PostgreSQL]:
    """Run a server; skip the test where there is none to run."""
    if _programs_or_none() is None:
        pytest.skip(NO_POSTGRESQL)
    with tempfile.TemporaryDirectory(prefix="spicd-postgresql-") as folder:
        server = PostgreSQL(Path(folder))
        try:
            yield server
        finally:
            server.stop()


def s3_environment(port: int) -> dict[str, str]:
    """Return the environment of a client of an S3 server on this machine."""
    return {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
        "AWS_ALLOW_HTTP": "true",
        "AWS_ACCESS_KEY_ID": "key",
        "AWS_SECRET_ACCESS_KEY": "secret",
        "AWS_REGION": "us-east-1",
    }


def free_port() -> int:
    """Return a port that nobody listens on now."""
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        return int(listening.getsockname()[1])


def _programs() -> Path:
    folder = _programs_or_none()
    assert folder is not None, NO_POSTGRESQL
    return folder


def _programs_or_none() -> Path | None:
    found = shutil.which("postgres")
    folders = [Path(found).resolve().parent] if found else []
    folders += sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    return next((folder for folder in folders if (folder / "initdb").exists()), None)


def _user() -> pwd.struct_passwd | None:
    if os.getuid() != 0:
        return None
    for name in ("postgres", "nobody"):
        with contextlib.suppress(KeyError):
            return pwd.getpwnam(name)
    return None


class Locked:
    """A SQLite database under somebody else's write lock, for as long as the block lasts."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> None:
        self._other = sqlite3.connect(self._path, isolation_level=None)
        self._other.execute("BEGIN IMMEDIATE")

    def __exit__(self, *_: object) -> None:
        self._other.rollback()
        self._other.close()


class SilentServer:
    """A port that takes every connection, and never says a word; with `words`, these and then nothing more."""

    def __init__(self, words: bytes = b"") -> None:
        self._words = words
        self._listening = socket.create_server(("127.0.0.1", 0), backlog=200)
        self._taken: list[socket.socket] = []
        self.port = self._listening.getsockname()[1]
        threading.Thread(target=self._take, daemon=True).start()

    def as_s3(self) -> dict[str, str]:
        """The environment of a client that takes it for S3."""
        return s3_environment(self.port)

    def close(self) -> None:
        for open_one in (self._listening, *self._taken):
            open_one.close()

    def _take(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                taken, _ = self._listening.accept()
                self._taken.append(taken)
                if self._words:
                    taken.recv(1 << 16)
                    taken.sendall(self._words)


class S3Server:
    """moto's S3, in a process of its own and in memory, with one bucket."""

    def __init__(self, program: Path, folder: Path) -> None:
        self.port = free_port()
        with (folder / "s3.log").open("wb") as log:
            self.process = subprocess.Popen(
                [str(program), "-H", "127.0.0.1", "-p", str(self.port)],
                cwd=folder,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        until(self._answers, _STARTS_S)

    def environment(self) -> dict[str, str]:
        """Return what a client needs beside `s3://bucket`."""
        return s3_environment(self.port)

    def stop(self) -> None:
        self.process.kill()
        self.process.wait()

    def _answers(self) -> bool:
        assert self.process.poll() is None, "the S3 server ended"
        with contextlib.suppress(httpx.TransportError):
            made = httpx.put(f"http://127.0.0.1:{self.port}/bucket", timeout=10, headers=_SIGNED)
            return made.status_code in (200, 409)
        return False


@contextlib.contextmanager
def s3_server(folder: Path) -> Iterator[S3Server]:
    """Run an S3 server; skip the test where there is none to run."""
    program = shutil.which("moto_server", path=f"{SERVERS / 'bin'}:{os.environ['PATH']}")
    if program is None:
        pytest.skip(NO_S3)
    server = S3Server(Path(program), folder)
    try:
        yield server
    finally:
        server.stop()


@contextlib.contextmanager
def shared_parts(folder: Path) -> Iterator[dict[str, str]]:
    """Run a Redis, a PostgreSQL and an S3; yields the settings of a service that works on them."""
    with postgresql() as database, s3_server(folder) as s3, EmbeddedRedis(folder / "redis") as redis:
        yield {
            "redis_url": redis.url,
            "database_url": database.database(),
            "blob_url": "s3://bucket/spicd",
            **s3.environment(),
        }
