"""`spicd up`: Redis, the database, the API and the workers as one command, and their end as one.

What runs is this process with the API in a thread, the embedded Redis, and the workers. All are children of this
process and end with it, also when it is killed.
"""

from __future__ import annotations

import importlib.util
import ipaddress
import json
import logging
import os
import shutil
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import uvicorn
from fastapi import FastAPI

from service.catalog.catalog import disk_of
from service.catalog.jobs import Jobs
from service.catalog.keys import open_keys
from service.catalog.sql.database import Database
from service.catalog.sql.patience import SUPERVISION
from service.dispatch import Dispatcher
from service.permissions import make_private, private_files
from service.queue import QUEUES, JobQueue
from service.settings import Settings
from service.up.children import WorkerPool
from service.up.connections import limited_protocol, limits_of
from service.up.embedded_redis import EmbeddedRedis, LaunchFailed
from service.up.requirements import require_device, require_model, require_queue

log = logging.getLogger("spicd")

_LOOK_S = 0.2  #: between two looks at the children
_API_STARTS_S = 30.0
KEEP_ALIVE_S = (
    75  #: longer than proxies keep a connection (nginx 60 s), or they would send into one that just closes
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Running:
    """What `spicd up` started, for a person's table and a program's ready file."""

    url: str  #: of the API
    docs: str  #: of its interactive documentation
    data_dir: str
    pid: int  #: of this process, which holds the API
    redis_url: str | None  #: of the embedded Redis; another's address may hold a password and is not told
    redis_pid: int | None
    workers: list[dict[str, Any]]  #: `queue` and `pid` of each

    def document(self) -> dict[str, Any]:
        """Return it as a JSON object."""
        return asdict(self)

    def write(self, path: Path) -> None:
        """Write as JSON, aside and renamed: who finds the file finds all of it."""
        aside = path.with_name(f"{path.name}.{os.getpid()}.part")
        aside.write_text(json.dumps(self.document(), indent=2) + "\n")
        aside.replace(path)


def up(
    settings: Settings,
    *,
    on_ready: Callable[[Running], None],
    create_app: Callable[[Settings], FastAPI] | None = None,
) -> None:
    """Run the service until SIGINT, SIGTERM or SIGHUP; call from the main thread. Raises `LaunchFailed`."""
    _require_worker_packages(settings)
    require_device(settings, environment_of(settings))
    if settings.redis_url is not None:
        require_queue(settings)
    with ExitStack() as stack:
        stop = stack.enter_context(_Signals())
        stack.enter_context(private_files())
        listening = stack.enter_context(_listen(settings.host, settings.port))
        _require_space(settings)
        redis = None
        _make_private(settings.data_dir)
        if settings.redis_url is None:
            redis = stack.enter_context(EmbeddedRedis(settings.data_dir / "redis"))
            sweep_scratch(settings.scratch_dir())  # the folder is ours alone now
            sweep_scratch(settings.data_dir / "incoming")
            _release_claims(redis)
        settings = _resolve(settings, redis, listening)
        _migrate(settings)
        require_model(settings)
        _require_a_key(settings)
        pool = WorkerPool(
            geometry=settings.geometry_workers,
            inference=settings.inference_workers,
            environment=environment_of(settings),
            watcher=stack.enter_context(Supervision(settings)),
        )
        stack.enter_context(pool)
        api = stack.enter_context(_serve((create_app or _app)(settings), listening, settings))
        stop.then = _each(pool.kill, api.stop_now)
        on_ready(_running(settings, redis, pool))
        while not stop.asked:
            pool.check()
            if redis is not None:
                redis.check()
            if not api.is_alive():
                raise LaunchFailed("the API ended by itself; the log says why")
            time.sleep(_LOOK_S)


class Supervision:
    """What the pool of workers tells catalog and queue of its workers; a context manager."""

    def __init__(self, settings: Settings) -> None:
        self._database = Database(settings.resolved_database_url(), patience=SUPERVISION)
        self._queue = JobQueue(settings.redis_url or "", timeout_s=settings.job_timeout_s)
        self._dispatcher = Dispatcher(Jobs(self._database), self._queue)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._queue.close()
        self._database.close()

    def ended(self, name: str, how: str, *, by_itself: bool) -> None:
        """Have what a worker had begun go to another, now."""
        self._dispatcher.worker_ended(name, how, by_itself=by_itself)

    def answering(self) -> frozenset[str]:
        """Return the names of the workers that gave a sign of life."""
        snapshot = self._queue.snapshot()
        return frozenset(name for queue in QUEUES for name in snapshot[queue].answering)


def _make_private(data_dir: Path) -> None:
    try:
        make_private(data_dir)
    except OSError as error:
        raise LaunchFailed(
            f"the data folder {data_dir} cannot be used ({error.strerror}); name another with SPICD_DATA_DIR"
        ) from error


def sweep_scratch(folder: Path) -> None:
    """Remove what steps left that were killed; only while no worker runs on this folder."""
    for left in folder.iterdir() if folder.is_dir() else ():
        if left.is_dir():
            shutil.rmtree(left, ignore_errors=True)
        else:
            left.unlink(missing_ok=True)


def _release_claims(redis: EmbeddedRedis) -> None:
    """Release the claims of earlier workers: all ended with their launcher, and that with the server's lock."""
    queue = JobQueue(redis.url)
    queue.release_claims()
    queue.close()


def environment_of(settings: Settings) -> dict[str, str]:
    """Return this process's environment with every setting spelled out, for the workers."""
    values = settings.model_dump(mode="json", exclude_none=True)
    kept = {name: value for name, value in os.environ.items() if name != "SPICD_KEY"}  # a client's
    return {**kept, **{f"SPICD_{name.upper()}": str(value) for name, value in values.items()}}


class _Signals:
    """Notes that the end was asked for; asked again, it calls `then`."""

    def __init__(self) -> None:
        self.asked = False
        self.then: Callable[[], None] = lambda: None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> _Signals:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, *_: object) -> None:
        if self.asked:
            self.then()
        self.asked = True


@contextmanager
def _listen(host: str, port: int) -> Iterator[socket.socket]:
    """Bind a socket, so that a port that is taken is told before anything else starts."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.socket(family, kind, protocol)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(address)
    except OSError as error:
        raise LaunchFailed(
            f"cannot listen on {host} port {port} ({error.strerror}); name another port with --port, 0 takes a free one"
        ) from error
    with listening:
        yield listening


@dataclass(frozen=True, kw_only=True, slots=True)
class _Api:
    """The API in its thread."""

    server: uvicorn.Server
    thread: threading.Thread

    def is_alive(self) -> bool:
        return self.thread.is_alive()

    def stop_now(self) -> None:
        """Wait for no request any more."""
        self.server.force_exit = True


def _each(*calls: Callable[[], None]) -> Callable[[], None]:
    """Return what makes each call."""

    def call_all() -> None:
        for call in calls:
            call()

    return call_all


class _Server(uvicorn.Server):
    """Ends those who listen for events before it waits for requests: they would listen for minutes."""

    def __init__(self, config: uvicorn.Config, app: FastAPI) -> None:
        super().__init__(config)
        self._app = app

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End the listeners, then the requests, then the app."""
        services = getattr(self._app.state, "services", None)  # a test may bring an app without
        if services is not None:
            services.listeners.end()
        await super().shutdown(sockets)


@contextmanager
def _serve(app: FastAPI, listening: socket.socket, settings: Settings) -> Iterator[_Api]:
    """Serve the API in a thread, from its first answer on; requests that run at the end have the grace to finish."""
    config = uvicorn.Config(
        app,
        http=limited_protocol(limits_of(settings)),
        ws="none",
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_keep_alive=KEEP_ALIVE_S,
        timeout_graceful_shutdown=settings.shutdown_grace_s,
    )
    server = _Server(config, app)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, name="api", daemon=True)
    thread.start()
    until = time.monotonic() + _API_STARTS_S
    while not server.started:
        if not thread.is_alive() or time.monotonic() > until:
            raise LaunchFailed("the API did not start; the log says why")
        time.sleep(0.02)
    try:
        yield _Api(server=server, thread=thread)
    finally:
        server.should_exit = True
        thread.join(settings.shutdown_grace_s + 3)


def _app(settings: Settings) -> FastAPI:
    """Return the service's own API; imported here, for tests of the launcher bring another."""
    from service.api.app import create_app  # noqa: PLC0415

    app = create_app(settings)
    app.openapi()  # derived now: it takes a third of a second, in which no other request would be answered
    return app


def _require_worker_packages(settings: Settings) -> None:
    if settings.geometry_workers + settings.inference_workers == 0:
        return
    missing = [name for name in ("torch", "open3d") if importlib.util.find_spec(name) is None]
    if missing:
        raise LaunchFailed(
            f"{' and '.join(missing)} not installed: pip install 'spicd[worker]', or start the API alone with "
            "SPICD_GEOMETRY_WORKERS=0 SPICD_INFERENCE_WORKERS=0"
        )


def _resolve(settings: Settings, redis: EmbeddedRedis | None, listening: socket.socket) -> Settings:
    """Return the settings with nothing left open, so that every process reads the same."""
    return settings.model_copy(
        update={
            "port": listening.getsockname()[1],
            "data_dir": settings.data_dir.absolute(),
            "redis_url": redis.url if redis else settings.redis_url,
            "database_url": settings.resolved_database_url(),
            "blob_url": settings.resolved_blob_url(),
        }
    )


def _require_space(settings: Settings) -> None:
    """Give up the ballast of a full disk. Raises LaunchFailed where there is none, and where the folder cannot be used."""
    try:
        enough = disk_of(settings).make_room()
    except OSError as error:
        raise LaunchFailed(
            f"the data folder {settings.data_dir} cannot be used ({error.strerror}); name another with SPICD_DATA_DIR"
        ) from error
    if not enough:
        raise LaunchFailed(
            f"the disk of the data folder {settings.data_dir} is full: remove what is not the service's from it, or "
            "enlarge it, and start again; then surveys and maps can be deleted"
        )


def _migrate(settings: Settings) -> None:
    """Migrate the database once, before the API and the workers look at the tables."""
    try:
        database = Database(settings.resolved_database_url())
        disk_of(settings).freeing(database.upgrade)
        database.close()
    except Exception as error:  # whatever the driver raises
        raise LaunchFailed(f"the database cannot be opened: {' '.join(str(error).split())}") from error


def _require_a_key(settings: Settings) -> None:
    """Raise LaunchFailed where others than this machine would reach an API that nobody could ask."""
    if not settings.requires_key():
        return
    with open_keys(settings) as keys:
        if keys.any_valid():
            return
    raise LaunchFailed(
        f"requests to {settings.host} need an API key, and there is none: make one on this data folder or database with "
        "`spicd keys add NAME --scope admin`, or set SPICD_AUTH=none where something in front asks who it is"
    )


def _running(settings: Settings, redis: EmbeddedRedis | None, pool: WorkerPool) -> Running:
    host = _reachable(settings.host)
    url = f"http://{host}:{settings.port}"
    return Running(
        url=url,
        docs=f"{url}/docs",
        data_dir=str(settings.data_dir),
        pid=os.getpid(),
        redis_url=redis.url if redis else None,
        redis_pid=redis.pid if redis else None,
        workers=[{"queue": worker.queue, "pid": worker.pid} for worker in pool.workers],
    )


def _reachable(host: str) -> str:
    """Return the address that was listened on as a browser can open it."""
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host
    if address.is_unspecified:
        return "127.0.0.1" if address.version == 4 else "[::1]"
    return host if address.version == 4 else f"[{host}]"
