"""`spicd-worker register`: where one file was taken in another, with the numbers that say how sure that is."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from worker.cli import terminal
from worker.cli.options import AsJson
from worker.cli.scan_results import told_numbers, told_warnings, verdict

if TYPE_CHECKING:
    from worker.pipeline.registration.results import ScanResult


def register(
    reference: Annotated[Path, typer.Argument(help="PLY, PCD, E57, LAS or LAZ that sets the frame.")],
    current: Annotated[Path, typer.Argument(help="File to be placed in it.")],
    start: Annotated[
        Path | None, typer.Option(help="4x4 text file, reference from current: where to begin.")
    ] = None,
    truth: Annotated[
        Path | None, typer.Option(help="4x4 text file of the same kind: the error is given too.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Register CURRENT to REFERENCE as a survey is registered to a map."""
    # Not at the head of the file: Open3D takes a second, which `--help` need not wait for.
    import numpy as np  # noqa: PLC0415

    from worker.cloud.formats.scan import read_scan  # noqa: PLC0415
    from worker.cloud.poses import difference  # noqa: PLC0415
    from worker.errors import RegistrationFailed  # noqa: PLC0415
    from worker.pipeline.mapping.settings import JointRegistrationSettings, MappingSettings  # noqa: PLC0415
    from worker.pipeline.mapping.survey_registration import register_survey_scans  # noqa: PLC0415
    from worker.pipeline.registration.preprocessing import prepare  # noqa: PLC0415
    from worker.pipeline.registration.results import ScanFile  # noqa: PLC0415
    from worker.pipeline.registration.settings import RegistrationSettings  # noqa: PLC0415

    settings = JointRegistrationSettings(
        registration=RegistrationSettings(), mapping=MappingSettings(), max_points=50_000_000
    )
    target = prepare(read_scan(reference), settings.registration, with_sights=True)
    file = ScanFile(name=current.name, path=current, pose=None if start is None else np.loadtxt(start))
    begun = time.perf_counter()
    registered = register_survey_scans([file], target.surface, sights=target.sights, settings=settings)
    (outcome,) = registered.outcomes
    seconds = time.perf_counter() - begun
    result = document(outcome, seconds)
    if outcome.registration is None:
        terminal.show(result, _refusal_table, as_json=as_json)
        raise RegistrationFailed(str(outcome.reason))
    if truth is not None:
        metres, radians = difference(np.loadtxt(truth), outcome.registration.map_from_scan)
        result["error"] = {"metres": metres, "degrees": float(np.degrees(radians))}
    terminal.show(result, _table, as_json=as_json)


def document(outcome: ScanResult, seconds: float) -> dict[str, Any]:
    """Return the registration, or why there is none, JSON-ready; metres and radians."""
    registration = outcome.registration
    if registration is None:
        best = {"fitness": outcome.fitness, "inlier_rmse": outcome.inlier_rmse}
        return {**verdict(outcome), **best, "seconds": seconds}
    sigma = registration.uncertainty
    return {
        **verdict(outcome),
        "reference_from_current": registration.map_from_scan.tolist(),
        "fitness": registration.fitness,
        "inlier_rmse": registration.inlier_rmse,
        "overlap": registration.overlap,
        "agreement": registration.two_way_inlier_ratio,
        "searched": registration.from_global_search,
        "translation_sigma": None if sigma is None else sigma.translation,
        "rotation_sigma": None if sigma is None else sigma.rotation,
        "seconds": seconds,
    }


def _table(result: dict[str, Any]) -> Table:
    table = Table(show_header=False)
    table.add_row("fitness", f"{result['fitness']:.3f}")
    table.add_row("inlier RMSE", f"{result['inlier_rmse'] * 100:.1f} cm")
    table.add_row("inlier ratio", f"{result['agreement']:.2f} over {result['overlap']:.0%} of the scan")
    if result["confidence"] is not None:
        table.add_row("confidence", f"{result['confidence']:.2f}")
    if result["warnings"]:
        table.add_row("warnings", told_warnings(result["warnings"]))
    table.add_row("start", "global search" if result["searched"] else "as given, or identity")
    if "error" in result:
        error = result["error"]
        table.add_row("off the truth", f"{error['metres'] * 100:.2f} cm, {error['degrees']:.3f} degrees")
    table.add_row("seconds", f"{result['seconds']:.2f}")
    return table


def _refusal_table(result: dict[str, Any]) -> Table:
    """Show why CURRENT has no place; the sentence follows as the error."""
    table = Table(show_header=False)
    table.add_row("reason", result["reason"].replace("_", " "))
    if result["numbers"]:
        table.add_row("numbers", told_numbers(result["numbers"]))
    for number, pose in enumerate(result["candidates"] or (), start=1):
        rows = (" ".join(f"{value:9.4f}" for value in row) for row in pose)
        table.add_row(f"candidate {number}", "\n".join(rows))
    table.add_row("seconds", f"{result['seconds']:.2f}")
    return table
