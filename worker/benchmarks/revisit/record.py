"""A second visit as it is measured: tile pairs from the pipeline, and the truth about each of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from worker.cloud import npz
from worker.cloud.tiling import TilePairs
from worker.cloud.types import Bools, Floats
from worker.simulation.truth import MIN_CELLS

NOTHING = -1  #: in place of an index into KINDS


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ScanErrors:
    """The scans of one visit against the truth."""

    scans: int  #: taken
    metres: Floats  #: (A,) of those accepted: how far off the sensor's place is
    sigmas: Floats  #: (A,) metres, as stored with the map or survey; NaN where none is stated

    @property
    def accepted(self) -> int:
        return len(self.metres)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Revisit:
    """One second visit on its map. T tiles, those of the map."""

    name: str
    pairs: TilePairs
    cells: NDArray[
        np.int32
    ]  #: (T, 3) cells of 5 cm whose surface exists in one visit only, by kind as in KINDS
    in_sight: NDArray[
        np.int32
    ]  #: (T, 3) of these, those that a sensor of the visit in which they exist could see
    outside: int  #: changed tiles that the map does not keep: too few points before
    misfit: Floats  #: (T,) metres that the poses put the survey off the map
    sigma: Floats  #: (T,) metres of that which the survey's stored sigmas allow for
    first: ScanErrors
    second: ScanErrors

    @property
    def exists(self) -> Bools:
        """(T,) whether something truly changed in the tile, seen or not."""
        enough: Bools = self.cells.sum(axis=1) >= MIN_CELLS
        return enough

    @property
    def changed(self) -> Bools:
        """(T,) whether something changed that could be seen."""
        enough: Bools = self.in_sight.sum(axis=1) >= MIN_CELLS
        return enough

    @property
    def counted(self) -> Bools:
        """(T,) tiles that a method can be right or wrong about.

        They were observed, and a change in them did not happen out of every sensor's sight.
        """
        return self.pairs.observed & (self.changed | ~self.exists)

    @property
    def kinds(self) -> NDArray[np.int64]:
        """(T,) index into KINDS of what changed most in the tile, or NOTHING."""
        return np.where(self.exists, self.cells.argmax(axis=1), NOTHING)


def save(revisit: Revisit, folder: Path) -> None:
    """Keep the visit in one file of plain arrays. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    npz.save(_path(revisit.name, folder), revisit)


def kept(name: str, folder: Path) -> bool:
    """Return whether there is a visit of this name."""
    return _path(name, folder).exists()


def load(name: str, folder: Path) -> Revisit:
    """Read what `save` kept. Raises OSError, and ValueError for other files."""
    return npz.load(_path(name, folder), Revisit)


def _path(name: str, folder: Path) -> Path:
    return folder / f"{name}.npz"
