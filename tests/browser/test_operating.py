"""The page as somebody works with it: with the keyboard alone, on a phone, with a key, with files and with links."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from playwright.sync_api import expect

from service.catalog.records import JobRecord
from service.catalog.steps import STEPS
from service.queue import Claim, QueueState, step_id
from tests.support.house import environment, run
from tests.support.live import Live
from tests.support.samples import RememberingQueue
from tests.support.viewer_data import MAP, ViewerData
from tests.support.viewer_page import Opener, ViewerPage
from worker.detectors.card import MODEL_STORE

PHONE = {
    "viewport": {"width": 390, "height": 780},
    "device_scale_factor": 2,
    "has_touch": True,
    "is_mobile": True,
}
#: The words on buttons that a finger hardly hits.
_SMALL = """() => [...document.querySelectorAll("button:not(.as-link), summary, select")]
  .filter((one) => one.checkVisibility() && one.offsetHeight < 24).map((one) => one.outerHTML)"""
#: Whether the camera looks at a place, to half a metre, from nearby.
_LOOKS_AT = """(place) => {
  const { position, target } = window.spicd.scene.view;
  const away = (from) => Math.hypot(...place.map((value, axis) => value - from[axis]));
  return away(target) < 0.5 && away(position) < 15;
}"""
#: Drops files on the page, as a hand with a mouse does: names, and contents in base64.
_DROP = """(files) => {
  const dataTransfer = new DataTransfer();
  for (const [name, content] of files)
    dataTransfer.items.add(new File([Uint8Array.from(atob(content), (letter) => letter.charCodeAt(0))], name));
  for (const type of ["dragenter", "dragover", "drop"])
    document.body.dispatchEvent(new DragEvent(type, { dataTransfer, bubbles: true, cancelable: true }));
}"""


def tabbed_to(viewer: ViewerPage, selector: str) -> None:
    """Press Tab until the focus is on what a selector names."""
    for _ in range(30):
        viewer.page.keyboard.press("Tab")
        if viewer.page.evaluate("(wanted) => document.activeElement?.matches(wanted)", selector):
            return
    raise AssertionError(f"Tab does not lead to {selector}")


def test_the_keyboard_alone_leads_from_the_maps_to_the_evidence_of_an_object(
    opened: Opener, viewer_data: ViewerData
) -> None:
    viewer = opened()
    page, keys = viewer.page, viewer.page.keyboard
    page.get_by_text("The den", exact=True).wait_for()
    tabbed_to(viewer, f"a[href='#map={MAP}']")
    keys.press("Enter")
    viewer.drawn()
    expect(page.locator("#main")).to_be_focused()
    survey = viewer_data.surveys["objects"]
    for _ in range(6):
        if f"survey={survey}" in page.url:
            break
        keys.press("[")
    assert f"survey={survey}" in page.url
    expect(page.locator("#items li")).to_have_count(3)
    keys.press("j")
    expect(page.locator(".details h2")).to_be_visible()
    keys.press("j")
    expect(page.locator("#items [aria-selected=true]")).to_have_count(1)
    details = page.locator(".details")
    for said in ("Probability", "Judged", "Seen", "Change first seen"):
        expect(details).to_contain_text(said)
    viewer.drawn()
    expect(page.locator(".split-words")).to_be_visible()
    keys.press("Escape")
    expect(details).to_have_count(0)
    keys.press("j")
    page.get_by_label("Close the details").focus()
    keys.press("Escape")
    expect(page.locator("#items")).to_be_focused()


def test_filters_and_section_open_by_a_key_and_give_the_focus_back(opened: Opener) -> None:
    viewer = opened(f"#map={MAP}").drawn()
    page, keys = viewer.page, viewer.page.keyboard
    keys.press("?")
    expect(page.get_by_role("button", name="Close", exact=True)).to_be_focused()
    keys.press("Enter")
    expect(page.locator("#items")).to_be_focused()
    keys.press("/")
    expect(page.locator("#filters input").first).to_be_focused()
    keys.press("Escape")
    expect(page.locator("#filters")).to_have_count(0)
    expect(page.get_by_role("button", name="Filters")).to_be_focused()
    keys.press("x")
    slider = page.get_by_role("slider", name="Up to, metres")
    expect(slider).to_be_focused()
    expect(page.get_by_role("slider", name="From, metres")).to_be_visible()
    keys.press("ArrowLeft")
    viewer.until("() => location.hash.includes('section=')")
    expect(slider).to_be_focused()
    keys.press("x")
    expect(slider).to_have_count(0)
    expect(page.get_by_role("button", name="Section")).to_be_focused()
    keys.press("?")
    for said in ("filters", "section"):
        expect(page.locator("dialog[open] .keys")).to_contain_text(said)
    keys.press("Escape")
    expect(page.get_by_role("button", name="Section")).to_be_focused()


def test_what_has_the_focus_is_seen(opened: Opener) -> None:
    viewer = opened()
    viewer.page.get_by_text("The den", exact=True).wait_for()
    tabbed_to(viewer, f"a[href='#map={MAP}']")
    style = "() => { const s = getComputedStyle(document.activeElement); return [s.outlineStyle, s.outlineWidth, s.boxShadow]; }"
    outline, width, shadow = viewer.page.evaluate(style)
    assert (outline != "none" and width != "0px") or shadow != "none"


def test_a_link_opens_the_same_view_and_another_link_in_the_address_changes_it(
    opened: Opener, viewer_data: ViewerData
) -> None:
    survey, quiet = viewer_data.surveys["objects"], viewer_data.surveys["quiet"]
    viewer = opened(f"#map={MAP}&survey={survey}&view=1,1,9,3,2.5,0&section=0.2,1.8").drawn()
    viewer.page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    viewer.page.locator("#items li").first.click()
    viewer.until("() => location.hash.includes('object=')")
    viewer.until("() => location.hash.includes('view=')")  # the camera has come to rest at the object
    viewer.page.get_by_role("button", name="Share").click()
    link = viewer.until("() => navigator.clipboard.readText()")
    assert link == viewer.page.url
    other = opened(link.partition("/#")[2] and "#" + link.partition("#")[2]).drawn()
    shown = "() => [window.spicd.scene.view, document.querySelector('[aria-selected=true].item')?.id]"
    assert rounded(other.page.evaluate(shown)) == rounded(viewer.page.evaluate(shown))
    other.page.evaluate("(hash) => { location.hash = hash; }", f"#map={MAP}&survey={quiet}")
    expect(other.page.locator(f"#visit-{quiet}")).to_have_attribute("aria-pressed", "true")
    expect(other.page.locator(".details")).to_have_count(0)


def test_of_a_survey_that_failed_nothing_is_counted(opened: Opener, viewer_data: ViewerData) -> None:
    viewer = opened(f"#map={MAP}&survey={viewer_data.surveys['failed']}")
    expect(viewer.page.locator("#tab-changes .number")).to_have_text("–")
    expect(viewer.page.locator(".list-count")).to_contain_text("Nothing was compared")
    expect(viewer.page.locator(".list-count")).not_to_contain_text("0 objects")


def test_the_heights_are_typed_where_they_are_filtered_by(opened: Opener) -> None:
    viewer = opened(f"#map={MAP}").drawn()
    page = viewer.page
    page.get_by_role("button", name="Filters").click()
    page.get_by_text("only at the heights that are shown").click()
    page.get_by_label("Heights from, metres").fill("50")
    page.keyboard.press("Enter")
    viewer.until("() => location.hash.includes('section=50,50.1')")
    expect(page.locator(".list-count")).to_contain_text("0 of")
    expect(page.locator(".list-count")).to_contain_text("at the heights that are shown")


def test_closing_the_details_returns_to_the_clouds_that_were_chosen(
    opened: Opener, viewer_data: ViewerData
) -> None:
    viewer = opened(f"#map={MAP}&survey={viewer_data.surveys['objects']}").drawn()
    page = viewer.page
    pressed = page.locator(".over-top button[aria-pressed=true]")
    expect(page.locator("#items .item").first).to_be_visible()  # the list comes by itself, and may come later
    page.keyboard.press("2")
    expect(pressed).to_have_text("Survey")
    page.keyboard.press("j")
    page.get_by_role("button", name="Before | after").click()
    expect(pressed).to_have_text("Split")
    page.keyboard.press("Escape")
    expect(pressed).to_have_text("Survey")


def test_a_day_is_typed_with_its_zeros_and_the_field_keeps_the_focus(opened: Opener) -> None:
    viewer = opened(f"#map={MAP}&show=both").drawn()
    page, field = viewer.page, viewer.page.get_by_label("Change first seen since")
    page.get_by_role("button", name="Filters").click()
    page.locator("#filters select").first.select_option("day")
    field.focus()
    for digit in "03042026":  # month, day, year: as the browser's own language has it
        page.keyboard.press(digit)
        expect(field).to_be_focused()
    assert "since=2026-03-04" in page.url
    assert "show=both" in page.url  # no digit was taken for a shortcut


def rounded(value: object) -> object:
    """Return what a page told with its numbers to the centimetre, as links have them."""
    return json.loads(json.dumps(value), parse_float=lambda text: round(float(text), 1))


def test_surveys_say_what_they_found_and_what_they_cannot_say(
    opened: Opener, viewer_data: ViewerData
) -> None:
    said = {
        "quiet": "Nothing changed in 74 judged tiles",
        "objects": "3 objects changed: 1 appeared, 1 disappeared, 1 moved",
        "half": "of the map was not seen",
        "failed": "No scan could be placed on the map",
    }
    viewer = opened(f"#map={MAP}&tab=survey")
    for survey, words in said.items():
        viewer.page.locator(f"#visit-{viewer_data.surveys[survey]}").click()
        expect(viewer.page.locator(".about")).to_contain_text(words)
    expect(viewer.page.locator(".about")).to_contain_text("lies nowhere on the map")
    expect(viewer.page.locator(".about")).not_to_contain_text("Nothing changed")


def test_a_tile_that_was_not_seen_says_so_and_the_camera_goes_there(
    opened: Opener, viewer_data: ViewerData
) -> None:
    survey = viewer_data.surveys["half"]
    link = f"#map={MAP}&survey={survey}&tiles=unobserved"
    viewer = opened(link)
    answer = viewer.page.request.get(
        f"{viewer.page.url.partition('#')[0]}surveys/{survey}/tiles?state=unobserved"
    )
    tile = answer.json()["features"][0]["properties"]
    viewer.drawn().page.evaluate("(hash) => { location.hash = hash; }", f"{link}&tile={tile['tile_id']}")
    details = viewer.page.locator(".details")
    expect(details.locator("h2")).to_have_text("Not seen")
    expect(details).to_contain_text("Survey")
    expect(details).not_to_contain_text("Not sure")
    at = "([x, y]) => Math.hypot(window.spicd.scene.view.target[0] - x, window.spicd.scene.view.target[1] - y) < 0.05"
    viewer.until(at, tile["center"][:2])


def test_looking_again_does_not_lead_away_from_what_is_looked_at(opened: Opener) -> None:
    viewer = opened(f"#map={MAP}").drawn()
    viewer.page.locator("#items li").first.click()
    viewer.until("() => location.hash.includes('object=')")
    viewer.until("() => location.hash.includes('view=')")
    expect(viewer.drawn().page.locator(".split-words")).to_be_visible()
    away = """() => { const { position: [a, b, c], target: [x, y, z] } = window.spicd.scene.view;
      return Math.hypot(a - x, b - y, c - z); }"""
    before = viewer.page.evaluate(away)
    viewer.page.get_by_role("button", name="Look", exact=True).click()
    viewer.rests()
    assert viewer.page.evaluate(away) <= 1.02 * before


def test_in_split_look_leads_to_the_object_from_anywhere(opened: Opener, viewer_data: ViewerData) -> None:
    viewer = opened(f"#map={MAP}&survey={viewer_data.surveys['objects']}").drawn()
    viewer.page.locator("#items").get_by_text("Appeared", exact=True).click()
    expect(viewer.page.locator(".split-words")).to_be_visible()
    viewer.rests()
    away = "() => { window.spicd.scene.view = { position: [-20, -30, 25], target: [-5, -8, 0] }; }"
    viewer.page.evaluate(away)
    viewer.page.get_by_role("button", name="Look", exact=True).click()
    (low, high) = viewer_data.changes["appeared"][0]
    middle = [(one + other) / 2 for one, other in zip(low, high, strict=True)]
    viewer.until(_LOOKS_AT, middle)
    viewer.rests()
    x, y = viewer.seen_at(middle)
    canvas = viewer.page.locator(".canvas").bounding_box()
    assert canvas is not None
    assert canvas["width"] / 2 < x < canvas["width"]  # of the right half, after
    assert 0 < y < canvas["height"]


def test_a_phone_shows_list_and_scene_and_nothing_beside_its_screen(
    opened: Opener, viewer_data: ViewerData
) -> None:
    viewer = opened(f"#map={MAP}&survey={viewer_data.surveys['objects']}", **PHONE).drawn()
    page = viewer.page
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    canvas = page.locator(".canvas canvas").bounding_box()
    assert canvas is not None
    assert canvas["width"] > 300 < canvas["height"] + 100
    page.locator("#items li").nth(1).tap()
    expect(page.locator(".details h2")).to_be_in_viewport()
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    small = page.evaluate(_SMALL)
    assert small == []  # WCAG 2.2, 2.5.8: targets of 24 CSS pixels


def test_on_a_phone_nothing_lies_over_what_it_hides_and_words_open_by_a_tap(
    opened: Opener, viewer_data: ViewerData
) -> None:
    viewer = opened(f"#map={MAP}&survey={viewer_data.surveys['objects']}", **PHONE).drawn()
    page = viewer.page
    strip = page.locator(".timeline ol")
    expect(strip).to_have_class(re.compile("more-"))
    page.get_by_role("button", name="Section").tap()
    expect(page.locator(".section")).to_be_visible()
    expect(page.locator(".legend")).to_be_hidden()
    page.get_by_role("button", name="Section").tap()
    expect(page.locator(".legend")).to_be_visible()
    page.get_by_role("button", name="Dark", exact=True).first.tap()
    viewer.until("() => document.documentElement.dataset.theme === 'dark'")
    page.locator("#items li").first.tap()
    page.locator("summary", has_text="Judged").tap()
    expect(page.get_by_text("share of it that both visits could judge", exact=True)).to_be_visible()
    meaning = page.get_by_text("probability that something in the tile changed")
    expect(meaning).to_be_hidden()
    page.locator("summary", has_text="What the columns mean").tap()
    expect(meaning).to_be_visible()


def test_dark_follows_the_system_until_somebody_chooses(opened: Opener) -> None:
    viewer = opened(f"#map={MAP}", color_scheme="dark").drawn()
    assert viewer.pixels()[2, 2].mean() < 60
    viewer.page.keyboard.press("d")
    viewer.until("() => document.documentElement.dataset.theme === 'light'")
    assert viewer.pixels()[2, 2].mean() > 200
    viewer.page.reload()
    viewer.drawn()
    assert viewer.pixels()[2, 2].mean() > 200


def test_a_service_that_wants_a_key_is_asked_with_the_one_that_was_entered_and_no_address_bears_it(
    opened: Opener, serve: Callable[..., Live]
) -> None:
    service = serve(auth="required")
    _, secret = service.services.catalog.keys.add("viewer", scopes=["changes:read"])
    viewer = opened(f"#map={MAP}", url=service.url)
    viewer.watch.expect("401")
    field = viewer.page.get_by_label("Key", exact=True)
    field.fill("spicd_wrong")
    field.press("Enter")
    expect(viewer.page.locator("dialog .warning")).to_be_visible()
    field.fill(secret)
    field.press("Enter")
    viewer.drawn()
    viewer.page.reload()
    viewer.drawn()
    assert not any(secret in url for url in viewer.watch.requests)
    assert secret not in viewer.page.url
    other = opened(f"#map={MAP}", url=service.url)
    other.watch.expect("401")
    expect(other.page.get_by_label("Key", exact=True)).to_be_visible()


def test_dropped_scans_become_a_survey_whose_job_is_followed_until_its_result_is_shown(
    opened: Opener, serve: Callable[..., Live], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    environment(monkeypatch, tmp_path / "data", MODEL_STORE)
    queue = RememberingQueue()
    service = serve(queue=queue)
    catalog = service.services.catalog
    viewer = opened(f"#map={MAP}", url=service.url).drawn()
    viewer.page.evaluate(_DROP, [*scan_and_pose(service, "march-2-0"), *scan_and_pose(service, "march-2-1")])
    expect(viewer.page.locator(".files li")).to_have_count(2)
    viewer.page.get_by_label("Device").last.fill("robot-9")
    viewer.page.get_by_role("button", name="Compare 2 scans").click()
    job_row = viewer.page.locator(".job")
    expect(job_row).to_have_count(1, timeout=20_000)
    survey = next(one for one in catalog.surveys.page(MAP).items if one.device_id == "robot-9")
    job = catalog.jobs.get(survey.job_id)
    queue.state = held_by_a_worker(job)
    begun = catalog.jobs.begin(job.job_id, "register")
    assert begun is not None
    catalog.jobs.report(begun, message="registering", progress=0.42)
    expect(job_row).to_contain_text("42 %", timeout=20_000)
    run(job)
    said = viewer.page.get_by_role("status").filter(has_text="is compared: no object changed")
    expect(said).to_be_visible(timeout=20_000)
    found = viewer.page.locator(f"#visit-{survey.survey_id}")
    expect(found).to_contain_text("nothing changed", timeout=20_000)
    expect(job_row).to_have_count(0)
    expect(found).to_have_attribute("aria-pressed", "false")
    said.get_by_role("link", name="Show it").click()
    expect(found).to_have_attribute("aria-pressed", "true")
    expect(viewer.page.locator(".about")).to_contain_text("Nothing changed in")
    expect(said).to_have_count(0)


def test_a_visit_goes_on_without_a_file_that_was_refused(opened: Opener, serve: Callable[..., Live]) -> None:
    service = serve(queue=RememberingQueue())
    viewer = opened(f"#map={MAP}", url=service.url).drawn()
    viewer.watch.expect("status of 4")
    wrong = ["notes.ply", base64.b64encode(b"these are no points").decode()]
    viewer.page.evaluate(_DROP, [*scan_and_pose(service, "march-2-0"), wrong])
    expect(viewer.page.locator("dialog[open]")).to_contain_text("Empty: now")
    viewer.page.get_by_role("button", name="Compare 2 scans").click()
    viewer.page.get_by_role("button", name="Compare without notes.ply").click(timeout=20_000)
    expect(viewer.page.locator(".job")).to_have_count(1, timeout=20_000)


def test_leaving_the_file_chooser_leaves_the_dialog_as_it_is(opened: Opener) -> None:
    viewer = opened(f"#map={MAP}").drawn()
    viewer.page.get_by_role("button", name="Add survey").click()
    device = viewer.page.get_by_label("Device").last
    device.fill("robot-9")
    chooser = viewer.page.locator("dialog input[type=file]")
    chooser.evaluate("(one) => one.dispatchEvent(new Event('cancel', { bubbles: true }))")
    expect(device).to_have_value("robot-9")
    viewer.page.keyboard.press("Escape")
    expect(device).to_have_count(0)


def held_by_a_worker(job: JobRecord) -> QueueState:
    """Return the state of a queue in which a worker has claimed whatever step of a job is due."""
    claims = [
        Claim(step=step_id(job.job_id, step.name), execution="1", worker="w") for step in STEPS[job.kind]
    ]
    return QueueState(answering=("w",), claims=tuple(claims))


def scan_and_pose(service: Live, name: str) -> list[list[str]]:
    """Return a scan of the data and what tells its pose as two files for `_DROP`."""
    catalog = service.services.catalog
    (scan,) = (one for one in catalog.scans.page().items if one.filename == f"{name}.ply")
    content = catalog.blobs.get_bytes(scan.key)
    files = {f"{name}.ply": content, f"{name}.pose.json": json.dumps({"pose": scan.pose}).encode()}
    return [[name, base64.b64encode(content).decode()] for name, content in files.items()]
