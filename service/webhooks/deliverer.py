"""Who delivers: a thread beside each API that looks what is due, and one for each webhook that has something to get.

Several processes and hosts may do so at once: each attempt is claimed in the database first. When the service ends,
attempts that are under way are left; their claims end by themselves, and another process makes them again.
"""

from __future__ import annotations

import logging
import threading
from typing import Self

from service.catalog.following.deliveries import Deliveries
from service.errors import Unavailable
from service.webhooks.sending import Sender

log = logging.getLogger(__name__)

EVERY_S = 0.5  #: between two looks at what is due
AT_ONCE = 8  #: webhooks that are sent to at a time: one that is slow holds up few others
_IN_A_ROW = 50  #: attempts at one webhook before another has its turn
_ENDS_S = 2.0  #: that attempts have to end with the service


class Deliverer:
    """Sends to webhooks for as long as its block lasts; a context manager."""

    def __init__(self, deliveries: Deliveries, sender: Sender, *, every_s: float = EVERY_S) -> None:
        self._deliveries, self._sender, self._every_s = deliveries, sender, every_s
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="webhooks", daemon=True)
        self._at_work: dict[str, threading.Thread] = {}

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join(_ENDS_S)
        for thread in list(self._at_work.values()):
            thread.join(_ENDS_S / AT_ONCE)

    def deliver(self, webhook_id: str) -> bool:
        """Make the next attempt at a webhook; False where there is none, or it was not recorded."""
        task = self._deliveries.claim(webhook_id)
        if task is None or not self._deliveries.still_mine(task):
            return False
        outcome = self._sender.send(task)
        if not outcome.delivered:
            log.info("webhook %s did not take %s: %s", webhook_id, task.event_id, outcome.error)
        return self._deliveries.record(task, outcome)

    def _run(self) -> None:
        silenced = False
        while not self._over.is_set():
            try:
                self._look()
                silenced = False
            except Exception as error:
                if not silenced:
                    log.warning("webhooks cannot be looked at: %s", error, exc_info=not _outage(error))
                silenced = True
            self._over.wait(self._every_s)

    def _look(self) -> None:
        """Have threads deliver what is due."""
        self._at_work = {name: thread for name, thread in self._at_work.items() if thread.is_alive()}
        for webhook_id in self._deliveries.due():
            if webhook_id in self._at_work or len(self._at_work) >= AT_ONCE:
                continue
            thread = threading.Thread(
                target=self._work, args=(webhook_id,), name=f"webhook-{webhook_id[-8:]}", daemon=True
            )
            self._at_work[webhook_id] = thread
            thread.start()

    def _work(self, webhook_id: str) -> None:
        try:
            for _ in range(_IN_A_ROW):
                if self._over.is_set() or not self.deliver(webhook_id):
                    return
        except Exception as error:
            if not self._over.is_set():
                log.warning("webhook %s: %s", webhook_id, error, exc_info=not _outage(error))


def _outage(error: Exception) -> bool:
    return isinstance(error, Unavailable)
