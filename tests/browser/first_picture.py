"""Measures how long a map takes to its first picture in a browser, and what it loads: a row for each size of map.

    python -m tests.browser.first_picture [POINTS ...] [--gpu] [--runs 3]

Maps are made, not built: surfaces of a simulated office, sampled. Up to a million points the viewer reads one PLY, above
that a tileset. The first picture is the first frame with points on the screen; the time begins where the address is
opened, with an empty cache, on the machine that serves as well. A frame is the median of a turn of the camera.
"""

from __future__ import annotations

import argparse
import statistics
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from playwright.sync_api import Browser, CDPSession

from service.settings import Settings
from tests.support.browser import Watch, new_context, started_browser
from tests.support.live import Live, live
from tests.support.made_maps import office_points, put_map
from tests.support.viewer_page import ViewerPage
from worker.detectors.card import MODEL_STORE

SIZES = (10_000, 100_000, 300_000, 1_000_000, 5_000_000, 20_000_000)
WHOLE = 1_000_000  #: points; a larger map is a tileset
FRAMES = 12  #: of a turn of the camera

#: Notes when the scene says that it has drawn points; a scene is there a while before its first cloud has come.
_NOTE = """
let known;
setInterval(() => {
  const scene = window.spicd?.scene;
  if (!scene || scene === known) return;
  known = scene;
  scene.on("drawn", () => (window.firstPicture ??= performance.now()));
}, 2);
"""
_RENDERER = """() => {
  const context = document.createElement("canvas").getContext("webgl2");
  const told = context?.getExtension("WEBGL_debug_renderer_info");
  return context === null ? "none" : context.getParameter(told ? told.UNMASKED_RENDERER_WEBGL : context.RENDERER);
}"""
#: Milliseconds of each frame: `readPixels` waits until it is drawn.
_TURN = """async (frames) => {
  const { scene } = window.spicd, taken = [], { position, target } = scene.view;
  const [x, y] = [position[0] - target[0], position[1] - target[1]];
  for (let k = 1; k <= frames; k++) {
    const turn = (2 * Math.PI * k) / frames, begun = performance.now();
    scene.view = { target, position: [
      target[0] + x * Math.cos(turn) - y * Math.sin(turn), target[1] + x * Math.sin(turn) + y * Math.cos(turn), position[2] ] };
    scene.pixels();
    taken.push(performance.now() - begun);
    await new Promise((done) => setTimeout(done));
  }
  return taken;
}"""


@dataclass(frozen=True, kw_only=True)
class Measured:
    """One map in the browser."""

    points: int
    first_picture_s: float  #: median of the runs
    first_bytes: int  #: that had come by then, of everything
    frame_ms: float  #: median of a turn


def main() -> None:
    """Print a Markdown table."""
    options = _parse()
    with TemporaryDirectory() as name, started_browser(gpu=options.gpu) as browser:
        settings = Settings(data_dir=Path(name) / "data", model_store=MODEL_STORE, min_free_bytes=0)
        with live(settings) as service:
            service.http.get("/maps")  # the first request of all has the API describe itself
            print(f"drawn by {renderer(browser)}\n")
            print(
                "| points | as | first picture | loaded by then | a frame |\n| ---: | --- | ---: | ---: | ---: |"
            )
            for points in options.points:
                put_map(
                    service.services.catalog,
                    f"points-{points}",
                    office_points(points),
                    tileset=points > WHOLE,
                    ply=points <= WHOLE,
                )
                print(_row(measure(browser, service, points, runs=options.runs)), flush=True)


def renderer(browser: Browser) -> str:
    """Return what draws WebGL: a GPU by its name, or the processor (SwiftShader)."""
    page = browser.new_page()
    try:
        return str(page.evaluate(_RENDERER))
    finally:
        page.close()


def measure(browser: Browser, service: Live, points: int, *, runs: int) -> Measured:
    """Open the map of so many points `runs` times, each with an empty cache."""
    firsts, frames = [], []
    for run in range(runs):
        context = new_context(browser, service.url)
        context.add_init_script(_NOTE)
        page, watch = context.new_page(), Watch(origin=service.url)
        watch.follow(page)
        loaded = _Loaded(context.new_cdp_session(page))
        page.goto(f"/#map=points-{points}")
        viewer = ViewerPage(page, watch)
        firsts.append((float(viewer.until("() => window.firstPicture")) / 1000, loaded.bytes))
        if run == 0:
            viewer.answered()
            frames = page.evaluate(_TURN, FRAMES)
        context.close()
    middle = sorted(firsts)[len(firsts) // 2]
    return Measured(
        points=points, first_picture_s=middle[0], first_bytes=middle[1], frame_ms=statistics.median(frames)
    )


class _Loaded:
    """Counts the bytes that a page receives, as they come over the wire: packed where they are packed."""

    def __init__(self, session: CDPSession) -> None:
        self._by_request: dict[str, float] = {}
        session.on("Network.dataReceived", self._received)
        session.on("Network.loadingFinished", self._finished)
        session.send("Network.enable")

    @property
    def bytes(self) -> int:
        """Of all requests so far, those that are still under way too."""
        return int(sum(self._by_request.values()))

    def _received(self, event: dict[str, Any]) -> None:
        known = self._by_request.get(event["requestId"], 0)
        self._by_request[event["requestId"]] = known + event["encodedDataLength"]

    def _finished(self, event: dict[str, Any]) -> None:
        self._by_request[event["requestId"]] = event["encodedDataLength"]


def _row(one: Measured) -> str:
    form = "PLY" if one.points <= WHOLE else "tileset"
    cells = (
        f"{one.points:,}",
        form,
        f"{one.first_picture_s:.2f} s",
        f"{one.first_bytes / 1e6:.1f} MB",
        f"{one.frame_ms:.0f} ms ({1000 / one.frame_ms:.0f} a second)",
    )
    return f"| {' | '.join(cells)} |"


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.browser.first_picture", description=__doc__)
    parser.add_argument("points", nargs="*", type=int, default=SIZES, help="of each map")
    parser.add_argument("--gpu", action="store_true", help="leave the browser the machine's GPU")
    parser.add_argument("--runs", type=int, default=3, help="of each map; the median counts")
    return parser.parse_args()


if __name__ == "__main__":
    main()
