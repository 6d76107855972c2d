"""Stage values on disk: what one job's process hands to the next, and what a map keeps for its surveys.

Each is a dataclass that `worker.cloud.npz` keeps; here stands what release 0.1 kept otherwise.
"""

from __future__ import annotations

from pathlib import Path

from worker.cloud import npz
from worker.cloud.tiling import TileGrid
from worker.pipeline.mapping.fusion import ReferenceMap
from worker.pipeline.registration.results import RegisteredScan


def load_reference(path: Path, *, tiles_of_0_1: Path | None = None) -> ReferenceMap:
    """Read a map. Release 0.1 kept its grid beside it, with the points of every tile. Raises ValueError."""
    if tiles_of_0_1 is None:
        return npz.load(path, ReferenceMap)
    return npz.load(path, ReferenceMap, grid=_grid_of_0_1(tiles_of_0_1))


def load_scan(path: Path) -> RegisteredScan:
    """Read an accepted scan; in a file of release 0.1 its name is the file's. Raises ValueError."""
    return npz.load(path, RegisteredScan, name=path.name)


def _grid_of_0_1(path: Path) -> TileGrid:
    """Read the grid alone; that of a map that never grew says nothing of a lowest index."""
    arrays = npz.load_arrays(path, ("origin", "size", "shape", "lowest"))
    i, j, k = (int(count) for count in arrays["shape"])
    a, b, c = (int(number) for number in arrays.get("lowest", (0, 0, 0)))
    return TileGrid(origin=arrays["origin"], size=arrays["size"], shape=(i, j, k), lowest=(a, b, c))
