"""A link as a robot has it: a TCP proxy with so many bytes a second, that breaks every connection from time to time."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Iterator

_PIECE = 8 << 10


class BadLink:
    """Passes connections on to a port of this machine; both ways share `rate` bytes a second each."""

    def __init__(self, port: int, *, rate: float, drop_every_s: float | None = None) -> None:
        self.target = port
        self.sent = self.drops = 0  #: bytes towards the service; connections that were broken
        self._rate, self._drop_every_s = rate, drop_every_s
        self._open: set[socket.socket] = set()
        self._lock = threading.Lock()
        self._free_at = time.monotonic()
        self._over = threading.Event()
        self._listening = socket.create_server(("127.0.0.1", 0), backlog=100)
        self.port = int(self._listening.getsockname()[1])
        threading.Thread(target=self._accept, daemon=True).start()
        if drop_every_s is not None:
            threading.Thread(target=self._break, daemon=True).start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def drop(self) -> None:
        """Break every connection as a link that is gone does: with a reset."""
        with self._lock:
            broken, self._open = self._open, set()
        for one in broken:
            with contextlib.suppress(OSError):
                one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                one.shutdown(socket.SHUT_RDWR)
            one.close()
        self.drops += len(broken) // 2

    def close(self) -> None:
        self._over.set()
        self._listening.close()
        self.drop()

    def _accept(self) -> None:
        while not self._over.is_set():
            try:
                here, _ = self._listening.accept()
            except OSError:
                return
            try:
                there = socket.create_connection(("127.0.0.1", self.target))
            except OSError:
                here.close()
                continue
            here.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2 * _PIECE)
            with self._lock:
                self._open |= {here, there}
            threading.Thread(target=self._pump, args=(here, there, True), daemon=True).start()
            threading.Thread(target=self._pump, args=(there, here, False), daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket, up: bool) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(_PIECE):
                if up:
                    self._wait(len(data))
                    self.sent += len(data)
                sink.sendall(data)
            sink.shutdown(socket.SHUT_WR)

    def _wait(self, size: int) -> None:
        """Wait for so many bytes of the link, which all connections share."""
        with self._lock:
            self._free_at = max(self._free_at, time.monotonic()) + size / self._rate
            until = self._free_at
        time.sleep(max(0.0, until - time.monotonic()))

    def _break(self) -> None:
        while not self._over.wait(self._drop_every_s):
            self.drop()


@contextlib.contextmanager
def bad_link(port: int, *, rate: float, drop_every_s: float | None = None) -> Iterator[BadLink]:
    link = BadLink(port, rate=rate, drop_every_s=drop_every_s)
    try:
        yield link
    finally:
        link.close()
