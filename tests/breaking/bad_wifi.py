"""Robots that upload through links that break all the time, by one request and by a resumable upload.

    python -m tests.breaking.bad_wifi [ROBOTS [SECONDS]]

Each robot has a link of 200 kB/s that drops every 5 s, and a scan of 2 MB, which takes 10 s of it.
"""

from __future__ import annotations

import random
import sys
import tempfile
import threading
import time
from pathlib import Path

import httpx

from service.resumable import Persistence, upload
from tests.support.api_process import ApiProcess
from tests.support.bad_link import bad_link
from tests.support.samples import ply

RATE, DROP_S, SIZE = 200e3, 5.0, 2_000_000
PATIENT = Persistence(first_wait_s=0.2, longest_wait_s=2.0)


def main(robots: int = 20, seconds: float = 60.0) -> None:
    """Print what arrived, when, and how many bytes it took."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        api = ApiProcess(folder)
        try:
            for way in (by_one_request, by_pieces):
                _measure(way, api, folder, robots, seconds)
        finally:
            api.kill()


def by_one_request(http: httpx.Client, path: Path, until: float) -> bool:
    """POST /scans, again and again."""
    while time.monotonic() < until:
        try:
            headers = {"Content-Type": "application/octet-stream"}
            answer = http.post("/scans", content=path.read_bytes(), headers=headers, timeout=30)
            return answer.status_code in (200, 201)
        except httpx.TransportError:
            time.sleep(0.2)
    return False


def by_pieces(http: httpx.Client, path: Path, _until: float) -> bool:
    """/uploads."""
    return upload(http, path, persistence=PATIENT)["size"] == path.stat().st_size


def _measure(way: object, api: ApiProcess, folder: Path, robots: int, seconds: float) -> None:
    begun, taken, sent, drops = time.monotonic(), [], [], []

    def drive(number: int) -> None:
        path = folder / f"{way.__name__}-{number}.ply"  # type: ignore[attr-defined]
        path.write_bytes(ply(str(number)) + random.Random(number).randbytes(SIZE))
        with (
            bad_link(api.port, rate=RATE, drop_every_s=DROP_S) as link,
            httpx.Client(base_url=link.url) as http,
        ):
            if way(http, path, begun + seconds):  # type: ignore[operator]
                taken.append(time.monotonic() - begun)
            sent.append(link.sent)
            drops.append(link.drops)

    threads = [threading.Thread(target=drive, args=(number,)) for number in range(robots)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    latest = f"the last after {max(taken):.1f} s" if taken else f"none within {seconds:.0f} s"
    print(
        f"{way.__name__}: {len(taken)} of {robots} arrived, {latest}; "  # type: ignore[attr-defined]
        f"{sum(sent) / robots / SIZE:.2f} times the bytes were sent, {sum(drops)} connections broke"
    )


if __name__ == "__main__":
    main(*(int(word) for word in sys.argv[1:]))
