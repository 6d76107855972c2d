"""Stage values on disk: what one job's process hands to the next, and what a map keeps for its surveys.

Plain `.npz`, arrays only (no pickle), written aside and renamed, so that a reader never sees half a file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from worker.cloud.tiling import TileGrid, TilePairs, Tiles, tile_id
from worker.cloud.types import Arrays, Points
from worker.detectors.detector import TileScores
from worker.pipeline.mapping.fusion import CurrentMap, ReferenceMap
from worker.pipeline.registration.results import RegisteredScan


def save_arrays(path: Path, arrays: Arrays) -> None:
    """Write named arrays."""
    aside = path.with_name(path.name + ".tmp")
    with aside.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
    aside.replace(path)


def load_arrays(path: Path) -> Arrays:
    """Read what `save_arrays` wrote; raises ValueError on anything else."""
    with np.load(path, allow_pickle=False) as archive:
        return dict(archive)


def save_reference(path: Path, reference: ReferenceMap) -> None:
    """Keep the map with its normals."""
    arrays: Arrays = {
        "points": reference.points,
        "normals": reference.normals,
        "oriented": reference.oriented,
        "voxel_size": np.array([reference.voxel_size]),
    }
    if reference.colors is not None:
        arrays["colors"] = reference.colors
    save_arrays(path, arrays)


def load_reference(path: Path) -> ReferenceMap:
    """Read what `save_reference` wrote."""
    arrays = load_arrays(path)
    return ReferenceMap(
        points=arrays["points"],
        normals=arrays["normals"],
        oriented=arrays["oriented"],
        colors=arrays.get("colors"),
        voxel_size=float(arrays["voxel_size"][0]),
    )


def save_current(path: Path, current: CurrentMap) -> None:
    """Keep the survey's fused cloud."""
    colors: Arrays = {} if current.colors is None else {"colors": current.colors}
    save_arrays(path, {"points": current.points, **colors})


def load_current(path: Path) -> CurrentMap:
    """Read what `save_current` wrote."""
    arrays = load_arrays(path)
    return CurrentMap(points=arrays["points"], colors=arrays.get("colors"))


def save_scan(path: Path, scan: RegisteredScan) -> None:
    """Keep an accepted scan's points, pose and sensor origin (where known): detectors that follow rays need them."""
    colors: Arrays = {} if scan.colors is None else {"colors": scan.colors}
    origin: Arrays = {} if scan.sensor_origin is None else {"sensor_origin": scan.sensor_origin}
    save_arrays(path, {"points": scan.points, "map_from_scan": scan.map_from_scan, **origin, **colors})


def load_scan(path: Path) -> RegisteredScan:
    """Read what `save_scan` wrote; its name is the file's."""
    arrays = load_arrays(path)
    return RegisteredScan(
        name=path.name,
        points=arrays["points"],
        colors=arrays.get("colors"),
        map_from_scan=arrays["map_from_scan"],
        sensor_origin=arrays.get("sensor_origin"),
    )


def save_tiles(path: Path, tiles: Tiles, *, patches: Sequence[Points]) -> None:
    """Keep the grid, and for each tile `dense/<tile_id>` (n, 3) and `patch/<tile_id>` (paper, Table A1)."""
    arrays = _grid_arrays(tiles)
    for index, dense, patch in zip(tiles.indices, tiles.points, patches, strict=True):
        arrays[f"dense/{tile_id(index)}"] = dense
        arrays[f"patch/{tile_id(index)}"] = patch
    save_arrays(path, arrays)


def load_tiles(path: Path) -> Tiles:
    """Read what `save_tiles` wrote, without the patches."""
    with np.load(path, allow_pickle=False) as archive:
        indices = archive["indices"]
        points = tuple(archive[f"dense/{tile_id(index)}"] for index in indices)
        return Tiles(grid=_grid(archive), indices=indices, points=points)


def save_pairs(path: Path, pairs: TilePairs) -> None:
    """Keep the tiles of both sides."""
    arrays = _grid_arrays(pairs.reference) | _ragged("reference", pairs.reference.points)
    save_arrays(path, arrays | _ragged("current", pairs.current) | {"observed": pairs.observed})


def load_pairs(path: Path) -> TilePairs:
    """Read what `save_pairs` wrote."""
    arrays = load_arrays(path)
    return TilePairs(
        reference=_tiles(arrays), current=_unragged("current", arrays), observed=arrays["observed"]
    )


def save_scores(path: Path, scores: TileScores) -> None:
    """Keep the probabilities."""
    save_arrays(path, {"probabilities": scores.probabilities})


def load_scores(path: Path) -> TileScores:
    """Read what `save_scores` wrote."""
    return TileScores(probabilities=load_arrays(path)["probabilities"])


def _grid_arrays(tiles: Tiles) -> Arrays:
    grid = tiles.grid
    return {
        "origin": grid.origin,
        "size": grid.size,
        "shape": np.array(grid.shape, np.int64),
        "lowest": np.array(grid.lowest, np.int64),
        "indices": tiles.indices,
    }


def _grid(arrays: Mapping[str, Any]) -> TileGrid:
    i, j, k = (int(count) for count in arrays["shape"])
    # files of maps that had one version only say nothing of the lowest index
    lowest = arrays.get("lowest", (0, 0, 0))
    a, b, c = (int(number) for number in lowest)
    return TileGrid(origin=arrays["origin"], size=arrays["size"], shape=(i, j, k), lowest=(a, b, c))


def _tiles(arrays: Arrays) -> Tiles:
    return Tiles(grid=_grid(arrays), indices=arrays["indices"], points=_unragged("reference", arrays))


def _ragged(name: str, parts: Sequence[Points]) -> Arrays:
    """Arrays of different lengths as one array and the place where each ends."""
    points = np.concatenate(parts) if parts else np.empty((0, 3), np.float32)
    return {
        f"{name}_points": points,
        f"{name}_ends": np.cumsum([len(part) for part in parts], dtype=np.int64),
    }


def _unragged(name: str, arrays: Arrays) -> tuple[Points, ...]:
    return tuple(np.split(arrays[f"{name}_points"], arrays[f"{name}_ends"])[:-1])  # behind the last: nothing
