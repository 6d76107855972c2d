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

Pixels = NDArray[np.uint8]  #: (height, width, 3) red, green, blue

#: The scene's pixels as text: an array of numbers takes a second on its way.
_PIXELS = """() => {
  const { width, height, rgba } = window.spicd.scene.pixels();
  let text = "";
  for (let k = 0; k < rgba.length; k += 8192) text += String.fromCharCode(...rgba.subarray(k, k + 8192));
  return { width, height, rgba: btoa(text) };
}"""
_SEEN = "(point) => window.spicd.scene.project(point)"
#: Of each layer whether its cloud has come, as the page says it.
_DRAWN = "() => window.spicd?.scene.extent !== null && window.spicd?.scene.extent !== undefined"


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
        """Wait for the first cloud."""
        self.until(_DRAWN)
        return self

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


Opener = Callable[..., ViewerPage]  #: opens a page of the viewer: the fixture `opened`
