"""One request at a time for each upload; a newer one stops an older one that still receives.

A robot that lost its Wi-Fi comes again on a new connection while the old one, of which nobody knows yet that it is dead,
still waits for bytes. The newer one is who has the upload: the older one keeps what came, and answers 423.
"""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator

import anyio

from service.errors import UploadBusy

TURN_S = 20.0  #: how long a request waits for the older one to keep what came


class Turn:
    """A request's hold on an upload."""

    def __init__(self) -> None:
        self.receiving = anyio.CancelScope()  #: what a newer request may stop: the reading of a body
        self.ended = anyio.Event()

    @property
    def was_stopped(self) -> bool:
        """Whether a newer request has come."""
        return self.receiving.cancel_called


class Turns:
    """Who holds which upload, in this process."""

    def __init__(self) -> None:
        self._turns: dict[str, Turn] = {}

    @contextlib.asynccontextmanager
    async def of(self, upload_id: str) -> AsyncIterator[Turn]:
        """Hold an upload while the block lasts. Raises UploadBusy where the older request does not end in time."""
        with anyio.move_on_after(TURN_S):
            while (older := self._turns.get(upload_id)) is not None:
                older.receiving.cancel()
                await older.ended.wait()
        if upload_id in self._turns:
            raise UploadBusy(f"another request is at work on upload {upload_id!r}; try again shortly")
        turn = self._turns[upload_id] = Turn()
        try:
            yield turn
        finally:
            del self._turns[upload_id]
            turn.ended.set()
