"""`spicd scans watch`: what it says when it starts, while nobody answers, and when it ends."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.cli import main, terminal
from service.cli.watch import REFUSED_STATUS, SAID_AGAIN_S, Outage
from service.client import Client

Answer = Callable[[httpx.Request], httpx.Response]
NO_SCAN = httpx.Response(404, json={"type": "urn:spicd:problem:not_found", "title": "Not found"})
NO_MAP = {"title": "Not found", "detail": "no map 'lobby'; GET /maps lists those there are"}


@pytest.fixture
def answers(monkeypatch: pytest.MonkeyPatch) -> dict[str, httpx.Response]:
    """Answers by path; what is not in it does not answer at all."""
    known: dict[str, httpx.Response] = {}

    def answer(request: httpx.Request) -> httpx.Response:
        if (found := known.get(request.url.path)) is None:
            raise httpx.ConnectError("refused")
        return found

    transport = httpx.MockTransport(answer)
    monkeypatch.setattr(terminal, "Client", lambda url: Client(url, transport=transport))
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    return known


def watch(folder: Path, *words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(
            [
                "scans",
                "watch",
                str(folder),
                "--once",
                "--settle",
                "0",
                "--url",
                "http://robot.example",
                *words,
            ]
        )
    return int(ended.value.code or 0)


def test_it_says_for_whom_and_which_map(
    answers: dict[str, httpx.Response], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    answers["/maps/lobby"] = httpx.Response(200, json={"map_id": "lobby", "version": 2, "status": "building"})
    assert watch(tmp_path, "--map", "lobby") == 0
    said = capsys.readouterr().err
    assert f"watching {tmp_path} for http://robot.example, map lobby (version 2, building)" in said


def test_a_map_that_is_none_ends_it_at_once(
    answers: dict[str, httpx.Response], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    answers["/maps/lobby"] = httpx.Response(404, json=NO_MAP)
    assert watch(tmp_path, "--map", "lobby") == 1
    said = capsys.readouterr().err
    assert (
        "no map 'lobby'; `spicd maps list` shows those there are, `spicd maps create SCAN --id lobby`" in said
    )


def test_a_key_that_may_not_see_maps_watches_all_the_same(
    answers: dict[str, httpx.Response], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    answers["/maps/lobby"] = httpx.Response(403, json={"title": "Forbidden"})
    answers["/scans/none"] = NO_SCAN
    assert watch(tmp_path, "--map", "lobby") == 0
    assert "robot.example, map lobby\n" in capsys.readouterr().err


@pytest.mark.parametrize(
    "answer",
    [
        None,
        httpx.Response(401, json={"type": "x", "title": "No key"}),
        httpx.Response(404, text="another server"),
    ],
    ids=["nobody", "no key", "another"],
)
def test_a_wrong_address_or_key_is_noticed_with_nothing_to_send(
    answers: dict[str, httpx.Response], tmp_path: Path, answer: httpx.Response | None
) -> None:
    if answer is not None:
        answers["/scans/none"] = answer
    assert watch(tmp_path) == 1


def test_a_refused_file_has_a_status_of_its_own(
    answers: dict[str, httpx.Response], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    answers["/scans/none"] = NO_SCAN
    (tmp_path / "hall.ply").write_bytes(b"ply\nformat ascii 1.0\n")
    assert watch(tmp_path, "--json") == REFUSED_STATUS == 3
    event: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert event["event"] == "refused"
    assert "cut off in its header" in event["problem"]["detail"]


def test_an_outage_is_told_once_and_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [1000.0]
    monkeypatch.setattr("service.cli.watch.time.monotonic", lambda: now[0])
    said: list[str] = []
    outage = Outage(note=said.append, url="http://robot.example", left=lambda: 6)
    outage.waiting(0.5, "the service at http://robot.example does not answer (connection refused)")
    assert said == []
    for _ in range(22):
        now[0] += 27
        outage.waiting(27, "the service at http://robot.example does not answer (connection refused)")
    assert len(said) == 1
    assert said[0].endswith("does not answer (connection refused); 6 scans wait, next attempt in 27 s")
    now[0] += SAID_AGAIN_S
    outage.waiting(27, "the service at http://robot.example does not answer (connection refused)")
    outage.over()
    outage.over()
    assert len(said) == 3
    assert said[2].endswith("http://robot.example answers again")
