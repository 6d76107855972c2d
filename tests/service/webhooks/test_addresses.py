"""Which addresses a webhook may reach; what a name leads to is looked at when it is connected to."""

from __future__ import annotations

import socket
import ssl
import subprocess
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from service.catalog.following.deliveries import Outcome, Task
from service.catalog.following.webhooks import new_secret
from service.errors import BadRequest
from service.webhooks import addresses
from service.webhooks.addresses import AddressRefused, check, checked_url, networks
from service.webhooks.sending import Sender
from tests.support.receivers import Receiver
from tests.support.servers import SilentServer

LOOPBACK = networks(["127.0.0.0/8"])

INSIDE = [
    "127.0.0.1",  # loopback
    "127.9.9.9",
    "0.0.0.0",  # unspecified: this machine
    "10.0.0.1",  # private (RFC 1918)
    "172.16.0.1",
    "192.168.1.1",
    "169.254.169.254",  # link-local: the metadata of clouds
    "100.64.0.1",  # CGNAT
    "192.0.0.1",  # assignments of protocols
    "192.0.2.1",  # documentation
    "192.88.99.1",  # relays of 6to4
    "198.18.0.1",  # benchmarks
    "224.0.0.1",  # multicast
    "239.1.1.1",
    "240.0.0.1",  # reserved
    "255.255.255.255",  # broadcast
    "::",
    "::1",
    "::127.0.0.1",  # IPv4-compatible
    "::ffff:127.0.0.1",  # IPv4-mapped
    "::ffff:8.8.8.8",
    "64:ff9b::7f00:1",  # NAT64 of 127.0.0.1
    "64:ff9b::808:808",  # and of a public address: it is a way around this check
    "64:ff9b:1::a00:1",  # local NAT64
    "2001:0:1::1",  # Teredo
    "2002:7f00:1::",  # 6to4 of 127.0.0.1
    "2001:db8::1",  # documentation
    "fc00::1",  # unique local
    "fd12:3456::1",
    "fe80::1",  # link-local
    "fe80::1%eth0",
    "fec0::1",  # site-local
    "ff02::1",  # multicast
]
PUBLIC = ["8.8.8.8", "93.184.216.34", "2606:4700:4700::1111", "2a00:1450:4001:81b::200e"]


def task(url: str) -> Task:
    """An attempt to make."""
    return Task(
        webhook_id="webhook-1",
        delivery_id="delivery-1",
        kind="ping",
        event=None,
        event_id="event-1",
        url=url,
        secrets=(new_secret(),),
        claim="claim-1",
    )


class Names:
    """A resolver of the test: what each look-up answers, the last answer for all later ones."""

    def __init__(self, *answers: Sequence[str]) -> None:
        self._answers = list(answers)
        self.asked = 0

    def __call__(self, host: str, port: int) -> Sequence[str]:
        self.asked += 1
        return self._answers.pop(0) if len(self._answers) > 1 else self._answers[0]


@pytest.mark.parametrize("address", INSIDE)
def test_what_is_not_of_the_public_internet_is_refused(address: str) -> None:
    with pytest.raises(AddressRefused):
        check("example.org", address, secure=True, allowed=())
    outcome = Sender(resolve=Names([address])).send(task("https://example.org/hook"))
    assert (outcome.answered, "no host of the public internet" in str(outcome.error)) == (None, True)


@pytest.mark.parametrize("address", PUBLIC)
def test_what_is_public_is_reached_by_tls_alone(address: str) -> None:
    check("example.org", address, secure=True, allowed=())
    with pytest.raises(AddressRefused, match="without TLS"):
        check("example.org", address, secure=False, allowed=())


def test_an_operator_allows_a_network_and_no_other() -> None:
    allowed = networks(["10.1.0.0/16", "fd00::/8"])
    check("inside", "10.1.2.3", secure=False, allowed=allowed)
    check("inside", "fd12::1", secure=False, allowed=allowed)
    with pytest.raises(AddressRefused):
        check("inside", "10.2.0.1", secure=True, allowed=allowed)


def test_a_name_that_leads_to_the_service_itself_is_refused_when_it_is_connected_to() -> None:
    with Receiver() as receiver:
        port = receiver.url.split(":")[2].partition("/")[0]
        outcome = Sender().send(task(f"https://localhost:{port}/hook"))
        assert outcome == Outcome(
            error="'localhost' is no host of the public internet; SPICD_WEBHOOK_ALLOWED_NETWORKS names others that may "
            "be reached"
        )
        assert receiver.received == []


def test_one_address_inside_is_enough_to_refuse_a_name() -> None:
    outcome = Sender(resolve=Names(["93.184.216.34", "127.0.0.1"])).send(task("https://example.org/"))
    assert "no host of the public internet" in str(outcome.error)


def test_a_name_that_says_something_else_later_gains_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """DNS rebinding: public at the first look-up, loopback at the next. There is one look-up an attempt."""
    connected: list[str] = []

    def connect(address: tuple[str, int], *_: object, **__: object) -> socket.socket:
        connected.append(address[0])
        raise ConnectionRefusedError(111, "Connection refused")

    monkeypatch.setattr(socket, "create_connection", connect)
    names = Names(["93.184.216.34"], ["127.0.0.1"])
    sender = Sender(resolve=names)
    assert "Connection refused" in str(sender.send(task("https://example.org/")).error)
    assert (connected, names.asked) == (["93.184.216.34"], 1)
    assert "public internet" in str(sender.send(task("https://example.org/")).error)
    assert connected == ["93.184.216.34"]


def test_the_connection_itself_has_the_last_word(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where something between us and the net leads a public address elsewhere, the peer is looked at."""
    with Receiver() as receiver:
        port = int(receiver.url.split(":")[2].partition("/")[0])
        real = socket.create_connection

        def led_astray(_: tuple[str, int], timeout: float, **options: object) -> socket.socket:
            return real(("127.0.0.1", port), timeout)

        monkeypatch.setattr(socket, "create_connection", led_astray)
        outcome = Sender(resolve=Names(["93.184.216.34"])).send(task("https://example.org/"))
    assert "no host of the public internet" in str(outcome.error)


def test_a_redirect_is_an_outcome_and_is_not_followed() -> None:
    with Receiver() as target, Receiver(answers=[307], headers={"Location": target.url}) as receiver:
        outcome = Sender(allowed=LOOPBACK).send(task(receiver.url))
        assert (outcome.answered, outcome.delivered) == (307, False)
        assert "not followed" in str(outcome.error)
        assert target.received == []


def test_a_host_that_says_nothing_ends_the_attempt_in_time() -> None:
    server = SilentServer()
    outcome = Sender(allowed=LOOPBACK, limit_s=0.3).send(task(f"http://127.0.0.1:{server.port}/"))
    server.close()
    assert outcome.error == "no answer within 0.3 s"


def test_a_host_that_says_a_letter_now_and_then_ends_it_as_well() -> None:
    over = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def drip() -> None:
            taken, _ = listening.accept()
            with taken:
                for letter in b"HTTP/1.1 200 OK\r\nX-Slow: " + b"x" * 10_000:
                    if over.wait(0.05):
                        return
                    try:
                        taken.sendall(bytes([letter]))
                    except OSError:
                        return

        thread = threading.Thread(target=drip)
        thread.start()
        url = f"http://127.0.0.1:{listening.getsockname()[1]}/"
        outcome = Sender(allowed=LOOPBACK, limit_s=0.5).send(task(url))
        over.set()
        thread.join(10)
    assert outcome.error == "no answer within 0.5 s"


def test_an_answer_that_goes_on_and_on_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(addresses, "MAX_ANSWER", 1000)
    server = SilentServer(b"HTTP/1.1 200 OK\r\nX-Long: " + b"x" * 5000)
    outcome = Sender(allowed=LOOPBACK, limit_s=5).send(task(f"http://127.0.0.1:{server.port}/"))
    server.close()
    assert outcome.error == "no answer: the answer has more than 1000 bytes"


@pytest.mark.parametrize(
    ("url", "why"),
    [
        ("ftp://example.org/", "https URL"),
        ("https:///hook", "https URL"),
        ("example.org/hook", "https URL"),
        ("https://name:word@example.org/", "no name and password"),
        ("https://example.org/#part", "no fragment"),
        ("http://example.org/", "without TLS"),
        ("https://127.0.0.1/", "public internet"),
        ("https://[::1]/", "public internet"),
        ("https://[::ffff:10.0.0.1]/", "public internet"),
        ("https://169.254.169.254/latest/meta-data", "public internet"),
        ("https://example.org/" + "x" * 2000, "2000 letters"),
        ("https://exa mple.org/", "URL"),
        ("https://0177.0.0.1/", "URL"),
    ],
)
def test_a_url_that_cannot_be_one_is_refused_at_once(url: str, why: str) -> None:
    with pytest.raises(BadRequest, match=why):
        checked_url(url, allowed=())


@pytest.mark.parametrize("host", ["2130706433", "0x7f000001", "127.1"])
def test_other_spellings_of_loopback_are_refused_when_connected_to(host: str) -> None:
    """The system's resolver reads them as inet_aton(3) does."""
    outcome = Sender(limit_s=5).send(task(f"https://{host}/"))
    assert outcome.answered is None
    assert "public internet" in str(outcome.error) or "no address" in str(outcome.error)


@pytest.fixture
def certificate(tmp_path: Path) -> Path:
    """A key and a certificate of `hooks.example` that it signed itself."""
    file = tmp_path / "server.pem"
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1"]
    command += ["-subj", "/CN=hooks.example", "-addext", "subjectAltName=DNS:hooks.example"]
    command += ["-keyout", str(tmp_path / "key"), "-out", str(tmp_path / "crt")]
    subprocess.run(command, check=True, capture_output=True)
    file.write_text((tmp_path / "key").read_text() + (tmp_path / "crt").read_text())
    return file


@pytest.fixture
def tls_receiver(certificate: Path) -> Iterator[Receiver]:
    with Receiver() as receiver:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(certificate)
        server = receiver._server
        server.socket = context.wrap_socket(server.socket, server_side=True)
        yield receiver


def test_tls_is_spoken_with_the_name_and_not_with_the_address(
    certificate: Path, tls_receiver: Receiver
) -> None:
    trusting = ssl.create_default_context(cafile=str(certificate))
    sender = Sender(allowed=LOOPBACK, resolve=Names(["127.0.0.1"]), tls=trusting)
    port = tls_receiver._server.server_port
    assert sender.send(task(f"https://hooks.example:{port}/")) == Outcome(answered=204)
    (request,) = tls_receiver.received
    assert request.headers["Host"] == f"hooks.example:{port}"
    wrong = sender.send(task(f"https://other.example:{port}/"))
    assert "certificate" in str(wrong.error).lower()
    unknown = Sender(allowed=LOOPBACK, resolve=Names(["127.0.0.1"])).send(
        task(f"https://hooks.example:{port}/")
    )
    assert "certificate" in str(unknown.error).lower()
