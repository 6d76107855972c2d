"""All visits of a benchmark, kept on disk: simulating and registering them is what takes the time."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from worker.benchmarks.revisit import record
from worker.benchmarks.revisit.plan import RevisitSettings, SitePlan, VisitPlan
from worker.benchmarks.revisit.record import Revisit
from worker.benchmarks.revisit.second_visit import walk_again
from worker.benchmarks.revisit.site import walk_site
from worker.progress import Progress, no_progress


def make_visits(
    plans: Sequence[VisitPlan], settings: RevisitSettings, folder: Path, progress: Progress = no_progress
) -> tuple[Path, int]:
    """See to it that the folder has every visit; where it lies, and how many had to be made.

    Visits made with other settings lie beside them under another name. A map is built anew where a visit to it is
    missing. Raises MapFailed, and OSError for the folder.
    """
    place = folder / settings.fingerprint
    made = 0
    for site, group in itertools.groupby(plans, key=lambda plan: plan.site):
        missing = [plan for plan in group if not record.kept(plan.name, place)]
        if missing:
            _make(site, missing, settings, place, progress)
            made += len(missing)
    return place, made


def load_visits(plans: Iterable[VisitPlan], place: Path) -> tuple[Revisit, ...]:
    """From where `make_visits` put them."""
    return tuple(record.load(plan.name, place) for plan in plans)


def _make(
    site: SitePlan, plans: Sequence[VisitPlan], settings: RevisitSettings, place: Path, progress: Progress
) -> None:
    with TemporaryDirectory(prefix="spicd-revisit-") as scratch:
        there = walk_site(site, settings, Path(scratch), progress)
        for plan in plans:
            record.save(walk_again(plan, there, settings, Path(scratch), progress), place)
