"""The simulated room as a place that poses are judged by, and scans of it and of others."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.support.rooms import Room, as_scan
from worker.cloud.sight import Sights
from worker.pipeline.placement.contradictions import Place
from worker.pipeline.registration.preprocessing import PreparedScan, prepare
from worker.pipeline.registration.settings import RegistrationSettings
from worker.simulation.scenes import Scene, random_room, refurnished
from worker.simulation.sensor import SimulatedScan
from worker.simulation.visits import visit

SEED = 3  #: of the simulated room


@pytest.fixture(scope="session")
def place(room: Room) -> Place:
    seen = [(scan.world_points, scan.world_from_sensor[:3, 3]) for scan in room.before]
    return Place(surface=room.target, sights=Sights.of(seen))


def prepared(scan: SimulatedScan, *, name: str = "scan.pcd") -> PreparedScan:
    return prepare(as_scan(scan.points, name=name), RegistrationSettings(), with_sights=True)


@pytest.fixture(scope="session")
def right(room: Room) -> PreparedScan:
    return prepared(room.after[0])


@pytest.fixture(scope="session")
def scanned_once() -> Callable[[Scene], SimulatedScan]:
    return lambda scene: visit(scene, 1, seed=11)[0]


@pytest.fixture(scope="session")
def anew(scanned_once: Callable[[Scene], SimulatedScan]) -> SimulatedScan:
    """A scan of the very same shell with all other furniture."""
    return scanned_once(refurnished(random_room(SEED), seed=5))


@pytest.fixture(scope="session")
def elsewhere(scanned_once: Callable[[Scene], SimulatedScan]) -> SimulatedScan:
    """A scan of another room."""
    return scanned_once(random_room(41))
