"""A map in the browser: what the scene draws of it, read back and held against what was truly done in the room."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.live import Live
from tests.support.made_maps import office_points, put_map
from tests.support.viewer_data import COLOURED, MAP, ViewerData
from tests.support.viewer_page import Opener, ViewerPage, is_of_kind
from worker.pipeline.results.objects import ObjectKind

KINDS: tuple[ObjectKind, ...] = ("appeared", "disappeared", "moved")
ABOVE = "view=3.6,2.6,11,3.6,2.61,0"  #: of the camera: over the middle of the room, looking down
SMALL = {"viewport": {"width": 900, "height": 640}}

#: Notes when the scene says that its first points are on the screen.
_NOTES_DRAWN = """
const waiting = setInterval(() => {
  if (!window.spicd?.scene) return;
  clearInterval(waiting);
  window.spicd.scene.on("drawn", () => (window.firstDrawn ??= performance.now()));
}, 1);
"""
_TILES_ASKED = """() => performance.getEntriesByType("resource")
  .filter(({ name }) => name.endsWith(".glb")).map(({ startTime }) => startTime)"""
_WIDTH = "() => window.spicd.scene.canvas.width"
#: Moves the camera a dozen times on a machine that takes 150 ms for a frame; returns the least width that was drawn.
_MOVED_SLOWLY = """() => new Promise((done) => {
  const { scene } = window.spicd, { position, target } = scene.view;
  let [moves, least] = [0, Infinity];
  const step = () => {
    least = Math.min(least, scene.canvas.width);
    if (++moves > 12) return done(least);
    scene.view = { target, position: [position[0] + 0.05 * moves, position[1], position[2]] };
    const end = performance.now() + 150;
    while (performance.now() < end);
    requestAnimationFrame(step);
  };
  requestAnimationFrame(step);
})"""


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


def test_a_link_to_the_map_alone_shows_what_is_gone_as_it_does_after_the_survey_was_shown(
    opened: Opener, survey: str, viewer_data: ViewerData
) -> None:
    (went,) = viewer_data.changes["disappeared"]
    viewer = from_above(opened, survey, "reference")
    viewer.rests()
    linked = viewer.share("disappeared", went)
    assert linked > 0.15
    viewer.page.keyboard.press("2")
    viewer.drawn().page.keyboard.press("1")
    viewer.drawn().rests()
    assert viewer.share("disappeared", went) == pytest.approx(linked, abs=0.02)


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


def test_a_filter_by_kind_takes_the_boxes_of_the_others_away(
    opened: Opener, survey: str, viewer_data: ViewerData
) -> None:
    (came,) = viewer_data.changes["appeared"]
    viewer = from_above(opened, survey, "reference")
    outlined = viewer.share("appeared", came)
    viewer.page.get_by_role("button", name="Filters").click()
    viewer.page.get_by_label("Disappeared").check()
    viewer.page.locator("#items li").nth(1).wait_for(state="detached")
    assert viewer.page.locator("#items li").count() == 1
    assert viewer.share("appeared", came) < 0.01
    assert outlined > 0.02


def test_a_map_of_more_than_a_million_points_is_read_a_piece_at_a_time(opened: Opener, served: Live) -> None:
    points = office_points(150_000)
    put_map(served.services.catalog, "tower", points, tileset=True, ply=False, counted=1_500_000)
    viewer = opened("#map=tower", **SMALL).drawn()
    viewer.rests()
    drawn = viewer.pixels()
    assert (np.abs(drawn.astype(int) - drawn[2, 2]).sum(axis=-1) > 60).mean() > 0.1
    pieces = [url for url in viewer.watch.requests if ".glb" in url]
    assert len(pieces) >= 1
    assert not any("cloud.ply" in url for url in viewer.watch.requests)


def test_nothing_finer_is_asked_for_before_the_coarsest_points_of_a_large_map_are_on_the_screen(
    opened: Opener, served: Live
) -> None:
    points = office_points(200_000)
    put_map(served.services.catalog, "block", points, tileset=True, ply=False, counted=1_500_000)
    viewer = opened("#map=block", first=_NOTES_DRAWN, **SMALL)
    shown = viewer.until("() => window.firstDrawn")
    viewer.rests()
    asked = viewer.page.evaluate(_TILES_ASKED)
    assert len(asked) > 1  # there are finer ones
    assert [at for at in asked if at < shown] == [min(asked)]


def test_while_the_camera_moves_a_slow_machine_draws_fewer_pixels_and_at_rest_all_again(
    opened: Opener,
) -> None:
    viewer = opened(f"#map={MAP}&show=reference", **SMALL).drawn()
    viewer.rests()
    whole = viewer.page.evaluate(_WIDTH)
    least = viewer.page.evaluate(_MOVED_SLOWLY)
    assert least == pytest.approx(whole / 2, abs=1)
    viewer.until(f"() => ({_WIDTH})() === {whole}")


def test_a_map_with_colours_is_shown_in_them(opened: Opener) -> None:
    """The den's walls bear colours that heights are never painted in."""
    plain, coloured = (opened(f"#map={name}&{ABOVE}", **SMALL).drawn().pixels() for name in (MAP, COLOURED))
    spread = [
        float(np.ptp(image[200:440, 300:600].astype(int), axis=-1).mean()) for image in (plain, coloured)
    ]
    assert spread[1] > 2 * spread[0]
