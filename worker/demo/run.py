"""The demo from its first scan to its last table."""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.text import Text

from service.client import Client, ClientError, Document
from worker.demo.judgement import (
    Judgement,
    counts_line,
    grid_of,
    judge,
    placement_line,
    show_judgement,
)
from worker.demo.service import DemoFailed, ServiceChild
from worker.demo.story import DemoSettings, Story, tell
from worker.demo.things import ThingsJudgement, judge_things, show_things
from worker.simulation.sensor import SimulatedScan

MAP_ID = "office"
#: What is fetched: its path on the service, and the file that it is written to.
RESULTS = {
    "changes": (f"/maps/{MAP_ID}/changes?limit=10000", "changes.geojson"),
    "tiles": ("/surveys/{survey_id}/tiles", "tiles.geojson"),
    "cloud": ("/surveys/{survey_id}/cloud.ply", "cloud.ply"),
    "picture": ("/surveys/{survey_id}/picture.png", "picture.png"),
}
OBJECTS = ("/surveys/{survey_id}/objects?limit=10000", "objects.geojson")  #: of models that score voxels


@dataclass(frozen=True, kw_only=True, slots=True)
class DemoResult:
    """What the service answered, and how near that is to the truth."""

    map: Document
    survey: Document
    judgement: Judgement
    things: ThingsJudgement | None  #: None where the model tells tiles alone
    files: dict[str, Path] = field(default_factory=dict)


def run(
    out: Path, settings: DemoSettings, *, out_console: Console, err_console: Console, look: bool = False
) -> DemoResult:
    """Run the demo in the folder `out`. Raises DemoFailed where the service does not do its job.

    A change that the detector does not find is a result, not a failure. To `look` is to keep the service with its
    viewer until Ctrl-C; otherwise it says how to start it again on the demo's data, and ends.
    """
    began = time.monotonic()
    # names that nothing else has: what is there is removed, and `out` may be any folder
    fresh = [out / name for name in ("demo-data", "demo-scans")]
    for folder in fresh:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
    try:
        with ServiceChild(fresh[0], out / "service.log", model=settings.model) as child:
            with _progress(err_console) as progress:
                result, story = _through_the_service(child, out, settings, progress)
            _show(result, story, out_console)
            out_console.print(f"all in {time.monotonic() - began:.0f} s", highlight=False)
            view = f"/#map={MAP_ID}&survey={result.survey['survey_id']}"
            if look:
                _say(out_console, "look", f"{child.await_ready()['url']}{view} (Ctrl-C ends it)")
                child.await_end()
    except ClientError as error:
        raise DemoFailed(str(error)) from error
    if not look:
        _say(out_console, "look", f"{_program()} up --data-dir {fresh[0]}, then http://127.0.0.1:8000{view}")
    return result


def _show(result: DemoResult, story: Story, console: Console) -> None:
    """Print what was found beside what is true, how well scans were placed, and the files."""
    if result.things is None:
        show_judgement(console, result.judgement)
    else:
        show_things(console, result.things, moving=result.survey["moving"] or 0)
        console.print(counts_line(result.judgement), highlight=False)
    for visit, outcomes, scans in (
        ("map", result.map["scans"], story.first),
        ("survey", result.survey["scans"], story.second),
    ):
        console.print(placement_line(visit, outcomes, scans), highlight=False)
    for what, path in result.files.items():
        _say(console, what, str(path))


def _program() -> str:
    """Return how `spicd` is called from here: by its path where it lies in an environment of its own."""
    beside = Path(sys.executable).with_name("spicd")
    if sys.prefix == sys.base_prefix or not beside.exists():
        return "spicd"
    return str(beside.relative_to(Path.cwd())) if beside.is_relative_to(Path.cwd()) else str(beside)


def _say(console: Console, what: str, text: str) -> None:
    """Print a line that is headed by a word; a terminal wraps it by itself, so that it is copied whole."""
    console.print(Text.assemble((f"{what:<10}", "bold"), text), soft_wrap=True)


class _Step:
    """One line of the progress display."""

    def __init__(self, progress: Progress, name: str) -> None:
        self._progress, self._task = progress, progress.add_task(name, total=1.0, stage="")

    def show(self, stage: str, share: float) -> None:
        self._progress.update(self._task, stage=stage, completed=share)

    def follow(self, job: Document) -> None:
        """Listen to `Client.wait`."""
        self.show(job["message"], (job["progress"] or 0) / 100)


@contextmanager
def _step(progress: Progress, name: str) -> Iterator[_Step]:
    """Show a line for a step, with its time."""
    step = _Step(progress, name)
    yield step
    step.show("", 1.0)


def _progress(console: Console) -> Progress:
    columns = (
        TextColumn("{task.description:<34}"),
        BarColumn(bar_width=24),
        TimeElapsedColumn(),
        TextColumn("[dim]{task.fields[stage]}"),
    )
    return Progress(*columns, console=console)


def _through_the_service(
    child: ServiceChild, out: Path, settings: DemoSettings, progress: Progress
) -> tuple[DemoResult, Story]:
    with _step(progress, "simulate two visits to an office"):
        story = tell(settings, folder=out / "demo-scans")
    with _step(progress, "start the service"):
        url = child.await_ready()["url"]
    with Client(url, key="") as client:
        with _step(progress, "upload the first visit") as step:
            first = _uploaded(client, story.first, step)
        with _step(progress, "build the map") as step:
            building = client.create_map(first, map_id=MAP_ID, name="The demo's office", model=settings.model)
            client.wait(building["job_id"], step.follow)
        with _step(progress, "upload the second visit") as step:
            second = _uploaded(client, story.second, step)
        with _step(progress, "compare it with the map") as step:
            accepted = client.submit_survey(MAP_ID, second, device_id="demo-robot", model=settings.model)
            client.wait(accepted["job_id"], step.follow)
        survey_id = accepted["survey_id"]
        with _step(progress, "fetch the results"):
            survey, built = client.survey(survey_id), client.map(MAP_ID)
            wanted = RESULTS if survey["objects"] is None else {"objects": OBJECTS, **RESULTS}
            files = {
                what: client.download(path.format(survey_id=survey_id), out / name)
                for what, (path, name) in wanted.items()
            }
            judgement, things = _judged(client, survey_id, story, out, files.get("objects"))
    return DemoResult(map=built, survey=survey, judgement=judgement, things=things, files=files), story


def _uploaded(client: Client, scans: Sequence[SimulatedScan], step: _Step) -> list[str]:
    """Send the scans' files with the poses that the robot believes; return the scans' ids."""
    ids = []
    for number, scan in enumerate(scans):
        if scan.path is None:
            raise ValueError("the visit was simulated without files")
        step.show(scan.path.name, number / len(scans))
        sent = client.upload_scan(scan.path, device_id="demo-robot", pose=scan.prior.tolist())
        ids.append(sent["scan_id"])
    return ids


def _judged(
    client: Client, survey_id: str, story: Story, out: Path, objects: Path | None
) -> tuple[Judgement, ThingsJudgement | None]:
    """Hold tiles and, where the survey tells any, objects against the story."""
    manifest = json.loads(client.download(f"/maps/{MAP_ID}/manifest", out / "manifest.json").read_text())
    grid = grid_of(manifest)
    truths = story.truth_of_each(grid)
    edits = [(edit.sentence, truth) for edit, truth in zip(story.edits, truths, strict=True)]
    judgement = judge(client.tiles(survey_id)["features"], story.truth(grid), edits)
    if objects is None:
        return judgement, None
    done = [
        (edit.sentence, edit.change, int(truth.cells.sum()))
        for edit, truth in zip(story.edits, truths, strict=True)
    ]
    return judgement, judge_things(json.loads(objects.read_text())["features"], done)
