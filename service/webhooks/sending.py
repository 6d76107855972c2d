"""One attempt at a webhook: a signed POST (Standard Webhooks 1.0.0) of a CloudEvent (structured mode)."""

from __future__ import annotations

import ssl
from collections.abc import Sequence
from datetime import datetime

import httpcore
import httpx
from pydantic_core import to_json
from standardwebhooks import Webhook

from service.catalog.following.deliveries import Outcome, Task
from service.catalog.following.webhooks import PING
from service.catalog.sql.tables import now
from service.cloud_events import MEDIA_TYPE, cloud_event, document
from service.webhooks.addresses import AddressRefused, CheckedBackend, Network, Resolve, resolve

LIMIT_S = 15.0  #: for all of an attempt (the standard recommends 15 to 30 s)


class Sender:
    """Sends; any number of threads may do so at once."""

    def __init__(
        self,
        *,
        allowed: Sequence[Network] = (),
        resolve: Resolve = resolve,
        tls: ssl.SSLContext | None = None,
        limit_s: float = LIMIT_S,
        root: str = "",
    ) -> None:
        """Connect to public addresses and `allowed` networks; `root` stands before the paths of links."""
        self._allowed, self._resolve, self._limit_s, self._root = allowed, resolve, limit_s, root
        self._tls = tls or httpcore.default_ssl_context()

    def send(self, task: Task) -> Outcome:
        """Make one attempt, and return what came of it; whatever goes wrong is an outcome."""
        body = body_of(task, root=self._root)
        try:
            answered = self._post(task.url, body, headers_of(task, body, now()))
        except AddressRefused as error:
            return Outcome(error=str(error))
        except (httpcore.TimeoutException, TimeoutError):
            return Outcome(error=f"no answer within {self._limit_s:g} s")
        except httpcore.ConnectError as error:
            return Outcome(error=f"no connection: {_first_line(error)}")
        except (httpcore.NetworkError, httpcore.ProtocolError, httpx.InvalidURL, OSError) as error:
            return Outcome(error=f"no answer: {_first_line(error)}")
        if 200 <= answered < 300:
            return Outcome(answered=answered)
        redirected = ", which is not followed" if 300 <= answered < 400 else ""
        return Outcome(answered=answered, error=f"the receiver answered {answered}{redirected}")

    def _post(self, url: str, body: bytes, headers: dict[str, str]) -> int:
        """Post, and return the status of the answer; its body is not read."""
        parsed = httpx.URL(url)
        backend = CheckedBackend(
            secure=parsed.scheme == "https",
            allowed=self._allowed,
            limit_s=self._limit_s,
            resolve=self._resolve,
        )
        timeouts = dict.fromkeys(("connect", "read", "write", "pool"), self._limit_s)
        target = httpcore.URL(
            scheme=parsed.raw_scheme, host=parsed.raw_host, port=parsed.port, target=parsed.raw_path
        )
        with (
            httpcore.ConnectionPool(self._tls, network_backend=backend) as pool,
            pool.stream(
                "POST",
                target,
                headers=list(headers.items()),
                content=body,
                extensions={"timeout": timeouts},
            ) as answer,
        ):
            return answer.status


def body_of(task: Task, *, root: str = "") -> bytes:
    """Return what is sent, the same for each attempt; `root` stands before its paths."""
    if task.event is not None:
        return to_json(cloud_event(task.event, root=root))
    data = {"webhook_id": task.webhook_id, "links": []}
    source = f"{root}/webhooks/{task.webhook_id}"
    return to_json(
        document(task.event_id, PING, source=source, subject=task.webhook_id, time=now(), data=data)
    )


def headers_of(task: Task, body: bytes, instant: datetime) -> dict[str, str]:
    """Return the headers of an attempt, with a signature by each secret of the webhook."""
    signatures = [Webhook(secret).sign(task.event_id, instant, body.decode()) for secret in task.secrets]
    return {
        "Content-Type": f"{MEDIA_TYPE}; charset=utf-8",
        "User-Agent": "spicd-webhooks/1",
        "webhook-id": task.event_id,
        "webhook-timestamp": str(int(instant.timestamp())),
        "webhook-signature": " ".join(signatures),
    }


def _first_line(error: BaseException) -> str:
    """Return what went wrong in a line, in the system's words where it came from there."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.strerror:
            return cause.strerror[:200]
        cause = cause.__cause__ or cause.__context__
    return (str(error).splitlines() or [""])[0][:200] or type(error).__name__
