"""Short versions of the programs that break the service on purpose (`make fuzz`)."""

from __future__ import annotations

import json
import mmap
import os
import random
import signal
import subprocess
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from tests.breaking import big_maps, fuzz_api, fuzz_readers, load, soak
from tests.breaking.fuzz_readers import Fuzz, declared_points, run_batch, what_is_wrong
from tests.breaking.requests import Request, Requests
from tests.breaking.scan_mutations import N, samples
from tests.support.flaky_link import flaky_links
from tests.support.footprints import Footprint, footprints, peak_resident
from tests.support.traffic import throttled
from worker.cloud.formats.scan import read_scan

ROOT = Path(__file__).parents[1]
FILES, CASES = 3000, 600


def test_every_sound_sample_is_read_with_all_its_points() -> None:
    for sample in samples():
        with fuzz_readers.memory_file(sample.joined()) as path:
            scan = read_scan(path)
        assert (len(scan.points), scan.n_dropped) == (N - 1, 1), sample.name
        assert what_is_wrong(scan, sample.joined()) is None


def test_mutated_files_are_read_or_refused_in_order(tmp_path: Path) -> None:
    file = tmp_path / "figures.json"
    command = [sys.executable, "-m", "tests.breaking.fuzz_readers", "--files", str(FILES), "--seed", "7"]
    assert subprocess.run([*command, "--json", str(file)], check=False).returncode == 0
    figures = json.loads(file.read_text())
    assert figures["cases"] == FILES
    assert figures["findings"] == {}
    assert figures["outcomes"]["read"] > FILES / 10
    assert figures["outcomes"]["refused: scan_unreadable"] > FILES / 10


def test_a_case_is_the_same_each_time() -> None:
    first, second = Fuzz(samples(), 3), Fuzz(samples(), 3)
    assert [first.content(i) for i in range(50)] == [second.content(i) for i in range(50)]


@pytest.mark.parametrize(
    ("fault", "kind"),
    [
        (lambda: os.kill(os.getpid(), signal.SIGKILL), "crash"),
        (lambda: 1 / 0, "exception"),
        (lambda: time.sleep(1), "hang"),
        (lambda: mmap.mmap(-1, 3 * 1024**3, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS), "exception"),
    ],
)
def test_a_reader_that_fails_is_found(monkeypatch: pytest.MonkeyPatch, fault, kind: str) -> None:
    monkeypatch.setattr(fuzz_readers, "HANG_S", 0.2)
    monkeypatch.setattr(fuzz_readers, "read_scan", lambda *_, **__: fault())
    found = run_batch(Fuzz(samples(), 1), 0, 3)
    assert found.cases == 3
    assert found.counts == {kind: 3}


def test_a_reader_that_gives_too_many_points_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    sound = samples()[0].joined()
    with fuzz_readers.memory_file(sound) as path:
        scan = read_scan(path)
    assert declared_points(sound) == N
    assert (
        what_is_wrong(scan, sound.replace(b"vertex 12", b"vertex 11"))
        == "11 points and 1 dropped of 11 declared"
    )


def test_requests_of_every_kind_get_an_answer_that_the_document_names(tmp_path: Path) -> None:
    file = tmp_path / "figures.json"
    command = [sys.executable, "-m", "tests.breaking.fuzz_api", "--cases", str(CASES), "--seed", "7"]
    assert subprocess.run([*command, "--json", str(file)], check=False).returncode == 0, file.read_text()
    figures = json.loads(file.read_text())
    assert figures["cases"] == CASES
    assert figures["outcomes"]["200"] > CASES / 10


def test_the_peak_of_a_process_is_its_own_and_not_that_of_who_started_it() -> None:
    code = "from tests.support.footprints import peak_resident; print(peak_resident())"
    held = np.ones(400_000_000, np.uint8)
    told = subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True, text=True)
    assert int(told.stdout) < held.nbytes / 2 < peak_resident()


def test_an_answer_that_the_document_does_not_name_is_found() -> None:
    document: dict[str, Any] = {"paths": {"/maps": {"get": {"responses": {"200": {}, "503": {}}}}}}
    problem = bytearray(b'{"type": "a", "title": "b", "detail": "c"}')

    def kinds(status: int | None, body: bytearray = problem, operation=("GET", "/maps")) -> list[str]:
        answer = fuzz_api.Answer(status=status, body=body, operation=operation)
        return [kind for kind, _ in fuzz_api.wrongs(answer, Request("GET", "/maps"), document)]

    assert kinds(200) == kinds(503) == kinds(404, operation=None) == []
    assert kinds(500) == ["5xx"]
    assert kinds(None) == ["5xx"]
    assert kinds(422) == ["undocumented"]
    assert kinds(503, bytearray(b"down")) == ["no problem document"]
    assert kinds(200, operation=None) == ["undocumented"]


def test_requests_are_the_same_for_the_same_seed() -> None:
    document: dict[str, Any] = {
        "paths": {"/maps/{map_id}": {"get": {"responses": {}}, "delete": {"responses": {}}}}
    }

    def made() -> list[Request]:
        requests = Requests(document, {"map_id": ["lobby"]})
        return [requests.make(random.Random(i)) for i in range(100)]

    assert made() == made()


def _samples(resident: list[float], *, files: int = 10, aside: int = 1) -> list[soak.Sample]:
    taken = [Footprint(resident=int(1e6 * size), files=files, threads=4) for size in resident]
    return [soak.Sample(30.0 * i, {"API and launcher": each}, aside) for i, each in enumerate(taken)]


def test_growth_beyond_noise_is_told_and_noise_is_not() -> None:
    rng = random.Random(1)
    level = [200 + rng.uniform(-4, 4) for _ in range(60)]
    assert soak.growth(_samples(level)) == []
    assert soak.growth(_samples([100, 150, *level])) == []  # while it warms up
    leaking = [size + i for i, size in enumerate(level)]
    assert "API and launcher grew from" in soak.growth(_samples(leaking))[0]
    assert abs(soak.slope(_samples(leaking), "API and launcher") - 120e6) < 20e6  # 1 MB in half a minute
    assert "lie in scratch" in soak.growth(_samples(level, aside=9))[0]


def test_a_client_is_throttled_to_its_rate() -> None:
    begun = time.monotonic()
    assert b"".join(throttled(b"a" * 50_000, 100_000)) == b"a" * 50_000
    assert 0.3 < time.monotonic() - begun < 2


def test_a_flaky_link_carries_what_fits_in_its_time_and_breaks_off_the_rest() -> None:
    arrived: list[int] = []

    class Server(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            arrived.append(len(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()

        def log_message(self, *_: object) -> None: ...

    with HTTPServer(("127.0.0.1", 0), Server) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}"
        with flaky_links(2, address, bytes_a_second=400_000, drops_after_s=1.0) as (first, second):
            assert httpx.post(first.url, content=bytes(100_000)).status_code == 204
            with pytest.raises(httpx.TransportError):
                httpx.post(second.url, content=bytes(4_000_000))
        server.shutdown()
    assert arrived[0] == 100_000
    assert (first.dropped, second.dropped) == (0, 1)
    assert 100_000 < second.sent < 800_000


def test_the_footprint_of_a_process_is_that_of_the_system() -> None:
    taken = sum(footprints(os.getpid()).values(), Footprint(0, 0, 0, 0))
    assert taken.processes >= 1
    assert taken.resident > 10e6
    assert taken.files >= 3
    assert taken.threads >= 1


def test_a_percentile_is_a_value_that_was_measured() -> None:
    assert load.percentile([3.0, 1.0, 2.0], 50) == 2.0
    assert load.percentile([float(i) for i in range(1, 201)], 99) == 198.0
    assert load.percentile([5.0], 99) == 5.0


def test_a_made_map_goes_through_the_last_part_of_a_build_with_all_its_points(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in (("_STOREYS", 1), ("_CELL", 3.0), ("_ROOM", 3.0)):
        monkeypatch.setattr(big_maps, name, value)
    told = big_maps.run(1, tmp_path)
    assert told["whole"]
    assert 10_000 < told["points"] < 16_000
    assert {"cloud.ply", "picture.png", "reference.npz", "tileset.bin", "tileset.json"} <= told[
        "sizes"
    ].keys()
    assert len(big_maps._table([told]).splitlines()) == 2 + len(told["stages"]) + len(told["sizes"]) + 1
