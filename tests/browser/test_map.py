"""A map in the browser: what the scene draws of it, read back and held against what was truly done in the room."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.viewer_data import MAP, ViewerData
from tests.support.viewer_page import Opener, ViewerPage, is_of_kind

KINDS = ("appeared", "disappeared", "moved")
ABOVE = "view=3.6,2.6,11,3.6,2.61,0"  #: of the camera: over the middle of the room, looking down
SMALL = {"viewport": {"width": 900, "height": 640}}


@pytest.fixture
def survey(viewer_data: ViewerData) -> str:
    """The id of the survey in which things changed."""
    return viewer_data.surveys["objects"]


def from_above(opened: Opener, survey: str, show: str, *more: str) -> ViewerPage:
    """Open a survey as seen from above, without the boxes of tiles."""
    words = [f"map={MAP}", f"survey={survey}", f"show={show}", ABOVE, "tiles=", *more]
    return opened("#" + "&".join(words), **SMALL).drawn()


def test_what_changed_is_seen_where_it_was_done_in_the_colour_of_its_kind_and_nowhere_else(
    opened: Opener, survey: str, viewer_data: ViewerData
) -> None:
    viewer = from_above(opened, survey, "both")
    pixels = viewer.pixels()
    elsewhere = np.ones(pixels.shape[:2], bool)
    for kind in KINDS:
        for low, high in viewer_data.changes[kind]:
            assert viewer.share(kind, (low, high), pixels) > 0.15, kind
            grown = (np.subtract(low, 0.25).tolist(), np.add(high, 0.25).tolist())
            elsewhere[viewer.area_of(grown)] = False
    for kind in KINDS:
        assert is_of_kind(pixels[elsewhere], kind).mean() < 0.002, kind


def test_before_and_after_differ_by_what_came_and_what_went(
    opened: Opener, survey: str, viewer_data: ViewerData
) -> None:
    (came,), (went,) = viewer_data.changes["appeared"], viewer_data.changes["disappeared"]
    viewer = from_above(opened, survey, "survey")
    assert viewer.share("appeared", came) > 0.15
    after = viewer.pixels()
    viewer.page.keyboard.press("1")
    before = viewer.drawn().pixels()
    assert np.abs(after[viewer.area_of(came)].astype(int) - before[viewer.area_of(came)]).mean() > 10
    viewer.page.keyboard.press("3")
    assert viewer.drawn().share("disappeared", went) > 0.15


def test_the_ceiling_is_cut_until_somebody_asks_for_it(
    opened: Opener, survey: str, viewer_data: ViewerData
) -> None:
    (came,) = viewer_data.changes["appeared"]
    viewer = from_above(opened, survey, "survey")
    assert viewer.share("appeared", came) > 0.15
    viewer.page.keyboard.press("c")
    viewer.until("() => location.hash.includes('section=')")
    hidden = viewer.share("appeared", came)
    viewer.page.keyboard.press("c")
    viewer.until("() => !location.hash.includes('section=')")
    assert hidden < 0.05
    assert viewer.share("appeared", came) > 0.15
