"""The real M3C2 (Lague et al. 2013), as py4dgeo computes it; an optional install (docs/decisions, 0014).

`pip install '.[evaluate]'` brings it. Nothing else needs it.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.pipeline.tiling import TilePairs
from worker.pipeline.values import Floats

PACKAGE = "py4dgeo"


def m3c2_is_installed() -> bool:
    """Whether `M3c2` can be used."""
    return find_spec(PACKAGE) is not None


@dataclass(frozen=True, kw_only=True, slots=True)
class M3c2:
    """Signed distances along local normals, each with its level of detection.

    The score of a tile is the share of its core points that changed: those whose distance is significant at
    95%, and those with points of one cloud only in their cylinder, for something is gone. Core points are every `every`th of the reference.
    """

    every: int = 4
    normal_radius: float = 0.30  #: metres; of the neighbourhood that gives the normal
    cylinder_radius: float = 0.10  #: metres; two voxels, some dozen points of a wall
    #: Metres; half the cylinder's length. py4dgeo cuts it into pieces of a radius and drops what lies exactly on a
    #: cut; with an odd number of pieces none goes through the core point, where flat surfaces lie.
    max_distance: float = 0.9
    registration_error: float = 0.01  #: metres; part of the level of detection

    @property
    def name(self) -> str:
        return "M3C2"

    def score(self, pairs: TilePairs) -> Floats:
        """Raises ModuleNotFoundError where py4dgeo is not installed."""
        reference = np.concatenate(pairs.reference.points).astype(np.float64)
        current = np.concatenate(pairs.current).astype(np.float64)
        tile = np.repeat(np.arange(len(pairs.current)), [len(part) for part in pairs.reference.points])
        changed = self._changed(reference, current, reference[:: self.every])
        count = np.bincount(tile[:: self.every], minlength=len(pairs.current))
        sums = np.bincount(tile[:: self.every], weights=changed, minlength=len(pairs.current))
        shares = np.divide(sums, count, out=np.zeros(len(count)), where=count > 0)
        return np.where(pairs.observed, shares, np.nan)

    def _changed(self, reference: Floats, current: Floats, core: Floats) -> NDArray[np.bool_]:
        library = _library()
        method = library.M3C2(
            epochs=(library.Epoch(reference), library.Epoch(current)),
            corepoints=core,
            normal_radii=[self.normal_radius],
            cyl_radius=self.cylinder_radius,
            max_distance=self.max_distance,
            registration_error=self.registration_error,
        )
        distances, uncertainties = method.run()
        one_sided = (uncertainties["num_samples1"] > 0) != (uncertainties["num_samples2"] > 0)
        changed: NDArray[np.bool_] = one_sided | (np.abs(distances) > uncertainties["lodetection"])
        return changed


def _library() -> Any:
    """py4dgeo, kept from writing to stdout and from leaving a log file in the working folder."""
    import py4dgeo  # noqa: PLC0415 (optional, and three seconds to import)

    logger = logging.getLogger(PACKAGE)
    for handler in logger.handlers[:]:
        handler.close()
        logger.removeHandler(handler)
    logger.setLevel(logging.ERROR)
    return py4dgeo
