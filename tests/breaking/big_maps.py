"""Takes a made map of millions of points through the last part of a map's build: `python -m tests.breaking.big_maps`.

Storeys of rooms are sampled scan by scan as registration leaves them, then fused, given normals, tiled, kept as a map is
kept (`reference.npz`, `seen.npz`, `cloud.ply`, the tileset), and drawn. Each size runs in a process of its own; of each
stage the seconds and the most memory of the process are told, as rows of a Markdown table. Exit status 1 where a stage
took more memory than `--most-mb`, or where a file does not hold every point.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import Any

import numpy as np
from numpy.typing import NDArray

_ROOM, _HEIGHT, _STOREYS = 6.0, 3.0, 4  # metres; storeys above each other
_VOXEL = 0.05
_HITS = 2.5  # points in a voxel of a surface, in the mean
_CELL = 12.0  # metres; what one scan sees
_FILLED = 0.918  # of a surface's voxels, by so many points thrown at random
_MB = 1e6


@dataclass
class Stages:
    """Seconds of processors and peak memory of each stage, in their order."""

    rows: list[tuple[str, float, float]] = field(default_factory=list)

    @contextmanager
    def measured(self, name: str) -> Iterator[None]:
        """Measure what is done within; the kernel's mark of the most memory begins anew (proc(5), clear_refs)."""
        Path("/proc/self/clear_refs").write_text("5")
        begun = time.process_time()
        yield
        self.rows.append((name, time.process_time() - begun, _resident("VmHWM")))


def main(arguments: list[str] | None = None) -> int:
    """Run as told; returns the exit status."""
    options = _parse(arguments)
    if options.alone:
        with TemporaryDirectory(dir=options.folder, prefix="big-map-") as folder:
            print(json.dumps(run(int(options.points[0] * 1e6), Path(folder), colors=options.colors)))
        return 0
    if options.through_service:
        from tests.breaking import big_service

        return int(bool(sum(big_service.run(points, options.folder) for points in options.points)))
    tables = [_in_a_process(points, options) for points in options.points]
    print(_table(tables))
    highest = max(peak for table in tables for _, _, peak in table["stages"])
    lost = [table["points"] for table in tables if not table["whole"]]
    if lost:
        print(f"points are missing in a file of the maps of {lost} points")
    if options.most_mb and highest > options.most_mb:
        print(f"a stage took {highest:.0f} MB, the limit is {options.most_mb}")
    return int(bool(lost) or bool(options.most_mb and highest > options.most_mb))


def run(points: int, folder: Path, *, colors: bool = False) -> dict[str, Any]:
    """Build a map of about so many points in `folder`; returns what was measured."""
    from worker.cloud import npz
    from worker.cloud.formats.ply import write_ply
    from worker.cloud.seen import Seen
    from worker.cloud.sight import Sights
    from worker.cloud.tilesets.writer import pieces_of, write_tileset
    from worker.pipeline.flow import fused_scans, tiled_map, watched
    from worker.pipeline.results.manifest import manifest
    from worker.pipeline.results.refusal import draw_refusal
    from worker.pipeline.settings import PipelineSettings
    from worker.progress import no_progress

    stages, settings = Stages(), PipelineSettings()
    settings = settings.with_values(
        registration=settings.registration.with_values(voxel_size=_VOXEL),
        tiling=settings.tiling.with_values(tiles="touched", min_points=1),
    )
    scans = scans_of(points, colors=colors)
    sights: list[Sights | None] = []
    with stages.measured("fusing"):
        fused = fused_scans(watched(scans, sights), scans_in(points), settings, no_progress)
    with stages.measured("normals and tiles"):
        reference, tiles = tiled_map(fused, None, (), settings, no_progress)
    with stages.measured("reference.npz and seen.npz"):
        npz.save(folder / "reference.npz", reference)
        npz.save(folder / "seen.npz", Seen.of_voxels(fused, sights))
    with stages.measured("cloud.ply and manifest"):
        write_ply(folder / "cloud.ply", reference.points, colors=reference.colors)
        listing = manifest(reference.points, tiles, patch_size=None, min_points=1, voxel_size=_VOXEL)
        (folder / "manifest.json").write_text(json.dumps(listing))
    del tiles, fused
    with stages.measured("tileset"):
        summary = write_tileset(
            folder / "tileset.json",
            folder / "tileset.bin",
            lambda: pieces_of(reference.points, colors=reference.colors, normals=reference.normals),
            scratch=folder,
        )
    with stages.measured("picture"):
        draw_refusal(folder / "picture.png", reference.points, [], title="a made map")
    sizes = {path.name: path.stat().st_size for path in sorted(folder.iterdir())}
    header = (folder / "cloud.ply").open("rb").read(200)
    whole = f"element vertex {len(reference.points)}\n".encode() in header
    first = json.loads((folder / "tileset.json").read_text())["root"]["content"]["uri"]
    return {
        "points": len(reference.points),
        "scans": scans_in(points),
        "whole": whole and summary.n_points == len(reference.points),
        "contents": summary.contents,
        "first_content": int(first.rpartition("-")[2].removesuffix(".glb")),
        "stages": stages.rows,
        "sizes": sizes,
    }


def scans_in(points: int) -> int:
    """Return how many scans a map of so many points is made of."""
    return _STOREYS * _cells(points) ** 2


def scans_of(points: int, *, colors: bool = False) -> Iterator[Any]:
    """Yield scans of a made building whose fused cloud has about so many points."""
    from worker.pipeline.registration.results import RegisteredScan

    cells, rng = _cells(points), np.random.default_rng(7)
    for number in range(scans_in(points)):
        storey, rest = divmod(number, cells**2)
        corner = np.array([*divmod(rest, cells), storey * _HEIGHT / _CELL]) * _CELL
        cloud = (_rooms(rng) + corner).astype(np.float32)
        seen = np.repeat((cloud[:, 2:] * 40 % 256), 3, axis=1).astype(np.uint8)
        yield RegisteredScan(
            name=f"{number}.ply",
            points=cloud,
            colors=seen if colors else None,
            map_from_scan=np.eye(4),
            sensor_origin=corner + np.array([_CELL / 2 + 0.5, _CELL / 2 + 0.5, 1.5]),
        )


def _cells(points: int) -> int:
    """Return the cells along a side of a storey."""
    return max(round((points / (_STOREYS * _area() * _FILLED / _VOXEL**2)) ** 0.5), 1)


def _area() -> float:
    """Return the square metres of surface in a cell: floor, ceiling, and walls along the sides of its rooms."""
    return 2 * _CELL**2 + 2 * (_CELL / _ROOM) * _CELL * (_HEIGHT - 0.2)


def _rooms(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return points on the surfaces of a cell, which begins at 0; surfaces lie in the middle of voxels."""
    density = _HITS / _VOXEL**2
    flat = rng.uniform(0, _CELL, (int(2 * _CELL**2 * density), 2))
    level = np.where(np.arange(len(flat)) % 2, _HEIGHT - 0.175, 0.025)
    parts = [np.column_stack([flat, level])]
    for axis in (0, 1):
        for wall in np.arange(0, _CELL, _ROOM) + 0.025:
            count = int(_CELL * (_HEIGHT - 0.2) * density)
            along, up = rng.uniform(0, _CELL, count), rng.uniform(0.05, _HEIGHT - 0.2, count)
            columns = [np.full(count, wall), along] if axis == 0 else [along, np.full(count, wall)]
            parts.append(np.column_stack([*columns, up]))
    return np.concatenate(parts)


def _resident(name: str) -> float:
    """Return a line of /proc/self/status, in MB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    (line,) = (line for line in lines if line.startswith(f"{name}:"))
    return int(line.split()[1]) * 1024 / _MB


def _in_a_process(points: float, options: argparse.Namespace) -> dict[str, Any]:
    words = [sys.executable, "-m", "tests.breaking.big_maps", "--alone", "--points", str(points)]
    words += ["--folder", str(options.folder)] + (["--colors"] if options.colors else [])
    ended = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True)
    told: dict[str, Any] = json.loads(ended.stdout)
    print(f"{told['points']:,} points of {told['scans']} scans done", file=sys.stderr)
    return told


def _table(tables: Sequence[dict[str, Any]]) -> str:
    """Return stages and files by size, as Markdown."""
    lines = ["| " + " | ".join(["", *(f"{table['points'] / 1e6:.1f} M points" for table in tables)]) + " |"]
    lines.append("| --- |" + " ---: |" * len(tables))
    for row, (name, _, _) in enumerate(tables[0]["stages"]):
        cells = [f"{table['stages'][row][1]:.1f} s, {table['stages'][row][2]:.0f} MB" for table in tables]
        lines.append("| " + " | ".join([name, *cells]) + " |")
    for name in tables[0]["sizes"]:
        cells = [f"{table['sizes'][name] / _MB:.1f} MB" for table in tables]
        lines.append("| " + " | ".join([f"`{name}`", *cells]) + " |")
    told = [f"{table['contents']}, {table['first_content'] / _MB:.2f} MB" for table in tables]
    lines.append("| " + " | ".join(["contents, the first one", *told]) + " |")
    return "\n".join(lines)


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.breaking.big_maps", description=__doc__)
    parser.add_argument(
        "--points", type=float, nargs="+", default=[1, 5, 20], metavar="M", help="millions of points"
    )
    parser.add_argument("--colors", action="store_true", help="the scans have colours")
    parser.add_argument(
        "--folder", type=Path, default=Path(gettempdir()), help="where the files lie meanwhile"
    )
    parser.add_argument("--most-mb", type=float, default=0, help="of a stage; 0: no limit")
    parser.add_argument(
        "--through-service", action="store_true", help="scans of a hall, uploaded, and a survey of it"
    )
    parser.add_argument("--alone", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
