"""What 3d-tiles-renderer and the Khronos validator of glTF make of a map's tileset, asked for as viewers ask."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from service.api.gis.geodesy import to_ecef
from service.catalog.files import blob_keys
from service.catalog.files.tilesets import address
from service.catalog.records import Anchor, Bounds, Tileset
from tests.support.live import live
from tests.support.samples import add_map, settings_in
from tests.support.tools import MISSING, TESTS, TOOLS, run
from worker.cloud.tilesets.writer import TilesetSettings, pieces_of, write_tileset

pytestmark = [
    pytest.mark.skipif(not (TOOLS / "node_modules" / "3d-tiles-renderer").exists(), reason=MISSING),
    pytest.mark.slow,
]
ANCHOR = Anchor(longitude=13.4, latitude=52.5, height=76.2, heading=30.0)


@dataclass(frozen=True)
class Shown:
    """A map that is served, and its cloud."""

    url: str
    points: NDArray[np.float32]
    told: Tileset

    def read(self, document: str, error_target: float) -> dict[str, Any]:
        said = run("node", TESTS / "read_tileset.mjs", f"{self.url}{document}", str(error_target))
        found: dict[str, Any] = json.loads(said)
        return found


@pytest.fixture(scope="module", params=["colours", "normals", "neither"])
def shown(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shown]:
    """Two storeys of 60,000 points, some hundred metres from the origin of the map."""
    folder = tmp_path_factory.mktemp("service")
    rng = np.random.default_rng(5)
    points = rng.uniform(0, 40, (60_000, 3)).astype(np.float32)
    points[:, 2] = rng.integers(0, 2, len(points)) * 3
    points += np.array([300, -120, 5], np.float32)
    columns: dict[str, Any] = {}
    if request.param == "colours":
        columns["colors"] = rng.integers(0, 256, points.shape).astype(np.uint8)
    if request.param == "normals":
        columns["normals"] = np.tile(np.array([0, 0, 1], np.float32), (len(points), 1))
    summary = write_tileset(
        folder / "tileset.json",
        folder / "tileset.bin",
        lambda: pieces_of(points, **columns),
        scratch=folder,
        address=lambda at: address(at.sha256, at.offset, at.length),
        settings=TilesetSettings(leaf_points=4000),
    )
    told = Tileset.model_validate(asdict(summary))
    with live(settings_in(folder)) as service:
        catalog = service.services.catalog
        job_id = add_map(catalog)
        low, high = points.min(axis=0).tolist(), points.max(axis=0).tolist()
        catalog.versions.save_result(
            job_id, outcomes=[], bounds=Bounds(min=tuple(low), max=tuple(high)), counts={}, tileset=told
        )
        catalog.maps.set_anchor("lobby", ANCHOR)
        catalog.blobs.put_file(blob_keys.map_tileset(job_id), folder / "tileset.json")
        catalog.blobs.put_file(blob_keys.map_tileset_contents(job_id), folder / "tileset.bin")
        yield Shown(url=service.url, points=points, told=told)


def test_a_viewer_loads_every_point_where_it_is_and_the_validator_finds_nothing(
    shown: Shown, request: pytest.FixtureRequest
) -> None:
    found = shown.read("/maps/lobby/tileset.json", 0)
    assert found["points"] == len(shown.points)
    assert (found["contents"], found["documents"]) == (shown.told.contents, 2)
    assert np.array(found["box"]) == pytest.approx(
        np.array([shown.points.min(axis=0), shown.points.max(axis=0)]), abs=0.001
    )
    assert found["issues"] == []
    kind = {"colours": ["color"], "normals": ["normal"], "neither": []}[request.node.callspec.params["shown"]]
    assert found["attributes"] == [*kind, "position"]


def test_a_viewer_begins_with_a_small_part_that_is_spread_over_all(shown: Shown) -> None:
    found = shown.read("/maps/lobby/versions/1/tileset.json", 16)
    assert 0 < found["contents"] < shown.told.contents / 4
    assert found["points"] < len(shown.points) / 4
    assert np.array(found["box"]) == pytest.approx(
        np.array([shown.points.min(axis=0), shown.points.max(axis=0)]), abs=2.0
    )


def test_a_globe_finds_the_map_where_its_anchor_is(shown: Shown) -> None:
    found = shown.read("/maps/lobby/tileset.json?crs=EPSG:4978", 0)
    assert found["points"] == len(shown.points)
    middle = np.mean(found["box"], axis=0)
    origin = to_ecef(math.radians(ANCHOR.longitude), math.radians(ANCHOR.latitude), ANCHOR.height)
    away = np.linalg.norm(shown.points.mean(axis=0))
    assert np.linalg.norm(middle - origin) == pytest.approx(away, abs=5)
    assert np.linalg.norm(np.diff(found["box"], axis=0)) > 40
