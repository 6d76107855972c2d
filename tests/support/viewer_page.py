"""The viewer's page as a test sees it: what is written on it, and what its scene has drawn."""

from __future__ import annotations

import base64
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import Page

from tests.support.browser import Watch

#: The scene's pixels as text: an array of numbers takes a second on its way.
_PIXELS = """() => {
  const { width, height, rgba } = window.spicd.scene.pixels();
  let text = "";
  for (let k = 0; k < rgba.length; k += 8192) text += String.fromCharCode(...rgba.subarray(k, k + 8192));
  return { width, height, rgba: btoa(text) };
}"""


@dataclass
class ViewerPage:
    """One open page."""

    page: Page
    watch: Watch

    def pixels(self) -> NDArray[np.uint8]:
        """Return what the scene drew, (height, width, 3) red, green, blue."""
        told = self.page.evaluate(_PIXELS)
        values = np.frombuffer(base64.b64decode(told["rgba"]), np.uint8)
        return values.reshape(told["height"], told["width"], 4)[..., :3]


Opener = Callable[..., ViewerPage]  #: opens a page of the viewer: the fixture `opened`
