"""Measures how long a map takes to its first picture in a browser, and what it loads: a row for each size of map.

    python -m tests.browser.first_picture [POINTS ...] [--runs 3] [--gpu] [--maps FOLDER] [--stages]

Maps are made, not built: surfaces of a simulated office, sampled. Up to a million points the viewer reads one PLY, above
that a tileset. Making 20 million takes minutes and 2 GB; with `--maps` they stay in a folder for the next time.

The first picture is the first frame with points on the screen; the time begins where the address is opened, with an
empty cache, on the machine that serves as well. Bytes are those that the browser's network stack had received when that
frame was drawn (`Network.dataReceived` of the DevTools protocol, each with its time), packed where they are packed.
All of the view is there when the last answer has ended. A frame is one with all points that the view asks for, read
back; turning, the scene draws as many as the machine lets it. Each is the median of the runs, with the least and the most.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from playwright.sync_api import Browser, CDPSession

from service.catalog.catalog import Catalog
from service.errors import NotFound
from service.settings import Settings
from tests.support.browser import Watch, new_context, started_browser
from tests.support.live import Live, live
from tests.support.made_maps import office_points, put_map
from tests.support.viewer_page import ViewerPage
from worker.detectors.card import MODEL_STORE

SIZES = (10_000, 100_000, 300_000, 1_000_000, 5_000_000, 20_000_000)
WHOLE = 1_000_000  #: points; a larger map is a tileset
FRAMES = 8  #: of a turn of the camera, each read back
TURN_MS = (1500, 3000)  #: of a turn at the machine's own pace: until it has found its pace, and measured

#: Notes when the scene says that it has drawn points; a scene is there a while before its first cloud has come.
_NOTE = """
let known;
performance.setResourceTimingBufferSize(10_000);
setInterval(() => {
  const scene = window.spicd?.scene;
  if (!scene || scene === known) return;
  known = scene;
  window.sceneMade ??= performance.now();
  scene.on("drawn", () => (window.firstPicture ??= performance.now()));
}, 2);
"""
_RENDERER = """() => {
  const context = document.createElement("canvas").getContext("webgl2");
  const told = context?.getExtension("WEBGL_debug_renderer_info");
  return context === null ? "none" : context.getParameter(told ? told.UNMASKED_RENDERER_WEBGL : context.RENDERER);
}"""
#: Milliseconds of each frame: `readPixels` waits until it is drawn.
_FRAMES = """async (frames) => {
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
#: Frames a second while the camera goes around, a degree a frame; a last pixel waits for what is still being drawn.
_TURNING = """([settle, measured]) => new Promise((done) => {
  const { scene } = window.spicd, { position, target } = scene.view, gl = scene.canvas.getContext("webgl2");
  const [x, y] = [position[0] - target[0], position[1] - target[1]];
  const begun = performance.now();
  const drawn = () => gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  let [degrees, frames, since] = [0, 0, 0];
  const step = () => {
    const now = performance.now();
    if (since === 0 && now - begun >= settle) { drawn(); since = performance.now(); }
    else if (since > 0) frames += 1;
    if (since > 0 && now - since >= measured) { drawn(); return done((1000 * frames) / (performance.now() - since)); }
    const turn = (Math.PI * ++degrees) / 180;
    scene.view = { target, position: [
      target[0] + x * Math.cos(turn) - y * Math.sin(turn), target[1] + x * Math.sin(turn) + y * Math.cos(turn), position[2] ] };
    requestAnimationFrame(step);
  };
  requestAnimationFrame(step);
})"""
#: When the parts of the way to the first picture ended, milliseconds after the address was opened.
_STAGES = """() => {
  const ends = performance.getEntriesByType("resource").map(({ name, responseEnd }) => [name, responseEnd]);
  const last = (pattern) => Math.max(0, ...ends.filter(([name]) => pattern.test(name)).map(([, end]) => end));
  const first = (pattern) => Math.min(...ends.filter(([name]) => pattern.test(name)).map(([, end]) => end), Infinity);
  const of = { page: performance.getEntriesByType("navigation")[0].responseEnd, script: last(/main-\\w+\\.js$/),
    "the map's document": first(/maps\\/[^/]+$/), "the scene's script": last(/scene-\\w+\\.js$/), "a scene": window.sceneMade,
    "the tiles' script": last(/tileset-\\w+\\.js$/), "tileset.json": last(/tileset\\.json/), "a cloud, or its first tile": first(/\\.(glb|ply)$/),
    "the first picture": window.firstPicture };
  return Object.entries(of).filter(([, at]) => at > 0 && at < Infinity);
}"""
_ORIGIN = "() => performance.timeOrigin"
_LAST = '() => Math.max(...performance.getEntriesByType("resource").map(({ responseEnd }) => responseEnd))'


@dataclass(frozen=True, kw_only=True)
class Run:
    """One map in the browser, once."""

    first_s: float  #: to the first picture
    first_bytes: int  #: that had come by then, of everything
    whole_s: float  #: until all of the first view had come
    whole_bytes: int
    frame_ms: float  #: median of a turn, all points
    turning: float  #: frames a second while the camera goes around
    stages: list[tuple[str, float]]  #: what had ended when, ms


def main() -> None:
    """Print a Markdown table."""
    options = _parse()
    with _folder(options.maps) as folder, started_browser(gpu=options.gpu) as browser:
        settings = Settings(data_dir=folder / "data", model_store=MODEL_STORE, min_free_bytes=0)
        with live(settings) as service:
            service.http.get("/maps")  # the first request of all has the API describe itself
            name = renderer(browser)
            print(f"drawn by {name}\n")
            if options.gpu and not is_gpu(name):
                raise SystemExit("no GPU that the browser can draw with; without --gpu the processor draws")
            print("| points | as | first picture | loaded by then | all of the view | a frame | turning |")
            print("| ---: | --- | ---: | ---: | ---: | ---: | ---: |", flush=True)
            for points in options.points:
                prepare(service.services.catalog, points)
                runs = [measure(browser, service, points) for _ in range(options.runs)]
                print(_row(points, runs), flush=True)
                if options.stages:
                    print(_stages(runs), flush=True)


def prepare(catalog: Catalog, points: int) -> None:
    """Make the map of so many points, unless it is there."""
    with contextlib.suppress(NotFound):
        catalog.maps.ready(_name(points))
        return
    put_map(catalog, _name(points), office_points(points), tileset=points > WHOLE, ply=points <= WHOLE)


def renderer(browser: Browser) -> str:
    """Return what draws WebGL: a GPU by its name, or the processor (SwiftShader)."""
    page = browser.new_page()
    try:
        return str(page.evaluate(_RENDERER))
    finally:
        page.close()


def is_gpu(name: str) -> bool:
    """Tell whether a renderer of this name is a GPU, and not the processor or nothing."""
    return name != "none" and not any(
        word in name.lower() for word in ("swiftshader", "llvmpipe", "software")
    )


def measure(browser: Browser, service: Live, points: int) -> Run:
    """Open the map of so many points with an empty cache."""
    context = new_context(browser, service.url)
    context.add_init_script(_NOTE)
    page, watch = context.new_page(), Watch(origin=service.url)
    watch.follow(page)
    loaded = _Loaded(context.new_cdp_session(page))
    page.goto(f"/#map={_name(points)}")
    viewer = ViewerPage(page, watch)
    first_ms = float(viewer.until("() => window.firstPicture"))
    viewer.answered()
    run = Run(
        first_s=first_ms / 1000,
        first_bytes=loaded.by(page.evaluate(_ORIGIN) + first_ms),
        whole_s=float(page.evaluate(_LAST)) / 1000,
        whole_bytes=loaded.by(),
        stages=page.evaluate(_STAGES),
        frame_ms=statistics.median(page.evaluate(_FRAMES, FRAMES)),
        turning=page.evaluate(_TURNING, TURN_MS),
    )
    context.close()
    return run


class _Loaded:
    """Keeps when how many bytes came over the wire."""

    def __init__(self, session: CDPSession) -> None:
        self._pieces: list[tuple[str, float, float]] = []  # request, time, bytes
        self._ended: dict[str, tuple[float, float]] = {}  # by request: time, bytes with its headers
        self._wall = 0.0  # seconds from the browser's clock to that of the world
        session.on("Network.requestWillBeSent", self._sent)
        session.on("Network.dataReceived", self._received)
        session.on("Network.loadingFinished", self._finished)
        session.send("Network.enable")

    def by(self, wall_ms: float = float("inf")) -> int:
        """Return the bytes that had come by a time, of requests under way too; left out: those until now."""
        end = wall_ms / 1000 - self._wall
        ended = {request: size for request, (at, size) in self._ended.items() if at <= end}
        under_way = (size for request, at, size in self._pieces if at <= end and request not in ended)
        return int(sum(ended.values()) + sum(under_way))

    def _sent(self, event: dict[str, Any]) -> None:
        self._wall = event["wallTime"] - event["timestamp"]

    def _received(self, event: dict[str, Any]) -> None:
        self._pieces.append((event["requestId"], event["timestamp"], event["encodedDataLength"]))

    def _finished(self, event: dict[str, Any]) -> None:
        self._ended[event["requestId"]] = (event["timestamp"], event["encodedDataLength"])


@contextlib.contextmanager
def _folder(kept: Path | None) -> Iterator[Path]:
    if kept is not None:
        kept.mkdir(parents=True, exist_ok=True)
        yield kept
        return
    with TemporaryDirectory() as name:
        yield Path(name)


def _name(points: int) -> str:
    return f"points-{points}"


def _row(points: int, runs: Sequence[Run]) -> str:
    cells = (
        f"{points:,}",
        "PLY" if points <= WHOLE else "tileset",
        _spread("{:.2f}", [run.first_s for run in runs]) + " s",
        _spread("{:.1f}", [run.first_bytes / 1e6 for run in runs]) + " MB",
        _spread("{:.1f}", [run.whole_s for run in runs])
        + f" s, {statistics.median(run.whole_bytes for run in runs) / 1e6:.1f} MB",
        _spread("{:.0f}", [run.frame_ms for run in runs]) + " ms",
        _spread("{:.0f}", [run.turning for run in runs]) + " a second",
    )
    return f"| {' | '.join(cells)} |"


def _spread(form: str, values: Sequence[float]) -> str:
    """Return the median, and behind it the least and the most where they are others."""
    middle, low, high = map(form.format, (statistics.median(values), min(values), max(values)))
    return middle if low == high else f"{middle} ({low} to {high})"


def _stages(runs: Sequence[Run]) -> str:
    middle = sorted(runs, key=lambda run: run.first_s)[len(runs) // 2]
    return "\n" + "\n".join(f"{at:7.0f} ms  {name}" for name, at in middle.stages) + "\n"


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.browser.first_picture", description=__doc__)
    parser.add_argument("points", nargs="*", type=int, default=SIZES, help="of each map")
    parser.add_argument(
        "--gpu", action="store_true", help="leave the browser the machine's GPU; ends where it has none"
    )
    parser.add_argument("--runs", type=int, default=3, help="of each map; the median counts")
    parser.add_argument("--maps", type=Path, help="a folder that made maps stay in")
    parser.add_argument("--stages", action="store_true", help="say what of the first picture took how long")
    return parser.parse_args()


if __name__ == "__main__":
    main()
