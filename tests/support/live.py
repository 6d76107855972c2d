"""The API behind a real uvicorn, in a thread of this process: what TestClient cannot show, streams and their end."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from dataclasses import dataclass

import httpx

from service.api.app import create_app
from service.api.http.dependencies import Services
from service.settings import Settings
from service.up.launcher import _serve
from tests.support.samples import RememberingQueue


@dataclass
class Live:
    """A service that answers on the loopback address."""

    url: str
    services: Services
    http: httpx.Client

    def listeners(self) -> int:
        """How many listen for events now."""
        return self.services.listeners.count


@contextlib.contextmanager
def live(settings: Settings, queue: RememberingQueue | None = None) -> Iterator[Live]:
    """Serve the API as `spicd up` does, until the block ends."""
    app = create_app(settings, queue=queue or RememberingQueue())
    with socket.create_server(("127.0.0.1", 0)) as listening, _serve(app, listening, settings):
        url = f"http://127.0.0.1:{listening.getsockname()[1]}"
        with httpx.Client(base_url=url, timeout=20) as client:
            yield Live(url=url, services=app.state.services, http=client)
