"""Which addresses a webhook may reach: those of the public internet, and what an operator allows.

Whoever may make a webhook could otherwise have the service ask for what only its own network sees (server-side request
forgery). A name is resolved here, every address that it has is looked at, and the connection goes to an address that
was: a name that says something else a moment later (DNS rebinding) gains nothing. Redirects are not followed.
"""

from __future__ import annotations

import contextlib
import ipaddress
import re
import socket
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import httpcore
import httpx

from service.errors import BadRequest

Address = ipaddress.IPv4Address | ipaddress.IPv6Address
Network = ipaddress.IPv4Network | ipaddress.IPv6Network
#: Returns the addresses of a host. Raises OSError.
Resolve = Callable[[str, int], Sequence[str]]

MAX_URL = 2000  #: letters
MAX_ANSWER = 64 * 1024  #: bytes that are read of an answer, its header in all; the body is not looked at
_HOST = re.compile(r"[A-Za-z0-9._-]+|[0-9A-Fa-f:.]+")  #: a name in ASCII (IDNA), or an address

#: IPv6 addresses that lead to an IPv4 address inside of them, or to where only this network knows.
_REFUSED = tuple(
    map(
        ipaddress.ip_network,
        (
            "::/96",  # IPv4-compatible (RFC 4291, Section 2.5.5.1), the unspecified address and loopback
            "::ffff:0:0/96",  # IPv4-mapped (Section 2.5.5.2)
            "64:ff9b::/96",  # NAT64 (RFC 6052)
            "64:ff9b:1::/48",  # local NAT64 (RFC 8215)
            "2001::/32",  # Teredo (RFC 4380)
            "2002::/16",  # 6to4 (RFC 3056)
            "fec0::/10",  # site-local (RFC 3879)
            "192.88.99.0/24",  # relays of 6to4 (RFC 7526)
            "100.64.0.0/10",  # shared by customers of a provider, CGNAT (RFC 6598)
        ),
    )
)


class AddressRefused(Exception):
    """A webhook leads where it may not; `str()` names the host and not the address that it has inside."""


def networks(texts: Iterable[str]) -> tuple[Network, ...]:
    """Return networks in CIDR notation. Raises ValueError."""
    return tuple(ipaddress.ip_network(text) for text in texts)


def is_public(address: Address) -> bool:
    """Tell whether an address is one of the public internet."""
    within = any(address in network for network in _REFUSED if network.version == address.version)
    return address.is_global and not (within or address.is_multicast or address.is_reserved)


def check(host: str, address: str, *, secure: bool, allowed: Iterable[Network]) -> None:
    """Raise AddressRefused where an address of a host may not be reached, or not without TLS (`secure`)."""
    parsed = ipaddress.ip_address(address.partition("%")[0])
    if any(parsed in network for network in allowed if network.version == parsed.version):
        return
    if not is_public(parsed):
        raise AddressRefused(
            f"{host!r} is no host of the public internet; SPICD_WEBHOOK_ALLOWED_NETWORKS names others that may be reached"
        )
    if not secure:
        raise AddressRefused(f"{host!r} is asked without TLS; give a URL with https")


def checked_url(url: str, *, allowed: Iterable[Network]) -> str:
    """Return a URL that may be one of a webhook, as it is sent. Raises BadRequest.

    What its name leads to is looked at again each time that something is sent.
    """
    try:
        parsed = httpx.URL(url)
        host = parsed.raw_host.decode()
    except (httpx.InvalidURL, UnicodeError) as error:
        raise BadRequest(f"{url[:80]!r} is no URL") from error
    if parsed.scheme not in ("https", "http") or not _HOST.fullmatch(host) or len(url) > MAX_URL:
        raise BadRequest("give an https URL with a host, of at most 2000 letters")
    if parsed.userinfo or parsed.fragment:
        raise BadRequest("the URL of a webhook has no name and password, and no fragment")
    with contextlib.suppress(ValueError):
        ipaddress.ip_address(host)
        try:
            check(host, host, secure=parsed.scheme == "https", allowed=allowed)
        except AddressRefused as error:
            raise BadRequest(str(error)) from error
    if parsed.scheme == "http" and not tuple(allowed):
        raise BadRequest("give an https URL: without TLS everybody on the way reads what is sent")
    return str(parsed)


def resolve(host: str, port: int) -> Sequence[str]:
    """Return every address of a host, those of IPv4 first. Raises OSError."""
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    found.sort(key=lambda entry: entry[0] != socket.AF_INET)
    return tuple(dict.fromkeys(str(entry[4][0]) for entry in found))


class CheckedBackend(httpcore.NetworkBackend):
    """Connects to checked addresses alone, and ends everything at one instant."""

    def __init__(
        self, *, secure: bool, allowed: Sequence[Network], limit_s: float, resolve: Resolve = resolve
    ) -> None:
        self._secure, self._allowed, self._resolve = secure, allowed, resolve
        self._until = time.monotonic() + limit_s
        self._inner = httpcore.SyncBackend()

    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.NetworkStream:
        """Connect to the first address of a host that answers. Raises AddressRefused where any may not be reached."""
        try:
            addresses = self._resolve(host, port)
        except (OSError, UnicodeError) as error:
            raise httpcore.ConnectError("its name has no address") from error
        for address in addresses:
            check(host, address, secure=self._secure, allowed=self._allowed)
        last: Exception = httpcore.ConnectError("its name has no address")
        for address in addresses:
            try:
                stream = self._inner.connect_tcp(
                    address, port, _left(self._until, timeout), local_address, socket_options
                )
            except (httpcore.ConnectError, httpcore.ConnectTimeout) as error:
                last = error
                continue
            peer = stream.get_extra_info("server_addr")  # the last word has the connection itself
            check(host, str(peer[0]), secure=self._secure, allowed=self._allowed)
            return _BoundedStream(stream, self._until)
        raise last

    def connect_unix_socket(self, *_: Any, **__: Any) -> httpcore.NetworkStream:
        """Refuse: no URL names one."""
        raise AddressRefused("a webhook is sent over the network")

    def sleep(self, seconds: float) -> None:
        """Wait; nothing here does."""
        self._inner.sleep(seconds)


class _BoundedStream(httpcore.NetworkStream):
    """A connection that ends at an instant however slowly the other side goes on, and after so many bytes."""

    def __init__(self, inner: httpcore.NetworkStream, until: float) -> None:
        self._inner, self._until, self._taken = inner, until, 0

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        """Read some bytes. Raises ReadTimeout, and ReadError where there are too many."""
        data = self._inner.read(max_bytes, _left(self._until, timeout))
        self._taken += len(data)
        if self._taken > MAX_ANSWER:
            raise httpcore.ReadError(f"the answer has more than {MAX_ANSWER} bytes")
        return data

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        """Write all of it. Raises WriteTimeout."""
        self._inner.write(buffer, _left(self._until, timeout))

    def close(self) -> None:
        """Close it."""
        self._inner.close()

    def start_tls(
        self, ssl_context: Any, server_hostname: str | None = None, timeout: float | None = None
    ) -> httpcore.NetworkStream:
        """Speak TLS from now on, with the name of the URL and not the address."""
        stream = self._inner.start_tls(ssl_context, server_hostname, _left(self._until, timeout))
        return _BoundedStream(stream, self._until)

    def get_extra_info(self, info: str) -> Any:
        """Tell of the connection."""
        return self._inner.get_extra_info(info)


def _left(until: float, timeout: float | None) -> float:
    """Return how long one wait may be; at the end none, which fails at once."""
    left = max(until - time.monotonic(), 0.001)
    return left if timeout is None else min(left, timeout)
