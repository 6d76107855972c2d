"""A real browser for tests: a Chromium of the machine, driven by Playwright, and what a page may not do in it.

On Debian and Ubuntu `docker/browser.sh` installs one. Where none is, tests that need one are skipped with one line.
Playwright's own browsers are not used: their download needs a host of its own.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Error, Page, Request, sync_playwright

#: Programs that will do, the smallest first; SPICD_TEST_BROWSER names another.
PROGRAMS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
MISSING = "no browser on this machine: `sh docker/browser.sh` installs Debian's chromium-headless-shell"

#: WebGL is drawn by the processor (SwiftShader), and nothing is asked of any host but by the page.
ARGUMENTS = (
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
)
NOT_BUILT = "no viewer is built here: `make web` builds it"
WAITS_S = 30.0  #: for what a page shall come to show, on a busy machine

#: Violations of the Content-Security-Policy as errors of the console, with what was refused.
_TELL_VIOLATIONS = """
document.addEventListener("securitypolicyviolation", (event) =>
  console.error(`CSP: ${event.violatedDirective} refused ${event.blockedURI} ${event.sourceFile}:${event.lineNumber}`));
"""


def find_browser() -> str | None:
    """Return the path of a browser, or None."""
    named = os.environ.get("SPICD_TEST_BROWSER")
    found = map(shutil.which, (named,) if named else PROGRAMS)
    return next((path for path in found if path), None)


@contextlib.contextmanager
def started_browser(*, gpu: bool = False) -> Iterator[Browser]:
    """Run a browser until the block ends; `gpu` leaves it the machine's. Skips the test where there is none."""
    program = find_browser()
    if program is None:
        pytest.skip(MISSING)
    arguments = [*ARGUMENTS[1:], "--enable-gpu", "--ignore-gpu-blocklist"] if gpu else [*ARGUMENTS]
    if os.getuid() == 0:
        arguments.append("--no-sandbox")  # Chromium refuses to make one as root
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=arguments)
        try:
            yield browser
        finally:
            browser.close()


@dataclass
class Watch:
    """What a page did that it should not have: errors of scripts and console, and requests to other hosts."""

    origin: str  #: of the service, `http://127.0.0.1:8000`
    complaints: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)  #: URLs, in the order in which they were made
    pending: set[Request] = field(
        default_factory=set
    )  #: that are not answered yet, but for streams of events
    _expected: list[re.Pattern[str]] = field(default_factory=list)

    def expect(self, pattern: str) -> None:
        """Let complaints that a pattern (regular expression) is found in pass."""
        self._expected.append(re.compile(pattern))

    def raise_complaints(self) -> None:
        """Fail the test that the page belongs to."""
        left = [one for one in self.complaints if not any(pattern.search(one) for pattern in self._expected)]
        assert left == [], "the page complains:\n" + "\n".join(left)

    def follow(self, page: Page) -> None:
        """Watch a page from now on."""
        page.on("console", self._console)
        page.on("pageerror", self._error)
        page.on("request", self._request)
        page.on("requestfinished", self._ended)
        page.on("requestfailed", self._ended)

    def _ended(self, request: Request) -> None:
        self.pending.discard(request)

    def _console(self, message: ConsoleMessage) -> None:
        if message.type == "error":
            self.complaints.append(f"console: {message.text} ({message.location.get('url', '')})")

    def _error(self, error: Error) -> None:
        self.complaints.append(f"script: {error.stack or error.message}")

    def _request(self, request: Request) -> None:
        self.requests.append(request.url)
        parts = urlsplit(request.url)
        if not parts.path.endswith("/events"):
            self.pending.add(request)
        if (
            parts.scheme in ("http", "https", "ws", "wss")
            and f"{parts.scheme}://{parts.netloc}" != self.origin
        ):
            self.complaints.append(f"request to another host: {request.url}")


def new_context(browser: Browser, url: str, **options: object) -> BrowserContext:
    """Return a context, a profile of its own, for the service at `url`; options are Playwright's `new_context`."""
    context = browser.new_context(base_url=url, **{"viewport": {"width": 1200, "height": 800}, **options})  # type: ignore[arg-type]
    context.set_default_timeout(WAITS_S * 1000)
    context.add_init_script(_TELL_VIOLATIONS)
    return context


@contextlib.contextmanager
def watched_page(browser: Browser, url: str, **options: object) -> Iterator[tuple[Page, Watch]]:
    """Open a page for the service at `url`; when the block ends, fail where the page did what it should not."""
    context = new_context(browser, url, **options)
    try:
        page, watch = context.new_page(), Watch(origin=url)
        watch.follow(page)
        yield page, watch
    finally:
        context.close()
    watch.raise_complaints()
