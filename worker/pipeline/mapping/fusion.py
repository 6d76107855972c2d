"""Maps: registered scans fused to one cloud at the voxel size (paper, Section 3.3.3)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from worker.cloud.fusing import MEMORY_BYTES, FusedCloud, fused_cloud
from worker.cloud.tiling import TileGrid, Tiles, cut
from worker.cloud.types import Bools, Colors, Indices, Normals, Points
from worker.errors import MapFailed
from worker.pipeline.registration.results import RegisteredScan
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.registration.surface import Surface, oriented_normals


@dataclass(frozen=True, kw_only=True, slots=True)
class ReferenceMap:
    """What surveys are registered to and compared with."""

    points: Points  #: (M, 3) float32, metres, map frame, one a voxel
    normals: Normals  #: (M, 3) float32
    oriented: Bools  #: (M,) whether the normal points to the side that was seen
    colors: Colors | None  #: (M, 3) uint8
    voxel_size: float  #: metres
    grid: TileGrid  #: that surveys are compared along

    def tiles(self, *, min_points: int) -> Tiles:
        """Cut the map along its grid; tiles with fewer than `min_points` are left out."""
        return cut(self.points, self.grid, min_points=min_points)

    def surface(self) -> Surface:
        """Return the map as a target of ICP; builds a tree (about 10 ms for 100,000 points)."""
        return Surface.of(self.points, self.normals, self.oriented)


@dataclass(frozen=True, kw_only=True, slots=True)
class CurrentMap:
    """What a survey saw, in the frame and at the spacing of the map."""

    points: Points  #: (M, 3) float32, metres, map frame, one a voxel
    colors: Colors | None  #: (M, 3) uint8
    displaced: Indices | None = None  #: (T, 3) tiles in which walls, floor or ceiling do not lie on the map's


def fuse(
    scans: Iterable[RegisteredScan], *, voxel_size: float, memory_bytes: int = MEMORY_BYTES
) -> FusedCloud:
    """Average the points of all scans in each voxel of the map frame; the points of one scan in memory at a time.

    What takes more than about `memory_bytes` beside the answer is written aside. Raises MapFailed where there is no scan.
    """
    cloud = fused_cloud((scan.voxels(voxel_size) for scan in scans), memory_bytes=memory_bytes)
    if cloud is None:
        raise MapFailed("no scan is left to fuse; see the reasons listed with the scans")
    return cloud


def reference_map(cloud: FusedCloud, *, grid: TileGrid, settings: RegistrationSettings) -> ReferenceMap:
    """Return the fused cloud with the normals that surveys will need, computed once."""
    normals, oriented = oriented_normals(cloud.points, cloud.views, settings)
    return ReferenceMap(
        points=cloud.points,
        normals=normals,
        oriented=oriented,
        colors=cloud.colors,
        voxel_size=cloud.size,
        grid=grid,
    )


def current_map(cloud: FusedCloud) -> CurrentMap:
    """Return what a survey's scans were fused to, as those of the map are (paper, Section 3.9.1)."""
    return CurrentMap(points=cloud.points, colors=cloud.colors)
