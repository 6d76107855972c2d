"""The viewer's page as a test sees it: what is written on it, and what its scene has drawn."""

from __future__ import annotations

import base64
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import Page

from tests.support.browser import WAITS_S, Watch
from worker.pipeline.results.object_marks import color_of_kind
from worker.pipeline.results.objects import ObjectKind

_GREY = 0.45  #: saturation; that of the heights' colours is below it

Pixels = NDArray[np.uint8]  #: (height, width, 3) red, green, blue

#: The scene's pixels as text: an array of numbers takes a second on its way.
_PIXELS = """() => {
  const { width, height, rgba } = window.spicd.scene.pixels();
  let text = "";
  for (let k = 0; k < rgba.length; k += 8192) text += String.fromCharCode(...rgba.subarray(k, k + 8192));
  return { width, height, rgba: btoa(text) };
}"""
_SEEN = "(point) => window.spicd.scene.project(point)"
#: Whether the clouds that shall be shown are: that of the map, and unless it is shown alone one of a survey.
_DRAWN = """() => {
  const shown = document.querySelector(".over-top [aria-pressed=true]")?.textContent;
  const came = performance.getEntriesByType("resource").some(({ name }) => /surveys\\/[^/]+\\/(cloud|tileset)\\./.test(name));
  const loading = document.querySelector(".over-middle");
  return Boolean(window.spicd?.scene.extent) && !loading && shown && (shown === "Reference" || came);
}"""


@dataclass
class ViewerPage:
    """One open page."""

    page: Page
    watch: Watch

    def until(self, expression: str, argument: Any = None) -> Any:
        """Wait for an expression of JavaScript to be true, and return its value.

        Playwright's own `wait_for_function` has the page evaluate a string, which its Content-Security-Policy forbids.
        """
        end = time.monotonic() + WAITS_S
        while not (value := self.page.evaluate(expression, argument)):
            assert time.monotonic() < end, f"waited too long for {expression}"
            self.page.wait_for_timeout(30)
        return value

    def drawn(self) -> ViewerPage:
        """Wait until every cloud that is asked for has come, which the page tells by saying no more that it loads.

        And until its lists have come: of the two either may be first.
        """
        self.until(_DRAWN)
        self.answered()
        return self

    def answered(self) -> None:
        """Wait until no request is under way, and none follows for a while."""
        quiet, end = 0, time.monotonic() + WAITS_S
        while quiet < 5:
            assert time.monotonic() < end, f"no end of requests: {self.watch.pending}"
            self.page.wait_for_timeout(100)
            quiet = 0 if self.watch.pending else quiet + 1

    def rests(self) -> None:
        """Wait until all is answered and two pictures, one after the other, are the same: nothing loads or moves more."""
        before = self.pixels()
        end = time.monotonic() + WAITS_S
        while not np.array_equal(before, after := self.pixels()) or self.watch.pending:
            assert time.monotonic() < end, f"the page does not come to rest: {self.watch.pending}"
            self.page.wait_for_timeout(200)
            before = after

    def pixels(self) -> Pixels:
        """Return what the scene drew."""
        told = self.page.evaluate(_PIXELS)
        values = np.frombuffer(base64.b64decode(told["rgba"]), np.uint8)
        pixels: Pixels = values.reshape(told["height"], told["width"], 4)[..., :3]
        return pixels

    def seen_at(self, point: Sequence[float]) -> tuple[float, float]:
        """Return where a point of the map (metres) is seen in the scene, CSS pixels; it must be."""
        place = self.page.evaluate(_SEEN, list(point))
        assert place is not None, f"{point} is out of sight"
        return float(place[0]), float(place[1])

    def area_of(self, box: Sequence[Sequence[float]]) -> tuple[slice, slice]:
        """Return the rows and columns of the pixels that lie within the outline of a box (2, 3), metres."""
        ratio = self.page.evaluate("devicePixelRatio")
        corners = [[box[bits & 1][0], box[bits >> 1 & 1][1], box[bits >> 2][2]] for bits in range(8)]
        places = np.array([self.seen_at(corner) for corner in corners]) * ratio
        (left, top), (right, bottom) = np.floor(places.min(axis=0)), np.ceil(places.max(axis=0))
        return slice(max(int(top), 0), int(bottom) + 1), slice(max(int(left), 0), int(right) + 1)

    def share(self, kind: ObjectKind, box: Sequence[Sequence[float]], pixels: Pixels | None = None) -> float:
        """Return which share of the pixels within the outline of a box (2, 3) has the colour of a kind.

        The pixels are those of now, where none are given.
        """
        rows, columns = self.area_of(box)
        shown = self.pixels() if pixels is None else pixels
        return float(is_of_kind(shown[rows, columns], kind).mean())


def is_of_kind(pixels: Pixels, kind: ObjectKind) -> NDArray[np.bool_]:
    """Tell of pixels (..., 3) which have the hue of a kind, however light or dark the shading made them."""
    wanted = _hue(np.array([*color_of_kind(kind)], np.float64) * 255)[0]
    hue, saturation = _hue(pixels.astype(np.float64))
    away = np.abs((hue - wanted + 180) % 360 - 180)
    strong: NDArray[np.bool_] = (away < 12) & (saturation > _GREY)
    return strong


def _hue(colours: NDArray[np.float64]) -> tuple[Any, Any]:
    """Return hue, degrees, and saturation, 0..1, of (..., 3) red, green, blue."""
    red, green, blue = np.moveaxis(colours, -1, 0)
    high, low = colours.max(axis=-1), colours.min(axis=-1)
    span = np.maximum(high - low, 1e-9)
    sector = np.where(
        high == red,
        (green - blue) / span,
        np.where(high == green, 2 + (blue - red) / span, 4 + (red - green) / span),
    )
    return sector * 60 % 360, (high - low) / np.maximum(high, 1e-9)


Opener = Callable[..., ViewerPage]  #: opens a page of the viewer: the fixture `opened`
