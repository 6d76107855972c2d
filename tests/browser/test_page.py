"""The page itself: it comes, and asks nobody else for anything."""

from __future__ import annotations

from tests.support.viewer_page import Opener


def test_the_page_comes_without_a_complaint(opened: Opener) -> None:
    viewer = opened()
    assert viewer.page.title() == "SPICD"
    assert len(viewer.watch.requests) >= 3  # the page, its script and its style
