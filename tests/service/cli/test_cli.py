"""`spicd` against a service that is a table of answers; every request it made is looked at."""

from __future__ import annotations

import errno
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
from rich.console import Console
from rich.progress import TextColumn

from service.cli import main, terminal
from service.cli.terminal import Terminal
from service.client import Client
from service.settings import Settings
from service.up import launcher

Answer = Callable[[httpx.Request], httpx.Response]

SCAN = {"scan_id": "scan-1", "filename": "hall.pcd", "size": 9, "sha256": "ab" * 32}
MAP: dict[str, Any] = {
    "map_id": "lobby",
    "name": "Lobby",
    "status": "ready",
    "model": "spicd-net/1",
    "counts": {"tiles": 172},
    "scans": [{"scan_id": "scan-1", "accepted": True, "fitness": 0.91, "rmse": 0.0213, "reason": None}],
    "created": "2026-03-01T12:00:00Z",
}
SURVEY = {
    "survey_id": "survey-1",
    "map_id": "lobby",
    "status": "ready",
    "captured_at": "2026-03-02T12:00:00Z",
    "placement": {"state": "in_doubt", "confidence": 0.712},
    "counts": {"changed": 9, "unchanged": 150},
    "scans": [
        {"scan_id": "scan-2", "accepted": False, "reason": "too_little_overlap", "detail": "covers 4% of it"},
        {
            "scan_id": "scan-3",
            "accepted": True,
            "fitness": 0.9,
            "confidence": 0.97,
            "warnings": [
                {"reason": "wrong_scale", "detail": "its scale is 1.012", "numbers": {"scale": 1.012}}
            ],
        },
    ],
}
CHANGES = {
    "type": "FeatureCollection",
    "numberMatched": 7,
    "features": [
        {
            "properties": {
                "tile_id": "tile_001_002_003",
                "state": "changed",
                "score": 0.934,
                "center": [1.5, 2.25, 0.5],
                "survey_id": "survey-1",
            }
        }
    ],
}


def job(status: str, progress: int, **more: Any) -> dict[str, Any]:
    return {
        "jobID": "job-1",
        "processID": "map",
        "status": status,
        "progress": progress,
        "message": "tiling",
        **more,
    }


class Service:
    """Answers by method and path; a list is given out one at a time, its last for good."""

    def __init__(self) -> None:
        self.answers: dict[str, list[tuple[int, Any]]] = {}
        self.requests: list[httpx.Request] = []

    def on(self, call: str, *documents: Any, status: int = 200) -> None:
        self.answers[call] = [(status, document) for document in documents]

    def __call__(self, request: httpx.Request) -> httpx.Response:
        request.read()
        self.requests.append(request)
        waiting = self.answers[f"{request.method} {request.url.path}"]
        status, document = waiting.pop(0) if len(waiting) > 1 else waiting[0]
        return httpx.Response(status, json=document) if document is not None else httpx.Response(status)

    def body(self, number: int = -1) -> Any:
        return json.loads(self.requests[number].content)


#: A PLY of one point.
WHOLE = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n"


@pytest.fixture
def service(monkeypatch: pytest.MonkeyPatch) -> Service:
    service = Service()
    monkeypatch.delenv("SPICD_URL", raising=False)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(terminal, "Client", lambda url: Client(url, transport=httpx.MockTransport(service)))
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    return service


def spicd(*words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(list(words))
    return int(ended.value.code or 0)


def test_scans_add_streams_the_file_with_what_is_said_of_it(
    service: Service, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    service.on("POST /scans", SCAN, status=201)
    (tmp_path / "hall.pcd").write_bytes(WHOLE)
    (tmp_path / "pose.txt").write_text("1 0 0 2.5\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    pose = ["--pose", str(tmp_path / "pose.txt")]
    assert spicd("scans", "add", str(tmp_path / "hall.pcd"), "--device-id", "robot-7", *pose) == 0
    request = service.requests[0]
    assert request.content == WHOLE
    assert request.headers["content-length"] == str(len(WHOLE))
    assert "transfer-encoding" not in request.headers
    query = dict(request.url.params)
    assert json.loads(query.pop("pose")) == [[1, 0, 0, 2.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    assert query == {"filename": "hall.pcd", "device_id": "robot-7"}
    assert "scan-1" in capsys.readouterr().out


@pytest.mark.parametrize("words", [["scans", "add"], ["maps", "create"], ["surveys", "submit", "lobby"]])
def test_a_file_that_is_cut_off_or_empty_is_refused_before_any_is_sent(
    service: Service, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    service.on("POST /scans", SCAN, status=201)
    contents = {"whole.ply": WHOLE, "cut.ply": WHOLE[:-2], "empty.pcd": b""}
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
    assert spicd(*words, *(str(tmp_path / name) for name in contents)) == 1
    assert service.requests == []
    said = capsys.readouterr().err
    assert (
        f"{tmp_path}/cut.ply: the file is cut off: its header declares 1 points, 0 of them are there; copy"
        in said
    )
    assert f"{tmp_path}/empty.pcd: the file is empty (0 bytes); copy or record it again" in said
    assert "none of the 3 files is sent" in said


def test_maps_create_uploads_files_and_takes_other_names_as_ids(
    service: Service, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    service.on("POST /scans", SCAN, status=201)
    service.on("POST /maps", {"map_id": "lobby", "job_id": "job-1"}, status=202)
    (tmp_path / "hall.ply").write_bytes(WHOLE)
    assert spicd("maps", "create", "scan-0", str(tmp_path / "hall.ply"), "--id", "lobby", "--json") == 0
    assert service.body() == {"id": "lobby", "scan_ids": ["scan-0", "scan-1"]}
    assert json.loads(capsys.readouterr().out) == {"map_id": "lobby", "job_id": "job-1"}


def test_a_name_that_is_neither_file_nor_id_sends_nothing(
    service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    assert spicd("maps", "create", "scan-0", "hall.pcd") == 1
    assert service.requests == []
    assert "hall.pcd" in capsys.readouterr().err


def test_waiting_follows_the_job_and_shows_the_map(
    service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    service.on("POST /maps", {"map_id": "lobby", "job_id": "job-1"}, status=202)
    service.on("GET /jobs/job-1", job("accepted", 0), job("running", 40), job("successful", 100))
    service.on("GET /maps/lobby", MAP)
    assert spicd("maps", "create", "scan-0", "--wait") == 0
    assert [request.url.path for request in service.requests].count("/jobs/job-1") == 3
    shown = capsys.readouterr().out
    assert "tiles 172" in shown
    assert "0.91" in shown
    assert "0.021" in shown


def test_a_failed_job_is_one_sentence_on_stderr_status_1_and_with_json_its_document(
    service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    problem = {"title": "No scan could be registered", "detail": "scan 1: fitness 0.10 is below 0.30"}
    service.on("POST /maps/lobby/surveys", {"survey_id": "survey-1", "job_id": "job-1"}, status=202)
    service.on("GET /jobs/job-1", job("failed", 30, problem=problem))
    assert spicd("surveys", "submit", "lobby", "scan-2", "--wait", "--threshold", "0.4", "--json") == 1
    assert json.loads(service.requests[0].content) == {"scan_ids": ["scan-2"], "threshold": 0.4}
    said = capsys.readouterr()
    assert json.loads(said.out) == job("failed", 30, problem=problem)
    assert said.err.split() == f"{problem['title']}: {problem['detail']}".split()


VERSION = {
    **{name: value for name, value in MAP.items() if name != "name"},
    "version": 2,
    "base_version": 1,
    "survey_id": None,
}


def test_versions_add_uploads_further_scans_waits_and_shows_the_version(
    service: Service, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    service.on("POST /scans", SCAN, status=201)
    accepted = {"map_id": "lobby", "version": 2, "job_id": "job-1"}
    service.on("POST /maps/lobby/versions", accepted, status=202)
    service.on("GET /jobs/job-1", job("successful", 100))
    service.on("GET /maps/lobby/versions/2", VERSION)
    (tmp_path / "hall.ply").write_bytes(WHOLE)
    assert spicd("versions", "add", "lobby", str(tmp_path / "hall.ply"), "--wait") == 0
    assert service.body(1) == {"scan_ids": ["scan-1"]}
    shown = capsys.readouterr().out
    assert "version 1 and further scans" in shown
    assert "0.021" in shown


def test_versions_add_takes_a_survey_over(service: Service, capsys: pytest.CaptureFixture[str]) -> None:
    accepted = {"map_id": "lobby", "version": 2, "job_id": "job-1"}
    service.on("POST /maps/lobby/versions", accepted, status=202)
    assert spicd("versions", "add", "lobby", "--survey", "survey-1") == 0
    assert service.body() == {"survey_id": "survey-1"}
    assert capsys.readouterr().out.startswith("version 2 of map lobby: job job-1 is on its way")


def test_versions_list_says_what_each_was_made_from(
    service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    first = {**VERSION, "version": 1, "base_version": None}
    third = {**VERSION, "version": 3, "base_version": 2, "survey_id": "survey-1", "status": "building"}
    service.on("GET /maps/lobby/versions", {"versions": [third, VERSION, first], "links": []})
    assert spicd("versions", "list", "lobby") == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if "building" in line or "ready" in line]
    made = ("version 2 and survey survey-1", "version 1 and further scans", "scans")
    assert len(lines) == 3
    assert all(what in line for what, line in zip(made, lines, strict=True))


def test_versions_delete_says_so(service: Service, capsys: pytest.CaptureFixture[str]) -> None:
    service.on("DELETE /maps/lobby/versions/1", None, status=204)
    assert spicd("versions", "delete", "lobby", "1") == 0
    assert "version 1 of map lobby is deleted" in capsys.readouterr().out


def test_the_client_sets_an_anchor_and_takes_it_away(service: Service) -> None:
    service.on("PUT /maps/lobby/anchor", MAP)
    service.on("DELETE /maps/lobby/anchor", None, status=204)
    anchor = {"longitude": 13.4, "latitude": 52.5, "height": 76.0, "heading": 90.0}
    with Client("http://there", transport=httpx.MockTransport(service)) as client:
        client.set_anchor("lobby", anchor)
        client.set_anchor("lobby", None)
    assert service.body(0) == anchor
    assert [request.method for request in service.requests] == ["PUT", "DELETE"]


@pytest.mark.parametrize("name", ["a[/]b", "[old] hall", "[red]x", ":smile:"])
def test_names_that_look_like_markup_are_printed_as_they_are(
    service: Service, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    scan = {**MAP["scans"][0], "accepted": False, "reason": "no_fit", "detail": name}
    service.on("GET /maps", {"maps": [{**MAP, "name": name}], "links": []})
    service.on("GET /maps/lobby", {**MAP, "name": "Lobby", "scans": [scan]})
    service.on("GET /models", {"models": [{"name": "m", "version": "1", "summary": name}]})
    service.on("POST /scans", {**SCAN, "filename": name}, status=201)
    file = tmp_path / f"{name.replace('/', '')}.ply"
    file.write_bytes(WHOLE)
    calls = (["maps", "list"], ["maps", "show", "lobby"], ["models"], ["scans", "add", str(file)])
    for words in calls:
        assert spicd(*words) == 0
        assert name in capsys.readouterr().out


def test_maps_show_tells_of_every_scan_where_the_document_has_the_first_alone(
    service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    every = [{**MAP["scans"][0], "scan_id": f"scan-{number}"} for number in range(3)]
    more = {"version": 1, "links": [{"rel": "next", "href": "/maps/lobby/scans?cursor=c"}]}
    last = {"version": 1, "links": []}
    service.on("GET /maps/lobby", {**MAP, "scan_count": 3})
    service.on("GET /maps/lobby/scans", {**more, "scans": every[:2]}, {**last, "scans": every[2:]})
    assert spicd("--json", "maps", "show", "lobby") == 0
    assert json.loads(capsys.readouterr().out)["scans"] == every
    service.on("GET /maps/lobby/versions/1", {**MAP, "version": 1, "scan_count": 3})
    service.on("GET /maps/lobby/versions/1/scans", {**last, "scans": every})
    assert spicd("versions", "show", "lobby", "1") == 0
    assert "scan-2" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["a[/]b.ply", "[old].ply"])
def test_a_bar_shows_a_file_name_that_looks_like_markup_as_it_is(name: str) -> None:
    shown = Terminal(url="", as_json=False, err=Console(file=io.StringIO(), force_terminal=True))
    with shown._bar(terminal._title()) as bar:
        bar.add_task(name)
        column = bar.columns[0]
        assert isinstance(column, TextColumn)
        assert column.render(bar.tasks[0]).plain == name


def test_a_file_that_cannot_be_read_is_one_sentence(
    service: Service, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(path: Path, *_: Any) -> Any:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    (tmp_path / "hall.ply").write_bytes(WHOLE)
    monkeypatch.setattr(Path, "open", refuse)
    service.on("POST /scans", SCAN, status=201)
    assert spicd("maps", "create", str(tmp_path / "hall.ply")) == 1
    said = capsys.readouterr().err.strip()
    assert said == f"{tmp_path / 'hall.ply'}: the file cannot be read (Permission denied)"


def test_a_ready_file_that_cannot_be_written_ends_up_with_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def launch(settings: Settings, *, on_ready: Callable[[launcher.Running], None]) -> None:
        on_ready(
            launcher.Running(url="", docs="", data_dir="", pid=1, redis_url=None, redis_pid=None, workers=[])
        )

    monkeypatch.setattr(launcher, "up", launch)
    monkeypatch.setenv("COLUMNS", "200")
    assert spicd("up", "--ready-file", str(tmp_path / "missing" / "x")) == 1
    said = capsys.readouterr().err
    assert "Traceback" not in said
    assert said.strip().endswith("cannot be written (No such file or directory)")


def files_of(service: Service) -> None:
    for scan_id in ("scan-1", "scan-2", "scan-3"):
        service.on(f"GET /scans/{scan_id}", {**SCAN, "scan_id": scan_id})


def test_surveys_submit_waits_and_shows_what_was_left_out(
    service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    service.on("POST /maps/lobby/surveys", {"survey_id": "survey-1", "job_id": "job-1"}, status=202)
    service.on("GET /jobs/job-1", job("successful", 100))
    service.on("GET /surveys/survey-1", SURVEY)
    files_of(service)
    assert spicd("surveys", "submit", "lobby", "scan-2", "--wait") == 0
    shown = capsys.readouterr().out
    assert "changed 9, unchanged 150" in shown
    assert "too little overlap" in shown
    assert "http://127.0.0.1:8000/surveys/survey-1/cloud.ply" in shown


def test_a_survey_is_shown_with_its_placement_and_why_scans_were_left_out(
    service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    service.on("GET /surveys/survey-1", SURVEY)
    files_of(service)
    assert spicd("surveys", "show", "survey-1") == 0
    shown = capsys.readouterr().out
    assert "in doubt (confidence 0.71)" in shown
    for said in ("too little overlap", "covers 4% of it", "0.97", "wrong scale: its scale is 1.012"):
        assert said in shown


def test_a_refused_survey_is_shown_with_its_picture(
    service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    refused = {**SURVEY, "status": "failed", "placement": {"state": "refused", "confidence": None}}
    service.on("GET /surveys/survey-1", refused)
    files_of(service)
    assert spicd("surveys", "show", "survey-1") == 0
    shown = capsys.readouterr().out
    assert "refused" in shown
    assert "/surveys/survey-1/picture.png" in shown
    assert "cloud.ply" not in shown


def test_surveys_are_listed_with_their_placement(
    service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    earlier = {name: value for name, value in SURVEY.items() if name != "placement"}
    service.on("GET /maps/lobby/surveys", {"surveys": [SURVEY, {**earlier, "placement": None}], "links": []})
    assert spicd("surveys", "list", "lobby") == 0
    assert capsys.readouterr().out.count("in doubt") == 1


def test_surveys_list_tells_what_was_placed_and_why_one_failed(
    service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    placed = {**SURVEY, "scan_count": 2, "accepted_count": 1}
    problem = {"title": "No scan accepted", "detail": "none of 2 scans fits the map"}
    failed = {**placed, "survey_id": "survey-2", "status": "failed", "accepted_count": 0, "problem": problem}
    service.on("GET /maps/lobby/surveys", {"surveys": [placed, failed], "links": []})
    assert spicd("surveys", "list", "lobby") == 0
    shown = capsys.readouterr().out
    for said in ("1 of 2 placed", "0 of 2 placed", "none of 2 scans fits the map"):
        assert said in shown


def test_a_survey_names_the_file_of_each_scan(service: Service, capsys: pytest.CaptureFixture[str]) -> None:
    service.on("GET /surveys/survey-1", SURVEY)
    service.on("GET /scans/scan-2", {**SCAN, "filename": "monday/b.ply"})
    service.on("GET /scans/scan-3", {"title": "no"}, status=404)
    assert spicd("surveys", "show", "survey-1") == 0
    assert "monday/b.ply" in capsys.readouterr().out
    assert spicd("surveys", "show", "survey-1", "--json") == 0
    assert json.loads(capsys.readouterr().out) == SURVEY


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        ("no map 'x'; GET /maps lists those there are", "`spicd maps list` lists"),
        ("no survey 'x'; GET /maps/<id>/surveys lists those there are", "`spicd surveys list MAP` lists"),
        (
            "no version 3 of map 'a'; GET /maps/a/versions lists those there are",
            "`spicd versions list a` lists",
        ),
        ("no job 'x'; GET /jobs lists those there are", "`spicd jobs` lists"),
    ],
)
def test_what_the_api_says_to_ask_is_told_as_a_command(
    service: Service, capsys: pytest.CaptureFixture[str], said: str, shown: str
) -> None:
    service.on("GET /surveys/x", {"title": "Not found", "detail": said}, status=404)
    assert spicd("surveys", "show", "x") == 1
    assert shown in capsys.readouterr().err


@pytest.mark.parametrize("command", [("scans", "watch"), ("maps", "list"), ("jobs",)])
def test_the_help_of_each_command_names_the_options_of_all(
    command: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert spicd(*command, "--help") == 0
    assert "--url" in capsys.readouterr().out


def test_changes_passes_its_filters_on_and_lists_the_tiles(
    service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    service.on("GET /maps/lobby/changes", CHANGES)
    assert (
        spicd(
            "changes",
            "lobby",
            "--bbox",
            "0,0,3,3",
            "--min-score",
            "0.5",
            "--datetime",
            "2026-03-01T00:00:00Z/..",
        )
        == 0
    )
    assert dict(service.requests[0].url.params) == {
        "bbox": "0,0,3,3",
        "bbox-crs": "map",
        "min_score": "0.5",
        "datetime": "2026-03-01T00:00:00Z/..",
        "limit": "100",
    }
    shown = capsys.readouterr().out
    assert "tile_001_002_003" in shown
    assert "1.50, 2.25, 0.50" in shown
    assert "1 of 7" in shown


def test_changes_takes_each_filter_of_the_api(service: Service) -> None:
    service.on("GET /maps/lobby/changes", CHANGES)
    filters = {"survey": "survey-1", "state": "inconsistent", "kind": "appeared", "device_id": "robot-7"}
    words = [word for name, value in filters.items() for word in (f"--{name.replace('_', '-')}", value)]
    assert spicd("changes", "lobby", *words) == 0
    assert dict(service.requests[0].url.params) == {**filters, "limit": "100"}


def test_changes_may_be_told_again_for_each_visit(service: Service) -> None:
    service.on("GET /maps/lobby/changes", CHANGES)
    assert spicd("changes", "lobby", "--repeats") == 0
    assert dict(service.requests[0].url.params) == {"repeats": "true", "limit": "100"}


BOX = {"center": [1.0, 2.0, 0.45], "size": [0.5, 0.6, 0.9]}
THING: dict[str, Any] = {
    "object_id": "object-1",
    "number": 4,
    "kind": "moved",
    "status": "still_there",
    "transient": True,
    "now": BOX,
    "before": {**BOX, "center": [5.0, 2.0, 0.45]},
    "probability": 0.934,
    "survey_id": "survey-1",
    "captured_at": "2026-03-02T12:00:00Z",
    "first_seen": "2026-03-01T12:00:00Z",
    "last_seen": "2026-03-02T12:00:00Z",
    "last_looked": "2026-03-02T12:00:00Z",
    "accepted_in_version": None,
}
OBJECTS = {"type": "FeatureCollection", "numberMatched": 7, "features": [{"properties": THING}]}


def test_objects_passes_its_filters_on_and_lists_the_things(
    service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    service.on("GET /maps/lobby/objects", OBJECTS)
    words = ("--status", "still_there", "--transient", "--min-probability", "0.5", "--bbox", "0,0,3,3")
    assert spicd("objects", "lobby", *words) == 0
    assert dict(service.requests[0].url.params) == {
        "status": "still_there",
        "transient": "true",
        "min_probability": "0.5",
        "bbox": "0,0,3,3",
        "bbox-crs": "map",
        "limit": "100",
    }
    shown = " ".join(capsys.readouterr().out.split())
    for part in (
        "object-1",
        "still there,",
        "transient",
        "5.00, 2.00, 0.45 to",
        "0.50 x 0.60 x 0.90",
        "0.93",
        "1 of 7",
    ):
        assert part in shown


def test_objects_of_a_survey_are_those_that_it_saw(
    service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    service.on("GET /surveys/survey-1", SURVEY)
    service.on("GET /surveys/survey-1/objects", OBJECTS)
    assert spicd("objects", "lobby", "--survey", "survey-1", "--kind", "moved") == 0
    assert dict(service.requests[1].url.params) == {"kind": "moved", "limit": "100"}
    assert "object-1" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("hall", "--survey", "survey-1"), "survey survey-1 is of map lobby, not of hall"),
        (("lobby", "--survey", "survey-1", "--status", "new"), "leave --status out"),
        (("lobby", "object-1", "--min-probability", "0.5"), "leave --min-probability out"),
    ],
)
def test_objects_refuses_what_has_no_meaning(
    service: Service, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], said: str
) -> None:
    service.on("GET /surveys/survey-1", SURVEY)
    assert spicd("objects", *words) == 1
    assert said in capsys.readouterr().err


def test_one_object_is_shown_with_its_sightings(service: Service, capsys: pytest.CaptureFixture[str]) -> None:
    feature = {"type": "Feature", "properties": THING, "sightings": [{"properties": THING}]}
    service.on("GET /maps/lobby/objects/object-1", feature)
    assert spicd("objects", "lobby", "object-1") == 0
    shown = capsys.readouterr().out
    for part in ("still_there", "last looked", "survey-1", "moved"):
        assert part in shown


def test_maps_create_passes_the_alarms_on(service: Service) -> None:
    service.on("POST /maps", {"map_id": "lobby", "job_id": "job-1"}, status=202)
    assert spicd("maps", "create", "scan-0", "--alarms-per-survey", "0.02") == 0
    assert service.body() == {"scan_ids": ["scan-0"], "settings": {"alarms_per_survey": 0.02}}


def test_map_and_survey_show_their_objects(service: Service, capsys: pytest.CaptureFixture[str]) -> None:
    service.on("GET /maps/lobby", {**MAP, "objects": {"new": 2, "still_there": 5}})
    service.on("GET /surveys/survey-1", {**SURVEY, "objects": {"appeared": 3}, "moving": 4})
    files_of(service)
    assert spicd("maps", "show", "lobby") == 0
    assert "new 2, still there 5" in capsys.readouterr().out
    assert spicd("surveys", "show", "survey-1") == 0
    shown = capsys.readouterr().out
    assert "appeared 3" in shown
    assert "/surveys/survey-1/objects" in shown


@pytest.mark.parametrize("place", ["before", "after"])
def test_json_is_the_document_and_nothing_else_wherever_the_option_stands(
    service: Service, capsys: pytest.CaptureFixture[str], place: str
) -> None:
    service.on("GET /maps/lobby/changes", CHANGES)
    words = ["changes", "lobby"]
    assert spicd(*(["--json", *words] if place == "before" else [*words, "--json"])) == 0
    assert json.loads(capsys.readouterr().out) == CHANGES


def test_maps_list_follows_the_pages(service: Service, capsys: pytest.CaptureFixture[str]) -> None:
    following = {"rel": "next", "href": "/maps?cursor=abc"}
    service.on(
        "GET /maps", {"maps": [MAP], "links": [following]}, {"maps": [{**MAP, "map_id": "hall"}], "links": []}
    )
    assert spicd("maps", "list", "--json") == 0
    assert [one["map_id"] for one in json.loads(capsys.readouterr().out)] == ["lobby", "hall"]
    assert dict(service.requests[1].url.params) == {"cursor": "abc"}


def test_jobs_cancel_dismisses(service: Service, capsys: pytest.CaptureFixture[str]) -> None:
    service.on("DELETE /jobs/job-1", job("dismissed", 30))
    assert spicd("jobs", "job-1", "--cancel") == 0
    assert "dismissed" in capsys.readouterr().out


def test_jobs_retry_runs_a_failed_one_again(service: Service, capsys: pytest.CaptureFixture[str]) -> None:
    service.on("POST /jobs/job-1/retry", job("running", 30))
    assert spicd("jobs", "job-1", "--retry") == 0
    assert "running" in capsys.readouterr().out


def test_jobs_lists_and_models_lists(service: Service, capsys: pytest.CaptureFixture[str]) -> None:
    service.on("GET /jobs", {"jobs": [job("running", 40)], "links": []})
    service.on("GET /models", {"models": [{"name": "spicd-net", "version": "1", "threshold": 0.5}]})
    assert spicd("jobs") == 0
    assert "40 %" in capsys.readouterr().out
    assert spicd("models") == 0
    assert "spicd-net/1" in capsys.readouterr().out


def test_models_train_names_the_model_and_its_job(
    service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    service.on("POST /maps/lobby/models", {"model": "lobby-net/1", "job_id": "job-1"}, status=202)
    assert spicd("models", "train", "lobby", "--base", "spicd-net/1", "--minutes", "3") == 0
    out = capsys.readouterr().out
    assert "lobby-net/1" in out
    assert "job-1" in out


def test_models_train_with_wait_shows_what_was_measured(
    service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    service.on("POST /maps/lobby/models", {"model": "lobby-net/1", "job_id": "job-1"}, status=202)
    service.on("GET /jobs/job-1", job("successful", 100))
    measured = {"area_under_roc": 0.91, "precision": 0.5, "recall": 0.6, "f1": 0.55}
    card = {"name": "lobby-net", "version": "1", "threshold": 0.3, "evaluation": {"validation": measured}}
    service.on("GET /models/lobby-net", card)
    assert spicd("models", "train", "lobby", "--wait") == 0
    assert "0.91" in capsys.readouterr().out


def test_maps_delete_says_so(service: Service, capsys: pytest.CaptureFixture[str]) -> None:
    service.on("DELETE /maps/lobby", None, status=204)
    assert spicd("maps", "delete", "lobby") == 0
    assert "lobby" in capsys.readouterr().out


def test_a_problem_is_told_with_its_title_and_detail(
    service: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    problem = {
        "type": "urn:spicd:problem:not_found",
        "title": "There is no such thing",
        "detail": "no map 'attic'",
    }
    service.on("GET /maps/attic", problem, status=404)
    assert spicd("maps", "show", "attic") == 1
    assert capsys.readouterr().err.strip() == "There is no such thing: no map 'attic'"


def test_a_service_that_is_not_there_is_told_with_what_to_do(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(request: httpx.Request) -> httpx.Response:
        raise httpx.ConnectError("refused")

    monkeypatch.setattr(terminal, "Client", lambda url: Client(url, transport=httpx.MockTransport(refuse)))
    monkeypatch.setenv("COLUMNS", "200")
    assert spicd("--url", "http://there:1", "jobs") == 1
    said = capsys.readouterr().err
    assert "http://there:1" in said
    assert "spicd up" in said


def test_a_download_that_breaks_leaves_no_file(tmp_path: Path) -> None:
    def broken(request: httpx.Request) -> httpx.Response:
        return httpx.Response(404, json={"title": "There is no such thing", "detail": "no survey"})

    with (
        Client("http://there", transport=httpx.MockTransport(broken)) as client,
        pytest.raises(Exception, match="no survey"),
    ):
        client.download("/surveys/x/cloud.ply", tmp_path / "cloud.ply")
    assert list(tmp_path.iterdir()) == []


def test_a_download_is_written_whole(tmp_path: Path) -> None:
    transport = httpx.MockTransport(lambda request: httpx.Response(200, content=b"ply\n" * 1000))
    with Client("http://there", transport=transport) as client:
        path = client.download("/surveys/x/cloud.ply", tmp_path / "cloud.ply")
    assert path.read_bytes() == b"ply\n" * 1000
