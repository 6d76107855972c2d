"""Lets a service of its own work steadily and lightly for hours: `python -m tests.breaking.soak`.

A survey every few seconds, the oldest ones deleted, changes asked for; every half minute the memory, open files and
threads of each process are noted, and what lies in scratch and temporary folders. Exit status 1 where a process that
stays has grown beyond noise, where files are left behind, or where a request or a survey failed.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import httpx
import numpy as np

from tests.breaking.load import MAP, build_map
from tests.support.findings import Deadline, add_common, show
from tests.support.footprints import Footprint, footprints
from tests.support.running_service import ROOT, Service
from tests.support.traffic import Room, send_scan

STAYING = ("API and launcher", "geometry worker", "inference worker", "valkey-server")
#: What a process may have more at the end than before, without that being growth: bytes, or the share of what it took.
_NOISE_BYTES, _NOISE_SHARE, _NOISE_FILES, _NOISE_THREADS = 16e6, 0.05, 8, 4
_KEPT_SURVEYS = 10
_LEFT_AT_ONCE = 4  # folders and files that work in progress has aside
_FEWEST = 8  # samples, of which a growth can be told


@dataclass(frozen=True)
class Sample:
    """What was there at one time."""

    at: float  #: seconds from the begin
    processes: dict[str, Footprint]
    aside: int  #: files and folders in scratch, incoming and temporary folders


@dataclass
class Soak:
    """A run: what was done, and what was seen."""

    samples: list[Sample] = field(default_factory=list)
    done: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)


def main(arguments: list[str] | None = None) -> int:
    """Run as told; returns the exit status."""
    options = _parse(arguments)
    with started() as (service, folders):
        room = Room()
        build_map(service, room)
        soak = work(service, folders, room, options)
    grown = growth(soak.samples)
    grown += [f"{len(soak.wrong)} requests or surveys failed, first: {soak.wrong[0]}"] if soak.wrong else []
    rows, document = report(soak, grown)
    show(rows, document, options.json)
    if options.plot is not None:
        draw(soak.samples, options.plot)
    for line in grown:
        print(line)
    return 1 if grown else 0


@contextmanager
def started() -> Iterator[tuple[Service, tuple[Path, ...]]]:
    """Give a service, and the folders that are empty where nothing is left behind."""
    with TemporaryDirectory(prefix="spicd-soak-") as name:
        folder, before = Path(name), os.environ.get("TMPDIR")
        temporary = folder / "tmp"
        temporary.mkdir()
        os.environ["TMPDIR"] = str(temporary)
        try:
            service = Service(folder, ROOT / "model_store")
        finally:
            os.environ.pop("TMPDIR") if before is None else os.environ.update(TMPDIR=before)
        try:
            yield service, (temporary, folder / "data" / "scratch", folder / "data" / "incoming")
        finally:
            service.end()


def work(service: Service, folders: Sequence[Path], room: Room, options: argparse.Namespace) -> Soak:
    """Hand in a survey every so often, and take samples, until time is up."""
    soak, deadline, surveys = Soak(), Deadline(options.minutes), list[tuple[str, str]]()
    number = 0
    while not deadline.over():
        if deadline.passed_s() >= len(soak.samples) * options.sample:
            aside = sum(1 for folder in folders if folder.is_dir() for _ in folder.iterdir())
            soak.samples.append(Sample(deadline.passed_s(), footprints(service.process.pid), aside))
        if deadline.passed_s() >= number * options.every:
            number += 1
            try:
                _round(service.http, room, number, surveys, soak)
            except (httpx.HTTPError, KeyError) as error:
                soak.wrong.append(f"round {number}: {type(error).__name__}: {str(error)[:200]}")
        time.sleep(0.2)
    return soak


def _round(http: httpx.Client, room: Room, number: int, surveys: list[tuple[str, str]], soak: Soak) -> None:
    """Upload and hand in one scan, look at what is there, and delete what is old. Raises HTTPError."""
    scan_id = send_scan(http, room.survey_upload(number)).raise_for_status().json()["scan_id"]
    body = {"scan_ids": [scan_id]}
    survey_id = http.post(f"/maps/{MAP}/surveys", json=body).raise_for_status().json()["survey_id"]
    surveys.append((survey_id, scan_id))
    for path in (f"/maps/{MAP}/changes", f"/maps/{MAP}/surveys", "/jobs", "/metrics", "/health/ready"):
        http.get(path).raise_for_status()
    soak.done["surveys handed in"] += 1
    while len(surveys) > _KEPT_SURVEYS:
        old, scan_id = surveys[0]
        document = http.get(f"/surveys/{old}").raise_for_status().json()
        if document["status"] not in ("ready", "successful", "failed", "dismissed"):
            return  # it still runs; the machine is slow
        soak.done[f"ended {document['status']}"] += 1
        if document["status"] in ("failed", "dismissed"):
            soak.wrong.append(f"survey {old}: {document.get('problem')}")
        http.delete(f"/surveys/{old}").raise_for_status()
        http.delete(f"/scans/{scan_id}").raise_for_status()
        surveys.pop(0)


def growth(samples: Sequence[Sample]) -> list[str]:
    """Return what has grown: the median of the last quarter against that of the second one, where all is warm."""
    if len(samples) < _FEWEST:
        return []
    quarter = len(samples) // 4
    early, late = samples[quarter : 2 * quarter], samples[-quarter:]
    grown = []
    for name in STAYING:
        first, last = _typical(early, name), _typical(late, name)
        if last.resident - first.resident > max(_NOISE_BYTES, _NOISE_SHARE * first.resident):
            grown.append(f"{name} grew from {first.resident / 1e6:.0f} to {last.resident / 1e6:.0f} MB")
        if last.files - first.files > _NOISE_FILES:
            grown.append(f"{name} had {first.files} files open, then {last.files}")
        if last.threads - first.threads > _NOISE_THREADS:
            grown.append(f"{name} had {first.threads} threads, then {last.threads}")
    left = int(median(sample.aside for sample in late))
    if left > _LEFT_AT_ONCE:
        grown.append(f"{left} files and folders lie in scratch, incoming and temporary folders")
    return grown


def _typical(samples: Sequence[Sample], name: str) -> Footprint:
    there = [sample.processes[name] for sample in samples if name in sample.processes]
    if not there:
        return Footprint(0, 0, 0)
    return Footprint(
        resident=int(median(taken.resident for taken in there)),
        files=int(median(taken.files for taken in there)),
        threads=int(median(taken.threads for taken in there)),
    )


def slope(samples: Sequence[Sample], name: str) -> float:
    """Return by how many bytes an hour a process grew, by least squares over all samples but the first quarter."""
    warm = samples[len(samples) // 4 :]
    points = [
        (sample.at / 3600, sample.processes[name].resident) for sample in warm if name in sample.processes
    ]
    if len(points) < 2:
        return 0.0
    hours, sizes = np.transpose(points)
    return float(np.polyfit(hours, sizes, 1)[0])


def report(soak: Soak, grown: list[str]) -> tuple[dict[str, object], dict[str, Any]]:
    """Return the figures as rows of a table, and as a document."""
    first, last = soak.samples[0], soak.samples[-1]
    rows: dict[str, object] = {
        "work": f"{dict(soak.done)} in {last.at / 60:.0f} minutes, {len(soak.samples)} samples",
        "left aside at the end": last.aside,
    }
    for name in STAYING:
        start, end = first.processes.get(name), last.processes.get(name)
        if start is not None and end is not None:
            rows[name] = (
                f"{start.resident / 1e6:.0f} to {end.resident / 1e6:.0f} MB, "
                f"{slope(soak.samples, name) / 1e6:+.1f} MB an hour; files {start.files} to {end.files}, "
                f"threads {start.threads} to {end.threads}"
            )
    rows["beyond noise"] = grown or "nothing"
    document = {
        "done": dict(soak.done),
        "grown": grown,
        "bytes_an_hour": {name: round(slope(soak.samples, name)) for name in STAYING},
        "samples": [
            {"at": round(sample.at, 1), "aside": sample.aside}
            | {name: [taken.resident, taken.files, taken.threads] for name, taken in sample.processes.items()}
            for sample in soak.samples
        ],
    }
    return rows, document


def draw(samples: Sequence[Sample], path: Path) -> None:
    """Draw the memory of each process that stays over time, as PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 5), layout="constrained")
    axes = figure.subplots()
    for name in STAYING:
        points = [
            (sample.at / 60, sample.processes[name].resident / 1e6)
            for sample in samples
            if name in sample.processes
        ]
        if points:
            axes.plot(*zip(*points, strict=True), label=name)
    axes.set(xlabel="minutes", ylabel="resident memory, MB", ylim=(0, None))
    axes.legend()
    figure.savefig(path, dpi=120)


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.breaking.soak", description=__doc__)
    parser.add_argument("--every", type=float, default=6.0, help="seconds between two surveys")
    parser.add_argument("--sample", type=float, default=30.0, help="seconds between two samples")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the memory over time, as PNG")
    add_common(parser, minutes=120)
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
