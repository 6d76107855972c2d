"""Results: where each scan of a map or survey stands, how sure that is, or why it was left out.

Points are not kept here: a map of 500 scans is built with one of them in memory at a time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from worker.cloud.carrier import Carrier, CarrierSettings
from worker.cloud.formats.apart import stations_of
from worker.cloud.formats.e57 import looks_like_e57
from worker.cloud.formats.fields import FARTHEST
from worker.cloud.formats.scan import Scan, read_scan
from worker.cloud.poses import inverse, transformed, translation
from worker.cloud.types import Colors, Floats, Matrix4, Points
from worker.cloud.voxels import Voxels
from worker.errors import RegistrationFailed, ScanError, ScanFarAway, ScanUnits
from worker.pipeline.registration.diagnosis import Diagnosis, Reason

#: Why a file that can be decoded is not taken; any other error of reading is `unreadable`.
_UNREAD: dict[type[Exception], Reason] = {ScanUnits: "wrong_units", ScanFarAway: "far_from_origin"}
_SAMPLED = 20  # scans of a visit that its carrier is looked for in


@dataclass(frozen=True, kw_only=True, slots=True)
class ScanFile:
    """A scan, to be read when it is needed."""

    name: str  #: what messages call it
    path: Path
    pose: Matrix4 | None = None  #: (4, 4) map_from_sensor as the client believes it, e.g. by odometry
    station: int | None = None  #: of the scans of an E57, from 0 on; None: the only one
    carrier: Carrier | None = None  #: whose returns are cut; None: nobody looked for one
    refused: str | None = None  #: why it is not read; None: it is

    def read_whole(self, *, max_points: int) -> Scan:
        """Read the file with the carrier's returns; raises ScanError, whose message names it."""
        if self.refused is not None:
            raise ScanError(self.refused)
        return read_scan(self.path, name=self.name, max_points=max_points, station=self.station)

    def read(self, *, max_points: int) -> Scan:
        """Read the file, less the carrier's returns; raises ScanError, whose message names it."""
        scan = self.read_whole(max_points=max_points)
        if self.carrier is None:
            return scan
        cut = self.carrier.hits(transformed(scan.points, inverse(scan.sensor_pose)))
        return replace(
            scan,
            points=scan.points[~cut],
            colors=None if scan.colors is None else scan.colors[~cut],
        )

    def prior(
        self, sensor_pose: Matrix4, *, own: Matrix4 | None = None, offset: Floats | None = None
    ) -> Matrix4 | None:
        """Return map_from_scan by the client's pose, which is the sensor's; the file may know where that stood.

        Where the client gave none it is `own`, the file's own pose of the sensor, as an E57 has one; that says nothing
        where it is the identity, as of a station that nobody registered, or puts the points kilometres away, as in a
        country's grid. `offset` (3,) metres was taken off the points.
        """
        map_from_sensor = self.pose if self.pose is not None else own
        if map_from_sensor is None:
            return None
        shift = translation(np.zeros(3) if offset is None else offset)
        map_from_scan: Matrix4 = map_from_sensor @ inverse(sensor_pose) @ shift
        far = float(np.linalg.norm(map_from_scan[:3, 3])) > FARTHEST
        if self.pose is None and (far or np.allclose(map_from_sensor, np.eye(4))):
            return None
        return map_from_scan


def files_of(path: Path) -> list[ScanFile]:
    """Return the scans of a file: one, or for an E57 one for each station that holds points. Raises OSError."""
    with path.open("rb") as file:
        is_e57 = looks_like_e57(file.read(8))
    count = 1
    if is_e57:
        with suppress(ScanError):  # told when it is read
            count = len(stations_of(path))
    if count == 1:
        return [ScanFile(name=str(path), path=path)]
    return [ScanFile(name=f"{path}#{n + 1}", path=path, station=n) for n in range(count)]


def with_carrier(
    files: Sequence[ScanFile], settings: CarrierSettings, *, max_points: int
) -> tuple[ScanFile, ...]:
    """Look for the carrier in the scans of one visit, in at most 20 of them, so that it is cut where they are read.

    Files that have one are left as they are; what cannot be read is passed over here.
    """
    if all(file.carrier is not None for file in files):
        return tuple(files)

    def returns() -> Iterator[Floats]:
        for index in np.unique(np.linspace(0, len(files) - 1, min(len(files), _SAMPLED)).astype(int)):
            with suppress(ScanError):
                yield _returns(files[index], max_points=max_points)

    carrier = Carrier.of(returns(), settings)
    return tuple(replace(file, carrier=file.carrier or carrier) for file in files)


def _returns(file: ScanFile, *, max_points: int) -> Floats:
    """Return the points (N, 3) of a file, metres, sensor frame; nothing else of it is held. Raises ScanError."""
    scan = file.read_whole(max_points=max_points)
    return transformed(scan.points, inverse(scan.sensor_pose))


@dataclass(frozen=True, kw_only=True, slots=True)
class Uncertainty:
    """One sigma of a pose in its worst direction."""

    translation: float  #: metres, of the sensor's place
    rotation: float  #: radians


@dataclass(frozen=True, kw_only=True, slots=True)
class RegistrationResult:
    """A scan that was accepted."""

    map_from_scan: Matrix4  #: (4, 4) rigid
    sensor_origin: Floats | None  #: (3,) metres, map frame; None where the points contradict the file's
    fitness: float | None  #: mean over its registrations, 0..1; None where there was nothing to fit to
    inlier_rmse: float | None  #: metres, likewise
    overlap: float  #: share of the scan that what it was registered to covers, 0..1
    two_way_inlier_ratio: float  #: share of the overlap on a common surface, worse direction, 0..1
    from_global_search: bool  #: the given prior did not do; the pose comes from a search without one
    uncertainty: Uncertainty | None  #: None where there was nothing to fit to
    path: tuple[int, ...] = ()  #: indices of the files from the map's reference scan to this one


class ScanRejected(RegistrationFailed):
    """One scan found no place; the best numbers that were reached stand beside the diagnosis, None before ICP."""

    def __init__(
        self, diagnosis: Diagnosis, *, fitness: float | None = None, inlier_rmse: float | None = None
    ) -> None:
        super().__init__(diagnosis)  # its only argument, so that it travels between processes
        self.diagnosis = diagnosis
        self.fitness = fitness  #: 0..1
        self.inlier_rmse = inlier_rmse  #: metres

    def __str__(self) -> str:
        return self.diagnosis.detail

    @classmethod
    def because(cls, reason: Reason, detail: str, **numbers: float) -> Self:
        """Reject before anything was fitted."""
        return cls(Diagnosis(reason=reason, detail=detail, numbers=numbers))


@dataclass(frozen=True, kw_only=True, slots=True)
class ScanResult:
    """What became of one scan: registered, or left out with a reason."""

    name: str
    registration: RegistrationResult | None
    diagnosis: Diagnosis | None = None  #: why it was left out
    warnings: tuple[Diagnosis, ...] = ()  #: what is odd about it beside, also where it was left out
    confidence: float | None = None  #: 0..1, that its pose is right; None where that was not asked
    fitness: float | None = None  #: 0..1, the best reached; None where there was nothing to fit to
    inlier_rmse: float | None = None  #: metres

    @property
    def reason(self) -> str | None:
        """Why it was left out, in a sentence."""
        return None if self.diagnosis is None else self.diagnosis.detail

    @classmethod
    def accepted(
        cls,
        name: str,
        registration: RegistrationResult,
        *,
        warnings: tuple[Diagnosis, ...] = (),
        confidence: float | None = None,
    ) -> Self:
        """Return the result of a scan that was registered."""
        return cls(
            name=name,
            registration=registration,
            warnings=warnings,
            confidence=confidence,
            fitness=registration.fitness,
            inlier_rmse=registration.inlier_rmse,
        )

    @classmethod
    def rejected(cls, name: str, error: Exception, *, warnings: tuple[Diagnosis, ...] = ()) -> Self:
        """Return the result of a scan that was left out, with the numbers where the error has them."""
        unread = Diagnosis(reason=_UNREAD.get(type(error), "unreadable"), detail=str(error))
        return cls(
            name=name,
            registration=None,
            diagnosis=getattr(error, "diagnosis", None) or unread,
            warnings=warnings,
            fitness=getattr(error, "fitness", None),
            inlier_rmse=getattr(error, "inlier_rmse", None),
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class SurveyPlacement:
    """How sure it is that the accepted scans of a survey stand where they were taken."""

    confidence: float | None  #: 0..1, calibrated on the placement benchmark; None where no rays are known
    in_doubt: bool  #: too little to believe it: no tile of the survey is `unchanged` then


@dataclass(frozen=True, kw_only=True, slots=True)
class RegisteredScan:
    """The points of a scan that was accepted, with the place they were seen from."""

    name: str
    points: Points  #: (N, 3) float32, metres, map frame
    colors: Colors | None  #: (N, 3) uint8
    map_from_scan: Matrix4  #: (4, 4) rigid
    sensor_origin: Floats | None  #: (3,) metres, map frame; None where the points contradict the file's

    def voxels(self, size: float) -> Voxels:
        """Sort its points into cells of `size` metres of the map frame."""
        return Voxels.of(self.points, size=size, origin=self.sensor_origin, colors=self.colors)


def read_registered(file: ScanFile, registration: RegistrationResult, *, max_points: int) -> RegisteredScan:
    """Read the file again and put its points where they belong; raises ScanError."""
    scan = file.read(max_points=max_points)
    return RegisteredScan(
        name=file.name,
        points=transformed(scan.points, registration.map_from_scan).astype(np.float32),
        colors=scan.colors,
        map_from_scan=registration.map_from_scan,
        sensor_origin=registration.sensor_origin,
    )
