"""What other people's programs make of features: GeoPandas, ogr2ogr and QGIS's own library read the answers."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from fastapi.testclient import TestClient

from tests.service.api.test_objects import BERLIN, add_story
from tests.support.samples import RememberingQueue, catalog_of, running, settings_in
from tests.support.tools import TESTS, needs_tools, run

#: Where corners of BERLIN's map lie: its x axis points east, so that a metre is 1/67.8e3 and 1/111.3e3 degrees.
LONGITUDE, LATITUDE, EAST, NORTH = 13.4, 52.5, 67_900, 111_270
_QGIS = ["/usr/bin/python3", "-c", "import qgis.core"]


def _has_qgis() -> bool:
    try:
        return subprocess.run(_QGIS, capture_output=True, timeout=60, check=False).returncode == 0
    except OSError:
        return False


class Answers(NamedTuple):
    """The answers of a service as files, and how many features each has."""

    paths: dict[str, Path]
    rows: dict[str, int]


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[TestClient, dict[str, str]]]:
    """A service with a map, its visits and its objects; and the addresses of each answer of features."""
    with running(settings_in(tmp_path_factory.mktemp("service")), RememberingQueue()) as client:
        first, *_ = add_story(catalog_of(client))
        (thing, *_) = client.get("/maps/lobby/objects").json()["features"]
        yield (
            client,
            {
                "tiles": f"/surveys/{first}/tiles",
                "sightings": f"/surveys/{first}/objects",
                "changes": "/maps/lobby/changes?state=unchanged",
                "objects": "/maps/lobby/objects",
                "object": f"/maps/lobby/objects/{thing['id']}",
            },
        )


ROWS = {"tiles": 18, "sightings": 2, "changes": 54, "objects": 3, "object": 1}


def written(
    client: tuple[TestClient, dict[str, str]], folder: Path, *, ends: str = "geojson", **asked: str
) -> list[Path]:
    """Each answer in a file of its own, in the order of `ROWS`."""
    service, addresses = client
    paths = []
    for name in ROWS:
        answer = service.get(addresses[name], params={**_of(addresses[name]), **asked})
        assert answer.status_code == 200, answer.text
        paths.append(folder / f"{name}.{ends}")
        paths[-1].write_bytes(answer.content)
    return paths


def _of(address: str) -> dict[str, str]:
    _, _, query = address.partition("?")
    return dict(part.split("=") for part in query.split("&") if part)


@pytest.fixture
def anchored(client: tuple[TestClient, dict[str, str]]) -> Iterator[tuple[TestClient, dict[str, str]]]:
    """The same on the Earth."""
    client[0].put("/maps/lobby/anchor", json=BERLIN)
    yield client
    client[0].delete("/maps/lobby/anchor")


def read(*paths: Path) -> list[dict[str, Any]]:
    seen: list[dict[str, Any]] = json.loads(run("python", TESTS / "read_features.py", *paths))
    return seen


@needs_tools
@pytest.mark.slow
def test_geopandas_reads_every_answer_on_the_earth(anchored: Any, tmp_path: Path) -> None:
    seen = read(*written(anchored, tmp_path))
    assert [one.get("rows") for one in seen] == list(ROWS.values()), seen
    for one in seen:
        assert one["geographic"]
        assert {"z_min", "z_max", "center_x", "center_y"} <= set(one["columns"])
        assert one["columns"]["z_max"] == "float64"
    tiles = seen[0]  # of 6 x 3 tiles of 1.5 m, from the map's origin
    expected = [LONGITUDE, LATITUDE, LONGITUDE + 9 / EAST, LATITUDE + 4.5 / NORTH]
    assert tiles["bounds"] == pytest.approx(expected, abs=1e-7)
    assert tiles["z"] == [0, 1]


@needs_tools
@pytest.mark.slow
def test_geopandas_reads_local_metres_where_they_are_asked_for(client: Any, tmp_path: Path) -> None:
    seen = read(*written(client, tmp_path, crs="map"))
    assert [one.get("rows") for one in seen] == list(ROWS.values()), seen
    for one in seen:
        assert "SPICD map" in one["crs"]
        assert not one["geographic"]
    assert seen[0]["bounds"] == [0, 0, 9, 4.5]
    nowhere = read(*written(client, tmp_path))
    assert [(one["rows"], one["bounds"]) for one in nowhere] == [(rows, None) for rows in ROWS.values()]


@needs_tools
@pytest.mark.slow
def test_geopandas_reads_tables_with_their_geometry(anchored: Any, tmp_path: Path) -> None:
    seen = read(*written(anchored, tmp_path, ends="csv", f="csv"))
    assert [one.get("rows") for one in seen] == list(ROWS.values()), seen
    expected = [LONGITUDE, LATITUDE, LONGITUDE + 9 / EAST, LATITUDE + 4.5 / NORTH]
    assert seen[0]["bounds"] == pytest.approx(expected, abs=1e-7)


@needs_tools
@pytest.mark.slow
def test_geopandas_still_cannot_read_prisms_so_that_json_fg_is_not_the_default(
    client: Any, tmp_path: Path
) -> None:
    seen = read(*written(client, tmp_path, profile="jsonfg"))
    assert all("Geometry type is not supported" in one["error"] for one in seen), seen


@pytest.mark.skipif(shutil.which("ogr2ogr") is None, reason="no ogr2ogr on this machine")
@pytest.mark.slow
@pytest.mark.parametrize("crs", ["CRS84", "map"])
def test_ogr2ogr_makes_a_geopackage_of_every_answer(anchored: Any, tmp_path: Path, crs: str) -> None:
    for path, rows in zip(written(anchored, tmp_path, crs=crs), ROWS.values(), strict=True):
        made = path.with_suffix(".gpkg")
        _run(["ogr2ogr", "-f", "GPKG", str(made), str(path)])
        told = _run(["ogrinfo", "-so", "-al", str(made)])
        assert f"Feature Count: {rows}" in told
        assert "z_min: Real" in told
        assert "Extent: (0.000000, 0.000000) - (9.000000, 4.500000)" in told or (
            crs != "map" or path.stem not in ("tiles", "changes")
        )


@pytest.mark.skipif(not _has_qgis(), reason="no QGIS on this machine")
@pytest.mark.slow
@pytest.mark.parametrize("crs", ["CRS84", "map"])
def test_qgis_opens_every_answer_as_a_layer(anchored: Any, tmp_path: Path, crs: str) -> None:
    paths = written(anchored, tmp_path, crs=crs)
    script = [str(TESTS / "read_features_qgis.py"), *map(str, paths)]
    seen = json.loads(_run(["/usr/bin/python3", *script]).splitlines()[-1])
    assert [(one["valid"], one["count"]) for one in seen] == [(True, rows) for rows in ROWS.values()]
    for one in seen:
        assert {"z_min", "z_max", "center_x", "center_y"} <= set(one["fields"])
        assert one["geographic"] == (crs == "CRS84")


def _run(words: list[str]) -> str:
    environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen", "PYTHONPATH": ""}
    ended = subprocess.run(words, capture_output=True, text=True, env=environment, timeout=120, check=False)
    assert ended.returncode == 0, f"{words}: {ended.stdout}\n{ended.stderr}"
    return ended.stdout
