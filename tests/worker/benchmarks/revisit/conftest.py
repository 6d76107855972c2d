"""Hand-made visits, whose truth is put in, and one small room that is really walked."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from worker.benchmarks.revisit.plan import RevisitSettings, plan_visits
from worker.benchmarks.revisit.visits import Revisit, ScanErrors, load_visits, make_visits
from worker.cloud.tiling import TileGrid, TilePairs, Tiles

TINY = RevisitSettings(kinds=("room",), stops={"room": 3}, edits={"room": 3}, standing_s=2.0)
SEED = 51  #: of the room


def hand_made(
    name: str = "room-1-changed",
    *,
    cells: list[list[int]],
    in_sight: list[list[int]] | None = None,
    observed: list[bool] | None = None,
    misalignment: list[float] | None = None,
    outside: int = 0,
) -> Revisit:
    """Tiles in a row, all changed cells in sight and all tiles observed unless said otherwise."""
    count = len(cells)
    grid = TileGrid(origin=np.zeros(3), size=np.array([1.5, 1.5, 1.0]), shape=(count, 1, 1))
    indices = np.array([[tile, 0, 0] for tile in range(count)], dtype=np.int32)
    points = tuple(np.array([[1.5 * tile + 0.5, 0.5, 0.5]], np.float32) for tile in range(count))
    nothing = ScanErrors(scans=0, metres=np.empty(0), sigmas=np.empty(0))
    off = np.zeros(count) if misalignment is None else np.array(misalignment)
    return Revisit(
        name=name,
        pairs=TilePairs(
            reference=Tiles(grid=grid, indices=indices, points=points),
            current=points,
            observed=np.ones(count, bool) if observed is None else np.array(observed),
        ),
        cells=np.array(cells, np.int32),
        in_sight=np.array(cells if in_sight is None else in_sight, np.int32),
        outside=outside,
        misalignment=off,
        sigma=off / 2,
        first=nothing,
        second=ScanErrors(scans=2, metres=np.array([0.02]), sigmas=np.array([0.015])),
    )


@pytest.fixture
def made_visit() -> Callable[..., Revisit]:
    """`hand_made`, for tests."""
    return hand_made


@pytest.fixture(scope="session")
def visits_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One room: its map of three stops, and a visit of each case."""
    folder = tmp_path_factory.mktemp("revisit")
    place, made = make_visits(plan_visits(3, TINY, first_seed=SEED), TINY, folder)
    assert made == 3
    assert place.parent == folder
    return folder


@pytest.fixture(scope="session")
def walked(visits_folder: Path) -> dict[str, Revisit]:
    """By case."""
    plans = plan_visits(3, TINY, first_seed=SEED)
    place, _ = make_visits(plans, TINY, visits_folder)
    return dict(zip([plan.case for plan in plans], load_visits(plans, place), strict=True))
