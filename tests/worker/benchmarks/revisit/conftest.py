"""Hand-made visits, whose truth is put in, and one small room that is really walked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from worker.benchmarks.revisit.plan import CASES, RevisitSettings, plan_visits
from worker.benchmarks.revisit.visits import Revisit, RevisitSite, VisitPoses, load_visits, make_visits
from worker.cloud.seen import Seen
from worker.cloud.tiling import TileGrid
from worker.cloud.voxel_keys import Keys, centers, packed
from worker.pipeline.mapping.fusion import ReferenceMap
from worker.simulation.hits import EditedThing, HitTruth, Visit
from worker.simulation.scenes import ChangeKind
from worker.simulation.truth import KINDS

TINY = RevisitSettings(kinds=("room",), stops={"room": 3}, edits={"room": 3}, standing_s=1.5)
SEED = 51  #: of the room
SIZE = 0.05  #: metres, of a voxel
#: Voxels, the kind of change, the visit that they stand in, and whether they are decidable.
Change = tuple[Keys, ChangeKind, Visit, bool]


def plate(tile: int, count: int) -> Keys:
    """Voxels of an upright plate, ten wide, in the middle of one of the tiles in a row; ascending."""
    number = np.arange(count)
    cells = np.stack([np.full(count, 30 * tile + 15), 10 + number % 10, 2 + number // 10], axis=1)
    return np.sort(packed(cells))


def truth_of(parts: Sequence[Change]) -> HitTruth:
    """Put together what changed; what moved away and what moved in right after it are one thing."""
    ids: list[int] = []
    for number, (_, kind, visit, _) in enumerate(parts):
        moved_in = number > 0 and kind == "move" and visit is Visit.SECOND and parts[number - 1][1] == "move"
        ids.append(ids[-1] if moved_in else 100 + number)
    kinds = {thing: KINDS.index(kind) for thing, (_, kind, _, _) in zip(ids, parts, strict=True)}
    keys = np.concatenate([np.empty(0, np.int64), *(part[0] for part in parts)])
    sizes = [len(part[0]) for part in parts]
    return HitTruth(
        keys=keys,
        visit=np.repeat(np.array([part[2] for part in parts], np.int8), sizes),
        object_ids=np.repeat(np.array(ids, np.int32), sizes),
        decidable=np.repeat(np.array([part[3] for part in parts], bool), sizes),
        surface=np.unique(keys),
        things=tuple(EditedThing(object_id=thing, kind=kind, size=0.5) for thing, kind in kinds.items()),
    )


def no_poses() -> VisitPoses:
    return VisitPoses(
        accepted=np.zeros(0, bool),
        map_from_scan=np.zeros((0, 4, 4)),
        true=np.zeros((0, 4, 4)),
        origins=np.zeros((0, 3)),
        sigmas=np.zeros((0, 2)),
    )


def seen_of(keys: Keys) -> Seen:
    keys = np.unique(keys)
    points = centers(keys, SIZE).astype(np.float32)
    return Seen(voxel_size=SIZE, keys=keys, points=points, hits=np.full(len(keys), 5, np.int32), sights=None)


def hand_made(
    name: str,
    *,
    tiles: int,
    changes: Sequence[Change] = (),
    misalignment: Sequence[float] | None = None,
) -> Revisit:
    """Tiles in a row of 1.5 x 1.5 x 1.0 m; the survey hit a floor, and what has come."""
    floor = np.concatenate([floor_of(tile) for tile in range(tiles)])
    come = [keys for keys, _, visit, _ in changes if visit is Visit.SECOND]
    seen = seen_of(np.concatenate([floor, *come]))
    off = np.zeros(tiles) if misalignment is None else np.array(misalignment)
    return Revisit(
        name=name,
        points=seen.points,
        seen=seen,
        poses=no_poses(),
        truth=truth_of(changes),
        tiles=np.array([[tile, 0, 0] for tile in range(tiles)], np.int32),
        misalignment=off,
        sigma=off / 2,
    )


def floor_of(tile: int) -> Keys:
    """A strip of floor in a tile."""
    return packed(np.stack([np.full(20, 30 * tile + 3), np.arange(20), np.zeros(20)], axis=1).astype(int))


def hand_made_site(name: str, *, tiles: int, gone: Sequence[Keys] = ()) -> RevisitSite:
    """The map of the same row: a floor, and what has gone since."""
    seen = seen_of(np.concatenate([*(floor_of(tile) for tile in range(tiles)), *gone]))
    count = len(seen.points)
    return RevisitSite(
        name=name,
        reference=ReferenceMap(
            points=seen.points,
            normals=np.tile(np.array([0, 0, 1], np.float32), (count, 1)),
            oriented=np.ones(count, bool),
            colors=None,
            voxel_size=SIZE,
            grid=TileGrid(origin=np.zeros(3), size=np.array([1.5, 1.5, 1.0]), shape=(tiles, 1, 1)),
        ),
        seen=seen,
        map_from_world=np.eye(4),
        poses=no_poses(),
    )


@pytest.fixture
def made_visit() -> Callable[..., Revisit]:
    """`hand_made`, for tests."""
    return hand_made


@pytest.fixture
def made_site() -> Callable[..., RevisitSite]:
    """`hand_made_site`, for tests."""
    return hand_made_site


@pytest.fixture
def upright() -> Callable[[int, int], Keys]:
    """`plate`, for tests."""
    return plate


@pytest.fixture(scope="session")
def visits_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One room: its map of three stops, and a visit of each case."""
    folder = tmp_path_factory.mktemp("revisit")
    place, made = make_visits(plan_visits(len(CASES), TINY, first_seed=SEED), TINY, folder)
    assert made == len(CASES)
    assert place.parent == folder
    return folder


@pytest.fixture(scope="session")
def walked(visits_folder: Path) -> dict[str, Revisit]:
    """By case."""
    plans = plan_visits(len(CASES), TINY, first_seed=SEED)
    place, _ = make_visits(plans, TINY, visits_folder)
    return dict(zip([plan.case for plan in plans], load_visits(plans, place), strict=True))
