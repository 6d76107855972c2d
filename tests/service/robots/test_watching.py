"""A folder that is watched: what is whole is sent, once, and lies where it belongs afterwards."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi.testclient import TestClient

from service.catalog.records import Problem, ScanOutcome
from service.client import Client, RequestRefused
from service.resumable import Persistence
from service.robots.watching import FolderBusy, Reporter, Watcher, WatchOptions
from tests.support.api_process import ROOT, ApiProcess
from tests.support.bad_link import bad_link
from tests.support.processes import until
from tests.support.samples import add_map, catalog_of

NOW = WatchOptions(settle_s=0, every_s=0)


def ply(content: str = "hall", points: int = 1) -> bytes:
    """A whole PLY in ASCII."""
    head = f"ply\nformat ascii 1.0\ncomment {content}\nelement vertex {points}\n"
    return (
        head + "property float x\nproperty float y\nproperty float z\nend_header\n" + "1 2 3\n" * points
    ).encode()


def pcd() -> bytes:
    """A whole PCD."""
    head = "# .PCD v.7\nVERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\nPOINTS 1\n"
    return f"{head}DATA ascii\n1 2 3\n".encode()


class Through(httpx.BaseTransport):
    """Passes requests to the app, and may fail a number of them."""

    def __init__(self, client: TestClient) -> None:
        self._client = client
        self.requests: list[tuple[str, str]] = []
        self.failures: list[Any] = []

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        body = request.read()
        self.requests.append((request.method, request.url.path))
        if self.failures and (failure := self.failures.pop(0)) is not None:
            raise failure
        answer = self._client.request(
            request.method, str(request.url.raw_path, "ascii"), content=body, headers=dict(request.headers)
        )
        headers = {
            name: value for name, value in answer.headers.items() if name.lower() != "content-encoding"
        }
        return httpx.Response(answer.status_code, headers=headers, content=answer.content)


@pytest.fixture
def through(client: TestClient) -> Through:
    return Through(client)


@pytest.fixture
def service(through: Through) -> Iterator[Client]:
    with Client("http://localhost", transport=through, key="") as opened:
        yield opened


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "scans"
    made.mkdir()
    return made


def put(path: Path, content: bytes | None = None) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(ply(path.name) if content is None else content)
    return path


def names(folder: Path) -> list[str]:
    """Every file in a folder, its state aside."""
    files = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return sorted(str(path) for path in files if path.parts[0] != ".spicd")


def test_what_is_there_is_sent_and_moved_with_what_lies_beside_it(
    service: Client, client: TestClient, folder: Path
) -> None:
    put(folder / "hall.ply")
    (folder / "hall.pose.txt").write_text("1 2 3 0 0 0 1 # at the door\n")
    put(folder / "monday" / "b.pcd", pcd())
    said = {"pose": [1, 0, 0, 0, 0, 0, 1], "frame": "odom", "captured_at": "2026-03-01T12:00:00Z"}
    (folder / "monday" / "b.pose.json").write_text(json.dumps(said))
    with Watcher(service, folder, WatchOptions(settle_s=0, every_s=0, device_id="robot-7")) as watcher:
        watcher.run_once()
    assert names(folder) == [
        "done/hall.ply", "done/hall.pose.txt", "done/monday/b.pcd", "done/monday/b.pose.json",
    ]  # fmt: skip
    hall, b = sorted(client.get("/scans").json()["scans"], key=lambda scan: str(scan["filename"]))
    assert (hall["device_id"], hall["frame"], [row[3] for row in hall["pose"]]) == (
        "robot-7",
        None,
        [1, 2, 3, 1],
    )
    assert (b["frame"], b["captured_at"]) == ("odom", "2026-03-01T12:00:00Z")


def test_what_is_not_whole_or_no_scan_stays(service: Client, folder: Path) -> None:
    left = [".hidden.ply", "a.ply.part", "b.ply~", "c.tmp", "notes.txt"]
    for name in left:
        put(folder / name)
    with Watcher(service, folder, NOW) as watcher:
        watcher.run_once()
    assert names(folder) == sorted(left)


def test_a_file_that_still_grows_waits(service: Client, folder: Path) -> None:
    scan = put(folder / "hall.ply")
    with Watcher(service, folder, WatchOptions(settle_s=0.3, every_s=0.01)) as watcher:
        assert watcher.look()
        scan.write_bytes(scan.read_bytes() + b"more")
        assert watcher.look()
        assert names(folder) == ["hall.ply"]
        watcher.run_once()
    assert names(folder) == ["done/hall.ply"]


def test_what_the_service_refuses_is_put_aside_with_the_reason(service: Client, folder: Path) -> None:
    put(folder / "cat.ply", b"\x89PNG" + bytes(400))
    put(folder / "hall.ply")
    put(folder / "lost.ply")
    (folder / "lost.pose.txt").write_text("1 2 3")
    with Watcher(service, folder, NOW) as watcher:
        watcher.run_once()
        assert (watcher.sent, watcher.refused) == (1, 2)
    assert names(folder) == [
        "done/hall.ply", "refused/cat.ply", "refused/cat.ply.why.json",
        "refused/lost.ply", "refused/lost.ply.why.json", "refused/lost.pose.txt",
    ]  # fmt: skip
    why = json.loads((folder / "refused/cat.ply.why.json").read_text())
    assert why["type"] == "urn:spicd:problem:scan_unreadable"
    assert "3 numbers" in json.loads((folder / "refused/lost.ply.why.json").read_text())["detail"]


def test_a_name_that_is_taken_gets_a_number(service: Client, folder: Path) -> None:
    for content in ("one", "two"):
        put(folder / "hall.ply", ply(content))
        with Watcher(service, folder, NOW) as watcher:
            watcher.run_once()
    assert names(folder) == ["done/hall.2.ply", "done/hall.ply"]


def test_a_connection_that_breaks_is_tried_again(
    service: Client, through: Through, folder: Path, client: TestClient
) -> None:
    put(folder / "hall.ply")
    broken = httpx.ConnectError("no route"), httpx.ReadError("reset"), None, httpx.WriteError("reset")
    through.failures = list(broken)
    quick = Persistence(first_wait_s=0.01, longest_wait_s=0.02)
    with Watcher(service, folder, WatchOptions(settle_s=0, every_s=0, persistence=quick)) as watcher:
        watcher.run_once()
    assert len(client.get("/scans").json()["scans"]) == 1
    assert names(folder) == ["done/hall.ply"]


def test_a_file_whose_watcher_was_killed_before_it_moved_it_is_not_sent_again(
    service: Client, through: Through, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(folder / "hall.ply")

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, Watcher(service, folder, NOW) as watcher:
        patch.setattr(watcher, "_move", killed)
        with pytest.raises(KeyboardInterrupt):
            watcher.run_once()
    through.requests.clear()
    with Watcher(service, folder, NOW) as watcher:
        watcher.run_once()
    assert {method for method, _ in through.requests} == {"HEAD", "GET"}
    assert names(folder) == ["done/hall.ply"]


def test_each_sub_folder_is_a_survey(service: Client, client: TestClient, folder: Path) -> None:
    catalog = catalog_of(client)
    add_map(catalog)
    for name in ("monday/a.ply", "monday/b.ply", "tuesday/a.ply", "loose.ply"):
        put(folder / name, ply(name))
    with Watcher(service, folder, WatchOptions(settle_s=0, every_s=0, map_id="lobby")) as watcher:
        watcher.run_once()
        assert (watcher.sent, watcher.surveys) == (4, 2)
    surveys = client.get("/maps/lobby/surveys").json()["surveys"]
    assert sorted(len(client.get(f"/surveys/{one['survey_id']}").json()["scans"]) for one in surveys) == [
        1,
        2,
    ]
    assert not (folder / "monday").exists()


def test_a_visit_goes_on_until_nothing_has_come_for_long_enough(
    service: Client, client: TestClient, folder: Path
) -> None:
    add_map(catalog_of(client))
    put(folder / "monday/a.ply", ply("a"))
    options = WatchOptions(settle_s=0, every_s=0, map_id="lobby", visit_ends_s=60)
    with Watcher(service, folder, options) as watcher:
        assert watcher.look()
        assert watcher.surveys == 0
    put(folder / "monday/b.ply", ply("b"))
    with Watcher(service, folder, options) as watcher:  # another process
        watcher.look()
        os.utime(folder / "monday", (1, 1))
        watcher.look()
        assert watcher.surveys == 1
    (survey,) = client.get("/maps/lobby/surveys").json()["surveys"]
    assert len(client.get(f"/surveys/{survey['survey_id']}").json()["scans"]) == 2


def test_each_file_may_be_a_survey(service: Client, client: TestClient, folder: Path) -> None:
    add_map(catalog_of(client))
    for name in ("a.ply", "b.ply"):
        put(folder / name, ply(name))
    options = WatchOptions(settle_s=0, every_s=0, map_id="lobby", survey_each="file")
    with Watcher(service, folder, options) as watcher:
        watcher.run_once()
    assert len(client.get("/maps/lobby/surveys").json()["surveys"]) == 2


def test_a_map_that_is_none_ends_the_watch_and_keeps_the_visit(service: Client, folder: Path) -> None:
    put(folder / "monday/a.ply")
    options = WatchOptions(settle_s=0, every_s=0, map_id="nowhere")
    with Watcher(service, folder, options) as watcher, pytest.raises(RequestRefused, match="nowhere"):
        watcher.run_once()
    assert json.loads((folder / ".spicd/visits.json").read_text()).keys() == {"monday"}


def test_a_folder_has_one_watcher(service: Client, folder: Path) -> None:
    with (
        Watcher(service, folder, NOW),
        pytest.raises(FolderBusy, match="another watcher"),
        Watcher(service, folder, NOW),
    ):
        pass


def events_of(service: Client, folder: Path, **options: Any) -> list[tuple[str, dict[str, Any]]]:
    """Send what is there once; what the watcher told."""
    told: list[Any] = []
    report = Reporter(event=lambda sentence, event: told.append((sentence, dict(event))))
    with Watcher(
        service, folder, WatchOptions(settle_s=0, every_s=0, follow_s=0, **options), report
    ) as watcher:
        watcher.run_once()
    return told


def test_a_scan_that_no_survey_comes_of_is_told_so(service: Client, client: TestClient, folder: Path) -> None:
    add_map(catalog_of(client))
    put(folder / "top.ply")
    ((sentence, event),) = events_of(service, folder, map_id="lobby")
    assert "no survey: it lies in no sub-folder; use --survey-each file" in sentence
    assert event["visit"] is None
    put(folder / "top.ply", ply("other"))
    ((sentence, _),) = events_of(service, folder)
    assert "no survey" not in sentence


def test_a_file_that_is_cut_off_is_refused_before_it_is_sent(
    service: Client, through: Through, folder: Path
) -> None:
    put(folder / "cut.ply", ply(points=5)[:-9])
    put(folder / "none.ply", ply(points=0))
    (cut, _), (none, _) = events_of(service, folder)
    assert "5 points, 3 of them are there; copy or record it again" in cut
    assert "no points" in none
    assert through.requests == []
    assert "cut off" in json.loads((folder / "refused/cut.ply.why.json").read_text())["detail"]


def test_a_file_that_is_cut_off_may_still_be_written_for_a_while(service: Client, folder: Path) -> None:
    scan = put(folder / "hall.ply", ply(points=5)[:-9])
    slow = WatchOptions(settle_s=0, every_s=0, cut_off_s=1e6)
    with Watcher(service, folder, slow) as watcher:
        for _ in range(3):
            watcher.look()
        assert names(folder) == ["hall.ply"]
        scan.write_bytes(ply(points=5))
        watcher.look()
        watcher.look()
        assert names(folder) == ["done/hall.ply"]
    put(folder / "cut.ply", ply(points=5)[:-9])
    with Watcher(service, folder, WatchOptions(settle_s=0, every_s=0, cut_off_s=0)) as watcher:
        watcher.look()
        watcher.look()
        assert watcher.refused == 1


def test_a_survey_that_has_ended_is_told_with_its_files(
    service: Client, client: TestClient, folder: Path
) -> None:
    catalog = catalog_of(client)
    add_map(catalog)
    for name in ("a.ply", "elsewhere.ply"):
        put(folder / "monday" / name, ply(name))
    told = events_of(service, folder, map_id="lobby")
    survey = told[-1][1]
    a, elsewhere = survey["scans"]
    outcomes = [
        ScanOutcome(scan_id=a, accepted=True),
        ScanOutcome(scan_id=elsewhere, accepted=False, reason="no_fit", detail="it does not fit"),
    ]
    catalog.surveys.save_outcomes(survey["survey_id"], outcomes)
    ended: list[Any] = []
    report = Reporter(event=lambda sentence, event: ended.append((sentence, dict(event))))
    options = WatchOptions(settle_s=0, every_s=0, follow_s=0, map_id="lobby", wait=True)
    with Watcher(service, folder, options, report) as watcher:  # another process
        assert watcher.look()
        assert (ended, watcher.surveys_under_way) == ([], 1)
        catalog.jobs.fail(survey["job_id"], Problem(code="no_scan_accepted", detail="none fits"))
        watcher.run_once()
        assert watcher.surveys_under_way == 0
    ((sentence, event),) = ended
    assert f"monday: survey {survey['survey_id']} failed, 1 of 2 scans placed" in sentence
    assert "elsewhere.ply: no fit" in sentence
    assert (event["event"], event["status"]) == ("survey_ended", "failed")
    assert [one["file"] for one in event["scans"]] == ["a.ply", "elsewhere.ply"]


def test_a_survey_that_was_deleted_is_followed_no_more(
    service: Client, client: TestClient, folder: Path
) -> None:
    catalog = catalog_of(client)
    add_map(catalog)
    put(folder / "monday" / "a.ply")
    survey = events_of(service, folder, map_id="lobby")[-1][1]
    catalog.jobs.fail(survey["job_id"], Problem(code="internal", detail="none"))
    catalog.surveys.delete(survey["survey_id"])
    ((sentence, _),) = events_of(service, folder, map_id="lobby", wait=True)
    assert sentence.endswith("was deleted")


def test_a_scan_bears_the_name_of_its_visit_and_the_time_it_was_written(
    service: Client, client: TestClient, folder: Path
) -> None:
    os.utime(put(folder / "monday" / "b.ply"), (1_772_366_400, 1_772_366_400))
    os.utime(put(folder / "never.ply", ply("of a clock that was never set")), (1000, 1000))
    events_of(service, folder)
    monday, never = sorted(client.get("/scans").json()["scans"], key=lambda scan: str(scan["filename"]))
    assert (monday["filename"], monday["captured_at"]) == ("monday/b.ply", "2026-03-01T12:00:00Z")
    assert (never["filename"], never["captured_at"]) == ("never.ply", None)


def test_a_sidecar_of_another_name_is_told_and_stays(
    service: Client, client: TestClient, folder: Path
) -> None:
    add_map(catalog_of(client))
    put(folder / "bad" / "typo_name.ply")
    put(folder / "bad" / "typo_nmae.pose.txt", b"1 2 3 0 0 0 1")
    (sent, scan), (stray, _), _ = events_of(service, folder, map_id="lobby")
    assert "no pose" in sent
    assert scan["has_pose"] is False
    assert stray == "bad/typo_nmae.pose.txt belongs to no scan"
    assert (folder / "bad/typo_nmae.pose.txt").exists()


def test_a_sidecar_whose_scan_is_still_written_is_no_stray(service: Client, folder: Path) -> None:
    put(folder / "hall.pose.txt", b"1 2 3 0 0 0 1")
    put(folder / "hall.ply.part")
    assert events_of(service, folder) == []


def test_a_refused_scan_that_is_mended_and_moved_back_leaves_nothing_behind(
    service: Client, folder: Path
) -> None:
    put(folder / "monday" / "hall.ply")
    (folder / "monday/hall.pose.txt").write_text("2.O 0 0 0 0 0 1")
    ((sentence, _),) = events_of(service, folder)
    assert "hall.pose.txt cannot be used: '2.O' is no number" in sentence
    for path in sorted((folder / "refused/monday").glob("hall.p*")):
        if not path.name.endswith(".why.json"):
            path.replace(folder / "monday" / path.name)
    (folder / "monday/hall.pose.txt").write_text("2.0 0 0 0 0 0 1")
    events_of(service, folder)
    assert names(folder) == ["done/monday/hall.ply", "done/monday/hall.pose.txt"]


def test_the_same_bytes_with_another_pose_are_told(service: Client, folder: Path) -> None:
    put(folder / "hall.ply")
    ((first, event),) = events_of(service, folder)
    assert "already" not in first
    assert event["was_known"] is False
    put(folder / "hall.ply")
    (folder / "hall.pose.txt").write_text("1 2 3 0 0 0 1")
    ((second, event),) = events_of(service, folder)
    assert "already there; its pose is now the one beside this file" in second
    assert event["was_known"] is True


@pytest.mark.slow
def test_the_command_goes_on_after_a_kill_and_ends_cleanly_when_told(tmp_path: Path, folder: Path) -> None:
    api = ApiProcess(tmp_path)
    data = ply("big") + os.urandom(3_000_000)
    put(folder / "hall.ply", data)
    words = [sys.executable, "-m", "service", "--json", "scans", "watch", str(folder), "--settle", "0.1"]
    with bad_link(api.port, rate=2e6) as link:
        environment = {**os.environ, "SPICD_URL": link.url}
        first = subprocess.Popen(words, cwd=ROOT, env=environment, stdout=subprocess.PIPE)
        until(lambda: api.received() > 1_000_000, 60)
        first.kill()
        first.communicate()
        second = subprocess.Popen(words, cwd=ROOT, env=environment, stdout=subprocess.PIPE)
        assert second.stdout is not None
        event = json.loads(second.stdout.readline())
        assert (event["event"], event["file"], event["size"]) == ("scan", "hall.ply", len(data))
        until((folder / "done/hall.ply").exists)
        assert link.sent < 1.6 * len(data)
        timer = threading.Timer(60, second.kill)
        timer.start()
        second.send_signal(signal.SIGTERM)
        second.communicate()
        timer.cancel()
        assert second.returncode == 0
    assert len(api.uploads()) == 1
    api.kill()


def test_files_of_every_format_are_sent(service: Client, client: TestClient, folder: Path) -> None:
    put(folder / "tower.E57", b"ASTM-E57" + bytes(100))
    put(folder / "hall.copc.laz", b"LASF" + bytes(100) + b"\x87")
    put(folder / "hall.las", b"LASF" + bytes(100) + b"\x07")
    with Watcher(service, folder, WatchOptions(settle_s=0, every_s=0)) as watcher:
        watcher.run_once()
    formats = {scan["filename"]: scan["format"] for scan in client.get("/scans").json()["scans"]}
    assert formats == {"tower.E57": "e57", "hall.copc.laz": "laz", "hall.las": "las"}
