"""Refusals: scans that found no place, and the true cause of it where one can be found.

A refusal of the registration says that no pose was good enough. Behind it there may be a mirrored scan, another unit, a
sensor that moved, or a prior that lies kilometres off; each is tried, and told instead where it holds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

from worker.cloud.types import Matrix4
from worker.pipeline.mapping.tasks import ExplainTask, Folder, Workspace, explain_one
from worker.pipeline.placement.contradictions import Place
from worker.pipeline.placement.scan_placement import OUTSIDE, OVERCOMES, outside
from worker.pipeline.registration.diagnosis import Diagnosis, Reason, length
from worker.pipeline.registration.results import ScanFile, ScanRejected

#: Reasons behind which there may be a better one.
EXPLAINED: tuple[Reason, ...] = ("other_place", "no_fit", "wrong_prior", "too_few_points", "degenerate")
_UNPLACED: tuple[Reason, ...] = ("other_place", "no_fit", "wrong_prior", "too_little_overlap")


def may_be_explained(error: Exception) -> bool:
    """Tell whether there may be a better reason; none is looked for where a scan surely lies far from its prior."""
    if not isinstance(error, ScanRejected) or error.diagnosis.reason not in EXPLAINED:
        return False
    numbers = error.diagnosis.numbers
    surely = numbers.get("confidence", 0.0) >= OVERCOMES or numbers.get("outside", 0.0) > OUTSIDE
    return not (error.diagnosis.reason == "wrong_prior" and surely)


def explained(
    errors: Mapping[int, Exception],
    files: Sequence[ScanFile],
    priors: Mapping[int, Matrix4 | None],
    place: Place,
    workspace: Workspace,
    *,
    map_index: int,
    tick: Callable[[], None],
) -> dict[int, ScanRejected]:
    """Return the scans, by index of the file, for whose refusal there is a better reason.

    `priors` are map_from_scan; the map of `place` lies in the folder as `map_index` where there are several processes.
    """
    tasks = [
        ExplainTask(
            folder=workspace.folder,
            map_index=map_index,
            index=index,
            file=files[index],
            hypotheses=getattr(error, "hypotheses", ()),
            settings=workspace.settings,
        )
        for index, error in sorted(errors.items())
        if may_be_explained(error)
    ][: workspace.settings.placement.diagnosed]
    better = {
        index: diagnosis
        for index, diagnosis in _explaining(tasks, place, workspace, tick)
        if diagnosis is not None
    }
    for index, error in errors.items():
        prior = priors.get(index)
        if index not in better and prior is not None and isinstance(error, ScanRejected):
            diagnosis = _outside(error.diagnosis, files[index].name, prior, index, place, workspace.folder)
            better |= {} if diagnosis is None else {index: diagnosis}
    return {index: _because(errors[index], diagnosis) for index, diagnosis in better.items()}


def _explaining(
    tasks: Sequence[ExplainTask], place: Place, workspace: Workspace, tick: Callable[[], None]
) -> Iterator[tuple[int, Diagnosis | None]]:
    if workspace.processes.count > 1:
        yield from workspace.processes.map_unordered(explain_one, tasks)
        return
    for task in tasks:
        yield task.index, task.run(place, tick=tick)


def _because(error: Exception, diagnosis: Diagnosis) -> ScanRejected:
    """Return the refusal for a better reason, with the numbers that were reached."""
    return ScanRejected(
        diagnosis, fitness=getattr(error, "fitness", None), inlier_rmse=getattr(error, "inlier_rmse", None)
    )


def _outside(
    refused: Diagnosis, name: str, prior: Matrix4, index: int, place: Place, folder: Folder
) -> Diagnosis | None:
    """Blame a prior that puts the scan well outside the map; None where it does not."""
    if refused.reason not in _UNPLACED:
        return None
    away = outside(folder.load(index), place, prior)
    if away <= OUTSIDE:
        return None
    found = "" if refused.reason == "wrong_prior" else ", and it was found nowhere else in the map"
    detail = (
        f"scan {name}: its prior puts it {length(away)} outside the map{found}; check frame and units (metres) of the "
        "prior, or leave it out"
    )
    return replace(refused, reason="wrong_prior", detail=detail, numbers={**refused.numbers, "outside": away})
