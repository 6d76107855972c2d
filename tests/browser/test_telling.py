"""What the page tells: which filters and cuts a picture has, whose score a number is, why something was refused."""

from __future__ import annotations

import re
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.support.viewer_data import MAP, ViewerData
from tests.support.viewer_page import Opener

LEGIBLE = 4.5  #: WCAG 2.2, 1.4.3: contrast of text of this size

#: Contrast of the words of an element with what they stand on (WCAG 2.2, relative luminance).
_CONTRAST = """(element) => {
  const light = (colour) => {
    const [r, g, b] = colour.match(/[\\d.]+/g).slice(0, 3).map((value) => value / 255)
      .map((value) => (value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const ground = light(getComputedStyle(element).backgroundColor);
  return Math.min(...[...element.children].map((words) => {
    const [low, high] = [light(getComputedStyle(words).color), ground].sort((one, other) => one - other);
    return (high + 0.05) / (low + 0.05);
  }));
}"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_chosen_visit_is_legible_under_the_mouse(
    opened: Opener, viewer_data: ViewerData, scheme: str
) -> None:
    survey = viewer_data.surveys["objects"]
    page = opened(f"#map={MAP}&survey={survey}", color_scheme=scheme).drawn().page
    chip = page.locator(f"#visit-{survey}")
    expect(chip).to_have_attribute("aria-pressed", "true")
    assert chip.evaluate(_CONTRAST) >= LEGIBLE
    chip.hover()
    assert chip.evaluate("(one) => one.matches(':hover')")
    assert chip.evaluate(_CONTRAST) >= LEGIBLE


def test_of_a_tile_with_two_scores_each_is_named(opened: Opener) -> None:
    viewer = opened()
    viewer.page.route(
        "**/maps/*/changes?*", lambda route: route.fulfill(json=with_a_higher_score(route.fetch().json()))
    )
    viewer.page.evaluate("(hash) => { location.hash = hash; }", f"#map={MAP}&list=tiles")
    row = viewer.page.locator("#items li", has_text="Tile 001 000 000")
    expect(row).to_contain_text("91 %", timeout=20_000)
    row.click()
    told = facts(viewer.page)
    assert told["Score"] == "78 %"
    assert told["Highest"] == "91 % over all surveys"


def with_a_higher_score(collection: Any) -> Any:
    """Return the changed tiles with a survey before that was surer of one of them."""
    (tile,) = (one for one in collection["features"] if one["properties"]["tile_id"] == "tile_001_000_000")
    tile["properties"]["max_score"] = 0.91
    return collection


def facts(page: Page) -> dict[str, str]:
    """Return what the details tell, by its name."""
    expect(page.locator(".details .facts")).to_be_visible()
    names, values = (page.locator(f".details .facts {tag}") for tag in ("dt", "dd"))
    words = [(one.locator("summary") if one.locator("summary").count() else one) for one in names.all()]
    return dict(zip([one.inner_text() for one in words], values.all_inner_texts(), strict=True))


def test_what_is_cut_and_filtered_stands_over_the_scene_and_goes_by_a_press(opened: Opener) -> None:
    viewer = opened(f"#map={MAP}&section=0,1.03&since=2026-03-03&kind=moved,appeared").drawn()
    page = viewer.page
    chips = page.get_by_role("group", name="What is cut and filtered").get_by_role("button")
    expect(chips).to_have_text(
        [re.compile(one) for one in ("^0 to 1.03 m", "^moved or appeared", "since .*3 Mar")]
    )
    expect(page.locator(".list-count")).to_contain_text("2 of 3 objects")
    page.get_by_role("button", name="Filters").click()
    expect(chips).to_have_count(1)  # the others are in the open panel
    page.get_by_role("button", name="Filters").click()
    chips.nth(1).click()
    viewer.until("() => !location.hash.includes('kind=')")
    expect(page.locator("#items li")).to_have_count(3)
    expect(page.locator(".list-count")).to_contain_text("first seen since")
    chips.first.click()
    viewer.until("() => !location.hash.includes('section=')")
    chips.first.press("Enter")
    expect(chips).to_have_count(0)
    expect(page.locator(".list-count")).to_have_text("3 objects over all surveys")
    assert page.evaluate("document.activeElement !== document.body")


def test_devices_are_named_as_such_and_the_legend_tells_both_outlines_of_what_moved(opened: Opener) -> None:
    page = opened(f"#map={MAP}").drawn().page
    expect(page.locator("#items li").first).to_contain_text("device robot-7")
    page.locator("#items li").first.click()
    expect(page.locator(".history")).to_contain_text("device robot-7")
    expect(page.locator(".legend")).to_contain_text(re.compile("moved *from *to"))


def test_a_refusal_is_plain_and_names_the_file_and_its_figures_are_folded(
    opened: Opener, viewer_data: ViewerData
) -> None:
    viewer = opened(f"#map={MAP}&survey={viewer_data.surveys['failed']}").drawn()
    page = viewer.page
    expect(page.locator(".over-top [aria-pressed=true]")).to_have_text("Reference")
    panel = page.locator("#panel-body")
    expect(panel).to_contain_text("Lies nowhere on the map: march-5-0.ply.")
    figures = panel.get_by_text("inlier ratio")
    expect(figures).to_be_hidden()
    page.get_by_role("button", name="Why, scan by scan").click()
    expect(panel).to_contain_text("march-5-0.ply: lies nowhere on the map")
    expect(figures).to_be_hidden()
    panel.get_by_text("Details", exact=True).click()
    expect(figures).to_be_visible()


def test_a_link_to_a_survey_shows_the_names_of_its_files(opened: Opener, viewer_data: ViewerData) -> None:
    page = opened(f"#map={MAP}&survey={viewer_data.surveys['quiet']}&tab=survey").page
    expect(page.locator(".scans .name")).to_have_text(
        [f"march-2-{number}.ply" for number in range(3)], timeout=20_000
    )
