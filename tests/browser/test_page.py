"""The page itself: it comes, under another path as well, in a frame of who may, and asks nobody else for anything."""

from __future__ import annotations

import functools
import re
import threading
from collections.abc import Callable, Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.support.live import Live
from tests.support.viewer_data import MAP
from tests.support.viewer_page import Opener

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def dashboard() -> Iterator[str]:
    """The address of another site, which has the examples."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, format: str, *_: object) -> None:
            pass

    handler = functools.partial(Quiet, directory=EXAMPLES)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as site:
        threading.Thread(target=site.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{site.server_port}"
        site.shutdown()


def test_the_list_of_maps_comes_without_a_complaint_and_from_here_alone(opened: Opener, served: Live) -> None:
    viewer = opened()
    expect(viewer.page.locator(".map-row")).to_have_count(2)
    assert all(url.startswith((served.url, "data:")) for url in viewer.watch.requests)


def test_an_inline_script_does_not_run(opened: Opener) -> None:
    viewer = opened()
    viewer.watch.expect("CSP: script-src|Executing inline script|Refused to execute inline script")
    viewer.page.evaluate(
        "() => { const s = document.createElement('script'); s.textContent = 'window.harm = 1'; document.body.append(s); }"
    )
    assert viewer.page.evaluate("window.harm") is None
    assert any("CSP: script-src" in one for one in viewer.watch.complaints)


def test_a_request_to_another_host_is_refused_by_the_policy_and_told_by_the_watch(
    opened: Opener, dashboard: str
) -> None:
    viewer = opened()
    answer = viewer.page.evaluate("(url) => fetch(url).then(() => 'came', () => 'refused')", dashboard)
    assert answer == "refused"
    with pytest.raises(AssertionError, match="connect-src"):
        viewer.watch.raise_complaints()
    viewer.watch.expect("connect-src|another host|ERR_BLOCKED_BY_CSP|Fetch API cannot load")


def test_a_map_is_shown_under_the_path_that_a_proxy_gives_the_service(
    opened: Opener, serve: Callable[..., Live]
) -> None:
    service = serve(root_path="/spicd")
    viewer = opened(f"#map={MAP}", url=service.url, path="/spicd/").drawn()
    asked = [url for url in viewer.watch.requests if url.startswith(service.url)]
    assert all(url.startswith(f"{service.url}/spicd/") for url in asked)


def test_a_service_without_a_bundle_says_how_to_make_one(
    opened: Opener, serve: Callable[..., Live], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.web.pages.BUILT", tmp_path / "none")
    page = opened(url=serve().url).page
    expect(page.locator("body")).to_contain_text("make web")
    page.get_by_role("link", name="the maps").click()
    assert MAP in page.content()


def test_the_example_of_a_dashboard_shows_a_map_in_a_frame_where_the_service_allows_its_origin(
    opened: Opener, serve: Callable[..., Live], dashboard: str
) -> None:
    service = serve(allowed_origins=dashboard)
    viewer = opened(url=dashboard, path=f"/embed.html?spicd={service.url}&map={MAP}")
    viewer.watch.expect(f"request to another host: {re.escape(service.url)}/")
    frame = viewer.page.frame_locator("#viewer")
    expect(frame.locator("canvas")).to_be_visible(timeout=20_000)
    expect(frame.locator(".timeline")).to_be_visible()
    expect(frame.locator(".panel")).to_be_hidden()


def test_a_page_of_any_other_origin_may_not_show_it_in_a_frame(
    opened: Opener, served: Live, dashboard: str
) -> None:
    viewer = opened(url=dashboard, path=f"/embed.html?spicd={served.url}&map={MAP}")
    viewer.watch.expect(f"frame-ancestors|request to another host: {re.escape(served.url)}/")
    expect(viewer.page.frame_locator("#viewer").locator("canvas")).to_have_count(0)
    assert any("frame-ancestors" in one for one in viewer.watch.complaints)
