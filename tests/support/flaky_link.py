"""Bad Wi-Fi between a client and a server: a proxy that is slow, and breaks each connection off after a while."""

from __future__ import annotations

import asyncio
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from socket import SO_LINGER, SOL_SOCKET
from typing import Any
from urllib.parse import urlsplit

_PIECE = 8192  #: bytes that go through at a time


@dataclass
class FlakyLink:
    """One link: all of its connections share the rate, and each is reset after `drops_after_s`."""

    server: str  #: URL of the server behind it
    bytes_a_second: float
    drops_after_s: float
    url: str = ""  #: what the client is told instead of the server's
    dropped: int = 0  #: connections
    sent: int = 0  #: bytes from the client
    _free_at: float = 0.0  #: loop's time at which the link may carry the next piece

    async def carry(self, from_client: asyncio.StreamReader, to_client: asyncio.StreamWriter) -> None:
        """Carry one connection until an end closes it or its time is over."""
        parts = urlsplit(self.server)
        to_server: asyncio.StreamWriter | None = None
        try:
            from_server, to_server = await asyncio.open_connection(parts.hostname, parts.port)
            both = asyncio.gather(
                self._pump(from_client, to_server, counted=True),
                self._pump(from_server, to_client, counted=False),
            )
            await asyncio.wait_for(both, self.drops_after_s)
        except TimeoutError:
            self.dropped += 1
            for writer in (to_client, to_server):
                _reset(writer)
        except OSError:
            pass
        finally:
            for writer in (to_client, to_server):
                if writer is not None:
                    writer.close()

    async def _pump(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, counted: bool
    ) -> None:
        loop = asyncio.get_running_loop()
        while piece := await reader.read(_PIECE):
            begin = max(self._free_at, loop.time())
            self._free_at = begin + len(piece) / self.bytes_a_second
            await asyncio.sleep(self._free_at - loop.time())
            self.sent += len(piece) if counted else 0
            writer.write(piece)
            await writer.drain()
        with suppress(OSError):
            writer.write_eof()


@contextmanager
def flaky_links(
    count: int, server: str, *, bytes_a_second: float, drops_after_s: float
) -> Iterator[list[FlakyLink]]:
    """Give so many links to a server, each with an address of its own on the loopback interface."""
    links = [FlakyLink(server, bytes_a_second, drops_after_s) for _ in range(count)]
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    servers = [asyncio.run_coroutine_threadsafe(_listen(link), loop).result(10) for link in links]
    try:
        yield links
    finally:
        for listening in servers:
            loop.call_soon_threadsafe(listening.close)
        loop.call_soon_threadsafe(loop.stop)
        thread.join(10)


async def _listen(link: FlakyLink) -> Any:
    server = await asyncio.start_server(link.carry, "127.0.0.1", 0)
    link.url = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}"
    return server


def _reset(writer: asyncio.StreamWriter | None) -> None:
    """End a connection as a lost link shows it: by a reset, with what is still on its way lost."""
    if writer is not None:
        socket = writer.get_extra_info("socket")
        if socket is not None:
            with suppress(OSError):
                socket.setsockopt(SOL_SOCKET, SO_LINGER, struct.pack("ii", 1, 0))
        writer.transport.abort()
