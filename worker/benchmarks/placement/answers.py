"""The answers: what the product says of each trial's scans, held against the truth, and kept on disk as JSON."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np

from worker import files
from worker.benchmarks.placement.plan import PlacementSettings, SitePlan, Trial
from worker.benchmarks.placement.sites import PlacementSite, load_site, make_site
from worker.benchmarks.placement.surveys import Survey, simulate
from worker.cloud.poses import difference
from worker.cloud.types import Floats, Matrix4
from worker.errors import ScanError
from worker.pipeline.flow import NoScanAccepted, locate_survey
from worker.pipeline.registration.results import ScanResult
from worker.pipeline.settings import PipelineSettings
from worker.processes import open_processes
from worker.progress import Progress, no_progress

Verdict = Literal["right", "wrong", "in doubt", "ambiguous", "refused"]
ANSWERS = "answers"  #: folder of what was said
PROCESSES = 2  #: at most
#: Metres and degrees up to which an accepted pose is right, and up to which it is as good as the target asks for.
RIGHT, GOOD = (0.10, 1.0), (0.03, 0.5)
_SOURCES = ("cloud", "pipeline")  # rooms of the worker that answers depend on


@dataclass(frozen=True, kw_only=True, slots=True)
class ScanAnswer:
    """What was said of one scan."""

    verdict: Verdict
    here: bool  #: it has a right place on the map
    accepted: bool  #: it was given a pose, believed or not
    metres: float | None = None  #: that pose off the true one; None without either
    degrees: float | None = None
    reason: str | None = None  #: of the diagnosis, where it was left out
    detail: str | None = None  #: likewise, in a sentence
    warnings: tuple[str, ...] = ()  #: reasons of warnings, where it was accepted
    confidence: float | None = None  #: 0..1, as stated with the scan
    fitness: float | None = None
    overlap: float | None = None
    inlier_ratio: float | None = None
    pose: tuple[float, ...] | None = None  #: map_from_scan, 16 numbers row by row

    @property
    def near(self) -> bool:
        """Whether the pose is right, believed or not."""
        return _within(self, RIGHT)

    @property
    def good(self) -> bool:
        """Whether the pose is within 3 cm and 0.5 degrees."""
        return _within(self, GOOD)

    @property
    def named(self) -> tuple[str, ...]:
        """Every reason that was told, of a refusal or in warnings."""
        return self.warnings if self.reason is None else (self.reason,)


@dataclass(frozen=True, kw_only=True, slots=True)
class TrialAnswer:
    """What was said of a survey."""

    name: str
    scans: tuple[ScanAnswer, ...]
    seconds: float  #: of registering and judging the survey
    confidence: float | None = None  #: 0..1, of the survey's placement; None where none was stated
    in_doubt: bool = False

    @classmethod
    def read(cls, path: Path) -> TrialAnswer:
        """Read what was kept. Raises OSError, and ValueError for another file."""
        try:
            kept: dict[str, Any] = json.loads(path.read_text())
            scans = tuple(_scan_answer(row) for row in kept.pop("scans"))
            return cls(scans=scans, **kept)
        except (KeyError, TypeError) as unsound:
            raise ValueError(f"{path} is no answer of this benchmark: {unsound}") from unsound

    def keep(self, path: Path) -> None:
        """Write it as JSON. Raises OSError."""
        path.parent.mkdir(parents=True, exist_ok=True)
        files.write_text(path, json.dumps(asdict(self), allow_nan=False) + "\n")


@dataclass(frozen=True, kw_only=True, slots=True)
class _Task:
    """One trial for a process to answer."""

    trial: Trial
    settings: PlacementSettings
    folder: Path  #: of maps and answers
    kept: Path  #: file of the answer


@dataclass(frozen=True, kw_only=True, slots=True)
class _SiteTask:
    plan: SitePlan
    settings: PlacementSettings
    folder: Path


def answers_of(
    trials: Sequence[Trial],
    settings: PlacementSettings,
    folder: Path,
    *,
    processes: int = PROCESSES,
    progress: Progress = no_progress,
) -> tuple[TrialAnswer, ...]:
    """Return the answer to each trial; those that the folder lacks are asked for, in so many processes.

    An answer is kept for the code that gave it: with other code in the pipeline all are asked for anew. Raises
    MapFailed where a place makes no map, OSError for the folder.
    """
    place = answers_folder(settings, folder)
    tasks = [
        _Task(trial=trial, settings=settings, folder=folder, kept=place / f"{trial.name}.json")
        for trial in trials
    ]
    missing = [task for task in tasks if not task.kept.exists()]
    sites = [
        _SiteTask(plan=plan, settings=settings, folder=folder)
        for plan in dict.fromkeys(task.trial.site for task in missing)
    ]
    with open_processes(min(processes, PROCESSES, len(missing))) as pool:
        for done, _ in enumerate(pool.map_unordered(_make_site, sites)):
            progress("mapping", done / len(sites))
        for done, _ in enumerate(pool.map_unordered(_answer_and_keep, missing)):
            progress("registering", done / len(missing))
    return tuple(TrialAnswer.read(task.kept) for task in tasks)


def answer(name: str, survey: Survey, site: PlacementSite, settings: PipelineSettings) -> TrialAnswer:
    """Register a survey as the product does, and hold what it says against the truth."""
    begun = time.perf_counter()
    placement = None
    try:
        located = locate_survey(survey.files, site.reference, settings=settings, reference_seen=site.seen)
        outcomes, placement = located.outcomes, located.placement
    except NoScanAccepted as nobody:
        outcomes = nobody.outcomes
    except ScanError as unreadable:
        outcomes = tuple(ScanResult.rejected(file.name, unreadable) for file in survey.files)
    seconds = time.perf_counter() - begun
    in_doubt = placement is not None and placement.in_doubt
    middles = survey.middles or (np.zeros(3),) * len(survey.files)
    return TrialAnswer(
        name=name,
        scans=tuple(
            scan_answer(outcome, true, in_doubt=in_doubt, middle=middle)
            for outcome, true, middle in zip(outcomes, survey.true, middles, strict=True)
        ),
        seconds=seconds,
        confidence=None if placement is None else placement.confidence,
        in_doubt=in_doubt,
    )


def scan_answer(
    outcome: ScanResult, true: Matrix4 | None, *, in_doubt: bool = False, middle: Floats | None = None
) -> ScanAnswer:
    """Hold what became of a scan against its true map_from_scan, None where it has none.

    The error is measured at `middle` (3,), metres, scan frame: a frame's origin may lie kilometres away.
    """
    result = outcome.registration
    if result is None:
        reason = None if outcome.diagnosis is None else outcome.diagnosis.reason
        return ScanAnswer(
            verdict="ambiguous" if reason == "ambiguous" else "refused",
            here=true is not None,
            accepted=False,
            reason=reason,
            detail=outcome.reason,
            fitness=outcome.fitness,
        )
    scan_from_middle = np.eye(4)
    scan_from_middle[:3, 3] = 0.0 if middle is None else middle
    map_from_middle = result.map_from_scan @ scan_from_middle
    metres, radians = (None, None) if true is None else difference(true @ scan_from_middle, map_from_middle)
    said = ScanAnswer(
        verdict="wrong",
        here=true is not None,
        accepted=True,
        metres=metres,
        degrees=None if radians is None else float(np.degrees(radians)),
        warnings=tuple(warning.reason for warning in outcome.warnings),
        confidence=outcome.confidence,
        fitness=result.fitness,
        overlap=result.overlap,
        inlier_ratio=result.two_way_inlier_ratio,
        pose=tuple(result.map_from_scan.ravel().tolist()),
    )
    if in_doubt:
        return replace(said, verdict="in doubt")
    return replace(said, verdict="right") if said.near else said


def answers_folder(settings: PlacementSettings, folder: Path) -> Path:
    """Return where the answers of the code as it stands are kept."""
    return folder / settings.fingerprint / ANSWERS / f"{code_fingerprint()}-{settings.survey_fingerprint}"


@cache
def code_fingerprint() -> str:
    """Return what is equal for the same source of everything that registers and judges a survey."""
    root, told = Path(__file__).resolve().parents[2], hashlib.sha256()
    for path in _sources(root):
        told.update(path.relative_to(root).as_posix().encode())
        told.update(path.read_bytes())
    return told.hexdigest()[:12]


def _sources(root: Path) -> Iterator[Path]:
    for room in _SOURCES:
        yield from sorted((root / room).rglob("*.py"))


def _make_site(task: _SiteTask) -> None:
    make_site(task.plan, task.settings, task.folder)


def _answer_and_keep(task: _Task) -> None:
    """Simulate one trial, answer it and keep the answer; the scans themselves are thrown away."""
    site = load_site(task.trial.site, task.settings, task.folder)
    with TemporaryDirectory(prefix="spicd-placement-") as scratch:
        survey = simulate(task.trial, site, task.settings, Path(scratch))
        answer(task.trial.name, survey, site, task.settings.pipeline).keep(task.kept)


def _scan_answer(kept: dict[str, Any]) -> ScanAnswer:
    lists = {name: None if kept[name] is None else tuple(kept[name]) for name in ("warnings", "pose")}
    return ScanAnswer(**(kept | lists))


def _within(said: ScanAnswer, limits: tuple[float, float]) -> bool:
    if said.metres is None or said.degrees is None:
        return False
    return said.metres <= limits[0] and said.degrees <= limits[1]
