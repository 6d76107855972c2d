"""The tile manifest of a map as a document; `worker/pipeline/results/manifest.py` writes it when the map is built."""

from __future__ import annotations

from pydantic import Field

from service.api.http.answering.documents import Document
from service.catalog.records import Bounds, Vector3

Cells = tuple[int, int, int]


class ManifestTile(Document):
    """One tile that is kept."""

    patch_id: str = Field(description="id of the tile", examples=["tile_004_002_000"])
    tile_idx: Cells = Field(description="its cell in the grid", examples=[[4, 2, 0]])
    tile_center: Vector3 = Field(description="metres, map frame", examples=[[6.75, 3.75, 0.5]])
    n_original_points: int = Field(description="points of the map in the tile", examples=[1904])
    n_sampled_points: int | None = Field(
        description="that a model with patches takes of them; null of others", examples=[1024]
    )
    file: None = Field(description="tiles have no files: they are cut from the map's cloud along the grid")
    dense_file: None = Field(description="likewise")


class Manifest(Document):
    """Tile size, bounds and the tiles of a map (paper, Table A1); metres, map frame."""

    tile_size: Vector3 = Field(examples=[[1.5, 1.5, 1.0]])
    tile_origin: Vector3 = Field(description="corner of the grid's cell 0, 0, 0", examples=[[0.0, 0.0, 0.0]])
    tile_lowest_idx: Cells = Field(description="lowest cell in which there are points", examples=[[0, 0, 0]])
    n_tiles_grid: Cells = Field(description="cells of the grid along each axis", examples=[[8, 6, 3]])
    map_bounds: Bounds
    dense_voxel: float = Field(description="voxel size of the map's cloud", examples=[0.05])
    patch_size: int | None = Field(
        description="points that a model with patches takes of a tile; null of others", examples=[1024]
    )
    min_points: int = Field(description="with fewer a tile is skipped", examples=[50])
    save_dense_tiles: bool = Field(examples=[False])
    patches: list[ManifestTile] = Field(description="the tiles that are kept")
    n_valid_patches: int = Field(description="how many", examples=[172])
    n_skipped_tiles: int = Field(description="cells that are empty, or have too few points", examples=[20])
