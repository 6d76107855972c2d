"""Draws the pictures of docs/viewer-pictures.md: the viewer on small real data, and on the demo's.

    python -m tests.browser.screenshots [--to docs/pictures] [--demo demo/demo-data]

Without `--demo` the demo is run first, which takes a minute. Each picture is a WebP of at most 300 kB.
"""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from shutil import copytree
from tempfile import TemporaryDirectory
from typing import Any

from PIL import Image
from playwright.sync_api import Browser
from rich.console import Console

from service.settings import Settings
from tests.support.browser import started_browser, watched_page
from tests.support.live import live
from tests.support.viewer_data import MAP, made
from tests.support.viewer_page import ViewerPage
from worker.detectors.card import MODEL_STORE

LARGEST = 300_000  #: bytes of a picture
DESKTOP = {"viewport": {"width": 1280, "height": 800}}
PHONE = {
    "viewport": {"width": 390, "height": 780},
    "device_scale_factor": 2,
    "has_touch": True,
    "is_mobile": True,
}
DARK = {"color_scheme": "dark"}
DEMO = "office"  #: id of the demo's map


@dataclass(frozen=True)
class Shot:
    """One picture: its name, what is opened, and on what."""

    name: str
    survey: str | None  #: as the data name it; None: no survey is chosen
    words: tuple[str, ...] = ()  #: of the address
    on: dict[str, Any] = field(default_factory=lambda: DESKTOP)
    item: int | None = None  #: the row of the list that is chosen


SHOTS = (
    Shot("viewer-quiet", "quiet", ("tab=survey",)),
    Shot("viewer-objects", "objects", ("show=both",)),
    Shot("viewer-evidence", "objects", item=1),
    Shot("viewer-unobserved", "half", ("show=both", "tiles=changed,unobserved", "tab=survey")),
    Shot("viewer-failed", "failed"),
    Shot("viewer-dark", "objects", ("show=both",), DESKTOP | DARK),
    Shot("viewer-phone", "objects", ("show=both",), PHONE),
)


def main() -> None:
    """Draw all of them."""
    options = _parse()
    options.to.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as name, started_browser() as browser:
        folder = Path(name)
        data = made(folder / "viewer")
        with served(data.data) as url:
            for shot in SHOTS:
                _draw(browser, url, _address(shot, MAP, data.surveys), shot, options.to)
        demo = options.demo or _run_demo(folder / "demo")
        with served(_copied(demo, folder / "shown")) as url:
            shot = Shot("viewer", None, ("show=both", "tiles="))
            _draw(browser, url, _address(shot, DEMO, {}), shot, options.to)


def _address(shot: Shot, map_id: str, surveys: dict[str, str]) -> str:
    words = [f"map={map_id}", *([f"survey={surveys[shot.survey]}"] if shot.survey else []), *shot.words]
    return "#" + "&".join(words)


@contextmanager
def served(data: Path) -> Iterator[str]:
    """Serve a data folder; yields the address."""
    with live(Settings(data_dir=data, model_store=MODEL_STORE, min_free_bytes=0)) as service:
        yield service.url


def _draw(browser: Browser, url: str, address: str, shot: Shot, to: Path) -> None:
    with watched_page(browser, url, **shot.on) as (page, watch):
        viewer = ViewerPage(page, watch)
        page.goto(f"/{address}")
        viewer.drawn()
        if shot.item is not None:
            page.locator("#items li").nth(shot.item).click()
            viewer.until("() => location.hash.includes('view=')")  # the camera is there
            viewer.drawn()
        if "tab=survey" in shot.words:
            viewer.until(
                "() => document.querySelector('.about')?.textContent.includes('.ply')"
            )  # the scans' names
        viewer.rests()
        _save(page.screenshot(), to / f"{shot.name}.webp")


def _save(picture: bytes, path: Path) -> None:
    """Write a picture (PNG) as WebP, the best that is small enough."""
    image = Image.open(io.BytesIO(picture)).convert("RGB")
    for quality in (90, 80, 70, 60, 50):
        image.save(path, "WEBP", quality=quality, method=6)
        if path.stat().st_size <= LARGEST:
            break
    print(f"{path}: {image.width} x {image.height}, {path.stat().st_size / 1000:.0f} kB", flush=True)


def _run_demo(out: Path) -> Path:
    """Run the demo; returns its data folder."""
    from worker.demo.run import run
    from worker.demo.story import DemoSettings

    console = Console(file=sys.stderr)
    run(out, DemoSettings(), out_console=console, err_console=console)
    return out / "demo-data"


def _copied(data: Path, to: Path) -> Path:
    """Return a copy of a data folder, for a service writes into what it serves."""
    return Path(copytree(data, to, ignore=lambda *_: ["redis", "ready.json"]))


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.browser.screenshots", description=__doc__)
    parser.add_argument("--to", type=Path, default=Path("docs/pictures"), help="folder of the pictures")
    parser.add_argument("--demo", type=Path, help="data folder of a demo that was run")
    return parser.parse_args()


if __name__ == "__main__":
    main()
