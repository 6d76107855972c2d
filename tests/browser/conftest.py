"""A browser for the tests of a file, a service on the data to look at, and a page that may do nothing wrong."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser

from service.settings import Settings
from service.web.pages import BUILT
from tests.support.browser import NOT_BUILT, started_browser, watched_page
from tests.support.live import Live, live
from tests.support.samples import RememberingQueue
from tests.support.viewer_data import ViewerData, made
from tests.support.viewer_page import Opener, ViewerPage
from worker.detectors.card import MODEL_STORE


@pytest.fixture(scope="session")
def viewer_data(tmp_path_factory: pytest.TempPathFactory) -> ViewerData:
    """Made once in a run of the tests, by whichever of their processes comes first; nobody writes into it.

    SPICD_TEST_VIEWER_DATA names a folder in which they stay for the next run.
    """
    if kept := os.environ.get("SPICD_TEST_VIEWER_DATA"):
        return made(Path(kept))
    own = tmp_path_factory.getbasetemp()
    return made((own.parent if own.name.startswith("popen-") else own) / "viewer")


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if not (BUILT / "index.html").exists():
        pytest.skip(NOT_BUILT)
    with started_browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def served(
    browser: Browser, viewer_data: ViewerData, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Live]:
    """A service on a copy of the data, for the tests of one file; after the browser, without which nothing is made."""
    with serving(viewer_data, tmp_path_factory.mktemp("served")) as service:
        yield service


@contextlib.contextmanager
def serving(
    viewer_data: ViewerData, folder: Path, *, queue: RememberingQueue | None = None, **settings: str
) -> Iterator[Live]:
    """Serve a copy of the data, in `folder`, under further settings."""
    shutil.copytree(viewer_data.data, folder / "data")
    base = Settings(data_dir=folder / "data", model_store=MODEL_STORE, min_free_bytes=0)
    with live(base.model_copy(update=settings), queue) as service:
        yield service


@pytest.fixture
def serve(browser: Browser, viewer_data: ViewerData, tmp_path: Path) -> Iterator[Callable[..., Live]]:
    """What starts a service of the test's own on a copy of the data; it ends after the test's pages."""
    with contextlib.ExitStack() as stack:

        def serve(**settings: Any) -> Live:
            return stack.enter_context(serving(viewer_data, tmp_path, **settings))

        yield serve


@pytest.fixture
def opened(browser: Browser, served: Live, serve: object) -> Iterator[Opener]:
    """What opens pages of the viewer; they are closed at the end of the test, and held to have done nothing wrong."""
    with contextlib.ExitStack() as stack:

        def opened(
            fragment: str = "", *, url: str | None = None, path: str = "/", first: str = "", **options: object
        ) -> ViewerPage:
            page, watch = stack.enter_context(watched_page(browser, url or served.url, **options))
            page.add_init_script(first)  # runs before the page's own
            viewer = ViewerPage(page, watch)
            page.goto(path + fragment)
            return viewer

        yield opened
