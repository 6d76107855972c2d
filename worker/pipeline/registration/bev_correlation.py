"""Bird's-eye-view (BEV) correlation: where an upright scan is, by its walls drawn from above, without any start.

Robots know where down is, so four numbers are missing: x, y, yaw, z. The first three are searched exhaustively: both
clouds become images of their walls whose pixels are complex numbers, the direction that a wall faces; turning a cloud
turns the image and its phases, and one inverse FFT then scores every shift at once. Images are whitened, so that what
is singular (a corner, a niche, a cabinet) counts for more than a corridor's endless sides. z comes from floors and
ceilings in the same way.

Ideas: correlative scan matching (Olson, ICRA 2009), phase-only correlation (Kuglin and Hines, 1975), correlation of
oriented elements instead of occupancy. Measured against FPFH + RANSAC in docs/decisions/0013.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from worker.cloud.poses import exponential
from worker.cloud.types import Bools, Floats, Matrix4
from worker.pipeline.registration.surface import Surface

CELL = 0.3  #: metres, a pixel
PAIR_SIZE = 80  #: pixels, 24 m: two scans of a sensor that sees 10 m
YAWS = 90  #: turns tried, 4 degrees apart
_SPLIT = 0.8  #: metres above the cloud's own zero: what is below and above has an image each
_SATURATED = 4  #: points, from which a pixel is full
_WHITENING = 0.8  #: 0 correlates plainly, 1 takes the phases alone
_STEEP, _FLAT = 0.4, 0.8  # |z| of the normals of walls, of floors and ceilings
_HEIGHT_STEP, _HEIGHT_RANGE = 0.05, 6.0  #: metres
_APART = 2  #: pixels and turns between two candidates

Complexes = NDArray[np.complex64]


@dataclass(frozen=True, kw_only=True, slots=True)
class BevImage:
    """A cloud's walls as places (N, 2) and directions (N,), in two bands of height, and its floors by height."""

    places: Floats  #: (N, 2) metres, from `center`
    facing: Floats  #: (N,) radians
    upper: Bools  #: (N,) above the split
    heights: Floats  #: (H,) floors less ceilings, by height
    center: Floats  #: (2,) metres, the frame of the cloud

    @classmethod
    def of(cls, surface: Surface) -> BevImage:
        """Draw a cloud that is upright and knows which side of its walls was seen."""
        points, normals = surface.points, surface.normals
        wall = surface.oriented & (np.abs(normals[:, 2]) < _STEEP)
        flat = surface.oriented & (np.abs(normals[:, 2]) > _FLAT)
        places = points[wall, :2]
        center = places.mean(axis=0) if len(places) else np.zeros(2)
        edges = np.arange(-_HEIGHT_RANGE, _HEIGHT_RANGE + _HEIGHT_STEP / 2, _HEIGHT_STEP)
        heights, _ = np.histogram(points[flat, 2], edges, weights=np.sign(normals[flat, 2]))
        return cls(
            places=places - center,
            facing=np.arctan2(normals[wall, 1], normals[wall, 0]),
            upper=points[wall, 2] >= _SPLIT,
            heights=heights.astype(np.float64),
            center=center,
        )

    @property
    def reach(self) -> float:
        """Metres from the centre to the farthest wall."""
        return float(np.abs(self.places).max()) if len(self.places) else 0.0


def image_size(*images: BevImage) -> int:
    """Return the pixels a side that hold the largest of these images; what is shifted over its edge wraps around."""
    reach = max((image.reach for image in images), default=0.0)
    return int(scipy.fft.next_fast_len(max(int(2 * reach / CELL) + 8, 32)))


def spectrum(image: BevImage, size: int) -> Complexes:
    """Return (2, size, size) the whitened Fourier transforms of both bands."""
    return _whitened(_pixels(image.places, image.facing, image.upper, size))


def rotated_spectra(image: BevImage, size: int) -> Complexes:
    """Return (2, YAWS, size, size) the same of the image turned about its centre; 2 YAWS size^2 8 bytes."""
    rotated = np.empty((2, YAWS, size, size), np.complex64)
    for turn in range(YAWS):
        yaw = 2 * np.pi * turn / YAWS
        cos, sin = np.cos(yaw), np.sin(yaw)
        places = image.places @ np.array([[cos, sin], [-sin, cos]])
        rotated[:, turn] = _pixels(places, image.facing + yaw, image.upper, size)
    return _whitened(rotated)


@dataclass(frozen=True, kw_only=True, slots=True)
class BevMatch:
    """A candidate: exact to half a pixel and half a turn step."""

    target_from_source: Matrix4  #: (4, 4) rigid, upright
    score: float  #: of the correlation, without unit; comparable between images of one size


def correlate(
    source: BevImage, rotated: Complexes, target: BevImage, spectra: Complexes, *, count: int
) -> list[BevMatch]:
    """Return the `count` best shifts and turns, best first; `rotated` is the source's and `spectra` the target's."""
    product = np.einsum("btij,bij->tij", np.conj(rotated), spectra)
    scores = scipy.fft.ifft2(product, axes=(1, 2), overwrite_x=True).real
    lift = _height_offset(source.heights, target.heights)
    matches = []
    for _ in range(count):
        turn, row, column = (int(index) for index in np.unravel_index(scores.argmax(), scores.shape))
        score = float(scores[turn, row, column])
        if score <= 0:
            break
        pose = _pose(source, target, turn, (row, column), lift, scores.shape[1])
        matches.append(BevMatch(target_from_source=pose, score=score))
        _suppress_around(scores, turn, row, column)
    return matches


def bev_candidates(source: Surface, target: Surface, *, count: int) -> list[Matrix4]:
    """Return target_from_source, best first; none where a cloud shows no walls whose seen side is known."""
    image, other = BevImage.of(source), BevImage.of(target)
    if not len(image.places) or not len(other.places):
        return []
    size = image_size(image, other)
    matches = correlate(image, rotated_spectra(image, size), other, spectrum(other, size), count=count)
    return [match.target_from_source for match in matches]


def _pixels(places: Floats, facing: Floats, upper: Bools, size: int) -> Complexes:
    """Draw (2, size, size): in each pixel the mean direction of its walls, by how many points saw it."""
    pixel = np.floor(places / CELL).astype(np.int64) + size // 2
    inside = ((pixel >= 0) & (pixel < size)).all(axis=1)
    flat = (upper[inside] * size + pixel[inside, 0]) * size + pixel[inside, 1]
    length = 2 * size * size
    east = np.bincount(flat, np.cos(facing[inside]), length)
    north = np.bincount(flat, np.sin(facing[inside]), length)
    summed = east + 1j * north
    strength = np.abs(summed)
    full = np.minimum(strength, _SATURATED) / _SATURATED
    mean: Complexes = (summed / np.maximum(strength, 1e-9) * full).reshape(2, size, size).astype(np.complex64)
    return mean


def _whitened(images: Complexes) -> Complexes:
    spectra: Complexes = scipy.fft.fft2(images, axes=(-2, -1), overwrite_x=True)
    strength = np.abs(spectra)
    spectra /= (strength + 1e-3 * np.maximum(strength.max(), 1e-9)) ** _WHITENING
    return spectra


def _pose(
    source: BevImage, target: BevImage, turn: int, pixel: tuple[int, int], lift: float, size: int
) -> Matrix4:
    shift = (np.array(pixel) + size // 2) % size - size // 2
    pose: Matrix4 = exponential(np.array([0.0, 0.0, 2 * np.pi * turn / YAWS, 0.0, 0.0, 0.0]))
    pose[:2, 3] = target.center + shift * CELL - pose[:2, :2] @ source.center
    pose[2, 3] = lift
    return pose


def _suppress_around(scores: NDArray[Any], turn: int, row: int, column: int) -> None:
    near = np.arange(-_APART, _APART + 1)
    turns, size = scores.shape[0], scores.shape[1]
    scores[np.ix_((turn + near) % turns, (row + near) % size, (column + near) % size)] = 0


def _height_offset(source: Floats, target: Floats) -> float:
    """Return the metres by which the source is to be lifted so that floors lie on floors and ceilings on ceilings."""
    return float((np.correlate(target, source, mode="full").argmax() - (len(source) - 1)) * _HEIGHT_STEP)
