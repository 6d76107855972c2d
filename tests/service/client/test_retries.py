"""When a call is tried again, after how long, and when no more."""

from __future__ import annotations

import itertools
import json
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime

import httpx
import pytest

from service.client import Client, ClientError, RequestRefused, Retries, Unreachable
from service.client.errors import refused
from service.client.retries import passes

PROBLEM = {"title": "The queue is full", "detail": "1000 jobs wait"}


def answer(status: int, **headers: str) -> httpx.Response:
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return httpx.Response(status, headers=named, json=PROBLEM)


@pytest.mark.parametrize(
    ("response", "again"),
    [
        (answer(429), True),
        (answer(502), True),
        (answer(503, Retry_After="3"), True),
        (answer(504), True),
        (answer(409, Retry_After="1"), True),  # the first request of this key is still under way
        (answer(409), False),
        (answer(422), False),
        (answer(404), False),
        (answer(500), False),
        (answer(507), False),
    ],
)
def test_what_passes_is_tried_again_and_a_refusal_is_not(response: httpx.Response, again: bool) -> None:
    assert passes(refused(response)) == again


def test_a_wrong_address_is_wrong_for_good() -> None:
    with Client("gopher://here") as client, pytest.raises(Unreachable) as error:
        client.jobs()
    assert not passes(error.value)


def test_pauses_double_half_of_them_chance_and_stay_below_the_longest() -> None:
    retries = Retries(first_pause_s=0.25, longest_pause_s=8)
    for attempt, longest in enumerate([0.25, 0.5, 1, 2, 4, 8, 8], start=1):
        pauses = [retries.pause_s(attempt) for _ in range(200)]
        assert longest / 2 <= min(pauses) < longest * 0.6 < longest * 0.9 < max(pauses) <= longest


@pytest.mark.parametrize("form", ["seconds", "date"])
def test_retry_after_is_waited_for_in_either_form_of_rfc_9110(form: str) -> None:
    said = (
        "20"
        if form == "seconds"
        else format_datetime(datetime.now(UTC) + timedelta(seconds=20.9), usegmt=True)
    )
    error = refused(answer(503, Retry_After=said))
    assert 19 <= Retries(first_pause_s=0.25).pause_s(1, error) <= 21.3


@pytest.mark.parametrize("said", ["", "soon", "-3", "²"])
def test_a_retry_after_that_says_nothing_is_none(said: str) -> None:
    assert refused(httpx.Response(503, headers=[(b"Retry-After", said.encode())])).retry_after_s is None


def counting(response: httpx.Response | Exception) -> tuple[httpx.MockTransport, list[httpx.Request]]:
    requests: list[httpx.Request] = []

    def serve(request: httpx.Request) -> httpx.Response:
        requests.append(request)
        if isinstance(response, Exception):
            raise response
        return response

    return httpx.MockTransport(serve), requests


def test_attempts_end_by_their_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    transport, requests = counting(answer(503))
    with Client(transport=transport, retries=Retries(attempts=4)) as client, pytest.raises(RequestRefused):
        client.create_map(["scan-1"])
    assert len(requests) == 4
    assert len({request.headers["Idempotency-Key"] for request in requests}) == 1


def test_a_pause_that_would_pass_the_time_is_not_begun(monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: list[float] = []
    monkeypatch.setattr("time.sleep", pauses.append)
    transport, requests = counting(answer(503, Retry_After="90"))
    with (
        Client(transport=transport, retries=Retries(within_s=60)) as client,
        pytest.raises(RequestRefused) as error,
    ):
        client.jobs()
    assert len(requests) == 1
    assert pauses == []
    assert error.value.retry_after_s == 90


def test_where_nobody_ever_answered_it_is_told_after_two_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = itertools.accumulate(itertools.repeat(0.3))
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    transport, requests = counting(httpx.ConnectError("refused"))
    with Client(transport=transport, retries=Retries(attempts=1000)) as client, pytest.raises(Unreachable):
        client.jobs()
    assert 2 <= len(requests) < 8


def test_each_call_has_a_key_of_its_own() -> None:
    transport, requests = counting(httpx.Response(202, json={"map_id": "lobby", "job_id": "job-1"}))
    with Client(transport=transport) as client:
        client.create_map(["scan-1"])
        client.create_map(["scan-1"])
    first, second = (request.headers["Idempotency-Key"] for request in requests)
    assert first != second


def test_a_next_page_on_another_host_is_not_asked_for_with_the_key() -> None:
    links = [{"rel": "next", "href": "https://elsewhere.example/maps"}]
    transport, requests = counting(httpx.Response(200, json={"maps": [], "links": links}))
    with (
        Client("http://here", transport=transport, key="spicd_1") as client,
        pytest.raises(ClientError, match="another service"),
    ):
        client.maps()
    assert len(requests) == 1


def test_links_are_followed_behind_a_path_prefix() -> None:
    def serve(request: httpx.Request) -> httpx.Response:
        if request.url.query:
            return httpx.Response(200, json={"maps": [{"map_id": "hall"}], "links": []})
        links = [{"rel": "next", "href": f"{request.url.path}?cursor=abc"}]
        return httpx.Response(200, json={"maps": [{"map_id": "lobby"}], "links": links})

    with Client("http://here/spicd", transport=httpx.MockTransport(serve)) as client:
        assert [one["map_id"] for one in client.maps()] == ["lobby", "hall"]


POSE: list[list[float]] = [[1, 0, 0, 2.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def test_a_pose_of_one_map_alone_goes_with_its_scan_and_the_order_stays() -> None:
    transport, requests = counting(httpx.Response(202, json={"map_id": "lobby", "job_id": "job-1"}))
    with Client(transport=transport) as client:
        client.create_map(["scan-1", "scan-2"], poses={"scan-2": POSE})
        with pytest.raises(ClientError, match="scan-3"):
            client.submit_survey("lobby", ["scan-1"], poses={"scan-3": POSE})
    (request,) = requests
    assert json.loads(request.content) == {
        "scans": [{"scan_id": "scan-1"}, {"scan_id": "scan-2", "pose": POSE}]
    }


def test_waiting_looks_less_and_less_often_and_heeds_retry_after(monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: list[float] = []
    monkeypatch.setattr("time.sleep", pauses.append)
    running = httpx.Response(200, json={"status": "running"})
    asked = httpx.Response(200, json={"status": "running"}, headers={"Retry-After": "7"})
    answers = [asked, *[running] * 20, httpx.Response(200, json={"status": "successful"})]
    transport = httpx.MockTransport(lambda request: answers.pop(0))
    with Client(transport=transport) as client:
        assert client.wait("job-1")["status"] == "successful"
    assert pauses[0] == 7
    assert pauses[1:] == sorted(pauses[1:])
    assert pauses[1] < 0.4
    assert pauses[-1] == 2


@pytest.mark.parametrize(
    ("ending", "sent"),
    [
        (httpx.ReadError("the answer is lost"), 1),
        (httpx.Response(502), 1),
        (httpx.Response(429), 4),
        (httpx.ConnectError("refused"), 4),
    ],
)
def test_what_makes_a_secret_is_sent_again_only_where_it_surely_did_not_arrive(
    monkeypatch: pytest.MonkeyPatch, ending: httpx.Response | Exception, sent: int
) -> None:
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    transport, requests = counting(ending)
    with Client(transport=transport, retries=Retries(attempts=4)) as client, pytest.raises(ClientError):
        client.rotate_webhook("webhook-1")
    assert len(requests) == sent
    assert "Idempotency-Key" not in requests[0].headers
