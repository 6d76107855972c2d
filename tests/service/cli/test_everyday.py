"""The commands of every day: lists, downloads, an anchor, tables for a spreadsheet, webhooks, events, completion."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import httpx
import pytest
import typer

from service.cli import main, terminal
from service.cli.main import ALONE, GROUPS, _commands
from service.cli.tables import stage
from service.client import Client
from tests.support.flaky import CLOUD, Flaky, flaky_service
from tests.test_imports import ROOT

Answers = dict[str, Callable[[httpx.Request], httpx.Response] | Any]

SCAN = {
    "scan_id": "scan-1",
    "filename": "hall.pcd",
    "format": "pcd",
    "size": 123_456,
    "sha256": "ab" * 32,
    "device_id": "robot-7",
    "captured_at": "2026-03-02T12:00:00Z",
    "pose": [[1, 0, 0, 2.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
    "created": "2026-03-02T12:00:09Z",
    "warnings": [{"reason": "wrong_scale", "detail": "its scale is 1.012"}],
}
SURVEY: dict[str, Any] = {
    "survey_id": "survey-1",
    "map_id": "lobby",
    "status": "ready",
    "placement": {"state": "confirmed", "confidence": 0.98},
    "objects": {"appeared": 2},
}
ANCHOR = {"longitude": 13.4, "latitude": -52.5, "height": 76.0, "heading": 90.0}


class Service:
    """Answers by method and path, and keeps the requests."""

    def __init__(self) -> None:
        self.answers: Answers = {}
        self.requests: list[httpx.Request] = []

    def __call__(self, request: httpx.Request) -> httpx.Response:
        self.requests.append(request)
        answer = self.answers.get(f"{request.method} {request.url.path}")
        if callable(answer):
            made: httpx.Response = answer(request)
            return made
        if isinstance(answer, httpx.Response):
            return answer
        return (
            httpx.Response(404, json={"title": "no"}) if answer is None else httpx.Response(200, json=answer)
        )


@pytest.fixture
def service(monkeypatch: pytest.MonkeyPatch) -> Service:
    service = Service()
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(terminal, "Client", lambda url: Client(url, transport=httpx.MockTransport(service)))
    return service


def spicd(*words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(list(words))
    return int(ended.value.code or 0)


def test_version_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert spicd("--version") == 0
    assert capsys.readouterr().out == f"spicd {version('spicd')}\n"


def test_scans_are_listed_shown_and_deleted(service: Service, capsys: pytest.CaptureFixture[str]) -> None:
    service.answers = {
        "GET /scans": {"scans": [SCAN], "links": []},
        "GET /scans/scan-1": SCAN,
        "DELETE /scans/scan-1": httpx.Response(204),
    }
    assert spicd("scans", "list") == 0
    listed = capsys.readouterr().out
    for part in ("scan-1", "hall.pcd", "123,456", "robot-7", "yes", "wrong scale: its scale is 1.012"):
        assert part in listed
    assert spicd("scans", "show", "scan-1") == 0
    assert "2.5000" in capsys.readouterr().out
    assert spicd("scans", "list", "--json") == 0
    assert json.loads(capsys.readouterr().out) == [SCAN]
    assert spicd("scans", "delete", "scan-1", "--json") == 0
    assert json.loads(capsys.readouterr().out) == {"scan_id": "scan-1", "deleted": True}
    assert spicd("scans", "show", "scan-2") == 1


def test_surveys_delete_says_so(service: Service, capsys: pytest.CaptureFixture[str]) -> None:
    service.answers = {"DELETE /surveys/survey-1": httpx.Response(204)}
    assert spicd("surveys", "delete", "survey-1") == 0
    assert "survey survey-1 is deleted" in capsys.readouterr().out


def results(objects: Any) -> Answers:
    def pages(request: httpx.Request) -> httpx.Response:
        second = "cursor" in request.url.params
        href = "/surveys/survey-1/objects?cursor=abc"
        links = [] if second else [{"rel": "next", "href": href}]
        return httpx.Response(200, json={"features": [{"id": "b" if second else "a"}], "links": links})

    return {
        "GET /surveys/survey-1": {**SURVEY, "objects": objects},
        "GET /surveys/survey-1/cloud.ply": httpx.Response(200, content=CLOUD),
        "GET /surveys/survey-1/cloud.laz": httpx.Response(200, content=b"LASF"),
        "GET /surveys/survey-1/picture.png": httpx.Response(200, content=b"png"),
        "GET /surveys/survey-1/tiles": {"features": [{"id": "tile"}], "links": []},
        "GET /surveys/survey-1/objects": pages,
    }


def test_a_survey_is_downloaded_into_a_folder_with_every_page_of_its_objects(
    service: Service, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    service.answers = results({"appeared": 2})
    assert spicd("surveys", "download", "survey-1", "--to", str(tmp_path / "deep" / "tuesday"), "--json") == 0
    files = json.loads(capsys.readouterr().out)["files"]
    assert sorted(files) == ["cloud.ply", "objects.geojson", "picture.png", "tiles.geojson"]
    assert sorted(path.name for path in (tmp_path / "deep" / "tuesday").iterdir()) == sorted(files)
    assert Path(files["cloud.ply"]).read_bytes() == CLOUD
    written = json.loads(Path(files["objects.geojson"]).read_text())
    assert [feature["id"] for feature in written["features"]] == ["a", "b"]


def test_a_survey_is_downloaded_with_its_cloud_as_laz_where_that_is_asked_for(
    service: Service, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    service.answers = results(None)
    assert spicd("surveys", "download", "survey-1", "--to", str(tmp_path), "--laz", "--json") == 0
    files = json.loads(capsys.readouterr().out)["files"]
    assert sorted(files) == ["cloud.laz", "picture.png", "tiles.geojson"]
    assert Path(files["cloud.laz"]).read_bytes() == b"LASF"


def test_of_a_survey_without_objects_the_rest_is_downloaded_and_of_a_refused_one_its_picture(
    service: Service, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    service.answers = results(None)
    assert spicd("surveys", "download", "survey-1") == 0
    assert len(list((tmp_path / "survey-1").iterdir())) == 3
    problem = {"title": "No scan accepted", "detail": "none fits"}
    placement = {"state": "refused", "confidence": None}
    refused = {**SURVEY, "status": "failed", "placement": placement, "problem": problem}
    service.answers["GET /surveys/survey-1"] = refused
    assert spicd("surveys", "download", "survey-1", "--to", "refused") == 0
    assert [path.name for path in (tmp_path / "refused").iterdir()] == ["picture.png"]
    assert "survey survey-1 failed: none fits" in capsys.readouterr().err


def test_a_folder_that_cannot_be_made_is_one_sentence(
    service: Service, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    service.answers = results(None)
    (tmp_path / "file").write_text("")
    assert spicd("surveys", "download", "survey-1", "--to", str(tmp_path / "file" / "below")) == 1
    assert "cannot be written" in capsys.readouterr().err


def test_an_anchor_is_set_shown_and_taken_away(service: Service, capsys: pytest.CaptureFixture[str]) -> None:
    service.answers = {
        "GET /maps/lobby": {"map_id": "lobby", "anchor": ANCHOR},
        "PUT /maps/lobby/anchor": ANCHOR,
        "DELETE /maps/lobby/anchor": httpx.Response(204),
    }
    words = [part for name, value in ANCHOR.items() for part in (f"--{name}", str(value))]
    assert spicd("maps", "anchor", "lobby", *words) == 0
    assert json.loads(service.requests[0].content) == ANCHOR
    assert "-52.5" in capsys.readouterr().out
    assert spicd("maps", "anchor", "lobby", "--remove") == 0
    assert spicd("maps", "anchor", "lobby") == 0
    assert [request.method for request in service.requests] == ["PUT", "GET", "DELETE", "GET", "GET"]
    capsys.readouterr()
    assert spicd("maps", "anchor", "lobby", "--longitude", "3") == 1
    assert "--latitude" in capsys.readouterr().err


def csv(request: httpx.Request) -> httpx.Response:
    assert request.headers["Accept"] == "text/csv"
    rows, headers = ["tile_1,0.9", "tile_2,0.8"], {"Content-Type": "text/csv; charset=utf-8"}
    if "cursor" in request.url.params:
        rows = ["tile_3,0.7"]
    else:
        headers["Link"] = '</maps/lobby/changes?cursor=abc>; rel="next"; type="text/csv"'
    return httpx.Response(200, headers=headers, text="\r\n".join(["id,score", *rows, ""]))


def test_changes_as_csv_are_all_pages_with_one_row_of_names(
    service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    service.answers = {"GET /maps/lobby/changes": csv}
    assert spicd("changes", "lobby", "--csv", "--min-score", "0.5") == 0
    assert capsys.readouterr().out.split() == ["id,score", "tile_1,0.9", "tile_2,0.8", "tile_3,0.7"]
    assert dict(service.requests[0].url.params) == {"min_score": "0.5", "limit": "1000"}
    assert spicd("changes", "lobby", "--csv", "--limit", "1") == 0
    assert capsys.readouterr().out.split() == ["id,score", "tile_1,0.9"]
    assert spicd("changes", "lobby", "--csv", "--json") == 1


def test_changes_as_csv_of_a_service_that_has_none_is_one_sentence(
    service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    service.answers = {"GET /maps/lobby/changes": {"features": []}}
    assert spicd("changes", "lobby", "--csv") == 1
    assert "does not answer with CSV" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("job", "said"),
    [
        ({"status": "running", "message": "registering", "queue_position": None}, "registering"),
        ({"status": "accepted", "message": ""}, "accepted"),
        (
            {"status": "accepted", "message": "", "queue_position": 3, "waiting_s": 12.4},
            "waiting, number 3 in the queue, for 12 s so far",
        ),
    ],
)
def test_the_progress_says_which_one_in_the_queue_a_job_is(job: dict[str, Any], said: str) -> None:
    assert stage(job) == said


def test_jobs_show_their_place_in_the_queue(service: Service, capsys: pytest.CaptureFixture[str]) -> None:
    waiting = {"jobID": "job-1", "status": "accepted", "progress": 0, "queue_position": 3, "waiting_s": 12.4}
    service.answers = {"GET /jobs": {"jobs": [waiting], "links": []}, "GET /jobs/job-1": waiting}
    for words in (["jobs"], ["jobs", "job-1"]):
        assert spicd(*words) == 0
        assert "number 3 in the queue" in capsys.readouterr().out


def test_webhooks_are_added_with_their_secret_listed_pinged_and_removed(
    service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    hook = {"webhook_id": "webhook-1", "url": "https://here.example", "types": None, "map_id": "lobby"}
    delivery = {"event_id": "event-1", "type": "survey.ready", "status": "delivered", "attempts": 2}
    service.answers = {
        "POST /webhooks": {**hook, "secret": "whsec_abc"},
        "GET /webhooks": {"webhooks": [hook], "links": []},
        "POST /webhooks/webhook-1/ping": delivery,
        "POST /webhooks/webhook-1/deliveries/delivery-1/repeat": delivery,
        "POST /webhooks/webhook-1/rotate": {**hook, "secret": "whsec_def"},
        "GET /webhooks/webhook-1/deliveries": {"deliveries": [delivery], "links": []},
        "DELETE /webhooks/webhook-1": httpx.Response(204),
    }
    said = {}
    for words in (
        ["add", "https://here.example", "--type", "survey.ready", "--map", "lobby"],
        ["list"],
        ["ping", "webhook-1"],
        ["rotate", "webhook-1"],
        ["deliveries", "webhook-1"],
        ["repeat", "webhook-1", "delivery-1"],
        ["remove", "webhook-1"],
    ):
        assert spicd("webhooks", *words) == 0
        said[words[0]] = capsys.readouterr().out
    asked = {"url": "https://here.example", "types": ["survey.ready"], "map": "lobby"}
    assert json.loads(service.requests[0].content) == asked
    assert "whsec_abc" in said["add"]
    assert "whsec" not in said["list"]
    assert "whsec_def" in said["rotate"]
    assert "delivered" in said["deliveries"]
    assert "event-1" in said["repeat"]
    assert "is deleted" in said["remove"]


@pytest.mark.parametrize("form", ["line", "json"])
def test_events_are_a_line_each(service: Service, capsys: pytest.CaptureFixture[str], form: str) -> None:
    event = {"id": "event-a", "sequence": "7", "type": "survey.ready", "time": "2026-03-02T12:00:00Z"}
    told = httpx.Response(
        200,
        headers={"Content-Type": "text/event-stream"},
        text=f"id: 6\n\nid: 7\ndata: {json.dumps(event)}\n\n",
    )
    gone = httpx.Response(410, json={"title": "Gone", "detail": "event 7 is not kept any more"})
    waiting = [told, gone]
    service.answers = {"GET /events": lambda request: waiting.pop(0)}
    assert spicd("events", "follow", *(["--json"] if form == "json" else [])) == 1
    said = capsys.readouterr()
    assert "not kept any more" in said.err
    assert service.requests[1].headers["Last-Event-ID"] == "7"
    if form == "json":
        assert json.loads(said.out) == event
    else:
        assert said.out == "7  2026-03-02T12:00:00Z  survey.ready  \n"


def each_command() -> list[tuple[str, str]]:
    commands = [(function.__name__, example) for function, example in ALONE.items()]
    for name, (_, functions) in GROUPS.items():
        commands += [
            (f"{name} {one.__name__.rstrip('_').replace('_', '-')}", f"{name} {ex}")
            for one, ex in functions.items()
        ]
    return commands


@pytest.mark.parametrize(("name", "example"), each_command())
def test_the_example_of_each_command_is_in_its_help_and_names_what_it_takes(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, name: str, example: str
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    assert spicd(*name.split(), "--help") == 0
    assert f"spicd {example}" in " ".join(capsys.readouterr().out.split())
    words = example.split(" > ", maxsplit=1)[0].split()
    assert " ".join(words).startswith(name)
    command: Any = typer.main.get_command(_commands())
    for word in name.split():
        command = command.commands[word]
    taken = {option for parameter in command.params for option in parameter.opts}
    assert {word for word in words if word.startswith("--")} <= taken


@pytest.mark.slow
@pytest.mark.parametrize(
    ("typed", "offered"),
    [("spicd sur", "surveys"), ("spicd surveys down", "download"), ("spicd maps show lo", "lobby")],
)
def test_the_shell_completes_commands_and_ids(typed: str, offered: str, tmp_path: Path) -> None:
    flaky = Flaky(steady=True)
    with flaky_service(flaky) as url:
        environment = {
            **os.environ,
            "_SPICD_COMPLETE": "complete_bash",
            "COMP_WORDS": typed,
            "SPICD_URL": url,
        }
        environment |= {"COMP_CWORD": str(len(typed.split()) - 1)}
        ended = subprocess.run(
            [sys.executable, "-m", "service"],
            cwd=ROOT,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
    assert offered in ended.stdout.split(), ended.stderr


@pytest.mark.slow
def test_completion_says_nothing_where_the_service_does_not_answer() -> None:
    environment = {**os.environ, "_SPICD_COMPLETE": "complete_bash", "COMP_WORDS": "spicd maps show lo"}
    environment |= {"COMP_CWORD": "3", "SPICD_URL": "http://127.0.0.1:9"}
    ended = subprocess.run(
        [sys.executable, "-m", "service"],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ended.stdout.strip(), ended.stderr) == ("", "")
