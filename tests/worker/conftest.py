"""The simulated room, made once a session."""

from __future__ import annotations

import pytest

from tests.support.rooms import Room, simulated_room


@pytest.fixture(scope="session")
def room() -> Room:
    return simulated_room()
