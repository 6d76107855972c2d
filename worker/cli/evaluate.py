"""`spicd-worker bench` and `evaluate`: the benchmarks, and a command that puts their figures on a card.

What a command needs of the benchmarks is imported within it: torch, Open3D and Matplotlib take seconds, which `--help`
need not wait for.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import typer

from worker.cli import terminal
from worker.cli.command_line import command_line
from worker.cli.options import DEFAULT_MODEL, PAPER_MODEL, AsJson, Device, Model, ModelStore
from worker.detectors.card import MODEL_STORE


def bench(
    out: Annotated[Path, typer.Option(help="Where the figures are saved.")] = Path("bench/bench.json"),
    scans: Annotated[int, typer.Option(min=2, help="Of the simulated corridor's map.")] = 25,
    repeats: Annotated[int, typer.Option(min=1, help="Of each way of scoring.")] = 3,
    model: Model = DEFAULT_MODEL,
    model_store: ModelStore = MODEL_STORE,
) -> None:
    """Measure seconds in each stage of a map and of a survey on a simulated corridor, and what scoring costs."""
    from worker.benchmarks import speed  # noqa: PLC0415
    from worker.benchmarks.documents import write_json  # noqa: PLC0415

    settings = speed.BenchSettings(scans=scans, repeats=repeats, model=model, model_store=model_store)
    with terminal.progress_bar() as progress:
        figures = speed.bench(settings, progress)
    write_json(out, figures)
    terminal.show(figures, speed.tables, f"saved in {out}")


def registration(
    seeds: Annotated[str, typer.Option(help="Of the simulated buildings and walks, with commas.")] = "1",
    scenarios: Annotated[
        str, typer.Option(help="Of drifted, lost, drifted+foreign, lost+foreign, with commas; or none.")
    ] = "drifted,lost,drifted+foreign,lost+foreign",
    building: Annotated[
        Literal["loop", "room"], typer.Option(help="A corridor with a loop, or one room.")
    ] = "loop",
    scans: Annotated[int, typer.Option(min=2, help="Stops of the walk.")] = 42,
    foreign: Annotated[int, typer.Option(min=1, max=17, help="Out-of-place scans, of another building.")] = 5,
    standing: Annotated[float, typer.Option(min=0.1, help="Seconds at each stop.")] = 5.0,
    baseline: Annotated[
        bool, typer.Option("--plain", help="Also the baseline: all pairs in one process with Open3D's ICP.")
    ] = False,
    baseline_pairs: Annotated[
        int | None,
        typer.Option("--plain-pairs", min=1, help="So many random pairs, the rest of the time extrapolated."),
    ] = None,
    survey: Annotated[bool, typer.Option(help="Also time one scan against the first map.")] = True,
    real: Annotated[Path | None, typer.Option(help="Folder of real scans: see docs/simulator.md.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for registration.json and pictures.")] = None,
    as_json: AsJson = False,
) -> None:
    """Build maps from simulated walks, with and without priors and out-of-place scans, and measure them."""
    from worker.benchmarks.documents import write_json  # noqa: PLC0415
    from worker.benchmarks.registration.benchmark import (  # noqa: PLC0415
        RegistrationBenchmarkSettings,
        evaluate,
    )
    from worker.benchmarks.registration.report import tables  # noqa: PLC0415
    from worker.benchmarks.registration.scenarios import ScenarioSettings, kinds_named  # noqa: PLC0415

    settings = RegistrationBenchmarkSettings(
        walk=ScenarioSettings(building=building, scans=scans, foreign=foreign, duration_s=standing),
        seeds=_numbers(seeds),
        kinds=kinds_named(scenarios),
        baseline=baseline or baseline_pairs is not None,
        baseline_pairs=baseline_pairs,
        survey=survey,
        real=real,
        out=out,
    )
    with terminal.progress_bar() as progress:
        result = evaluate(settings, progress)
    if out is not None:
        write_json(out / "registration.json", result)
    terminal.show(result, tables, as_json=as_json)


def placement(
    context: typer.Context,
    part: Annotated[
        Literal["calibration", "validation", "figures"],
        typer.Option(help="Which places: limits are chosen on the first two, figures taken on the last."),
    ] = "figures",
    trials: Annotated[
        int | None, typer.Option(min=1, help="Of each row of the table at most; left out: all.")
    ] = None,
    only: Annotated[
        str | None, typer.Option(help="Kinds of trials, with commas; left out: all. See docs/placement.md.")
    ] = None,
    sites: Annotated[int, typer.Option(min=1, max=999, help="Places that are mapped.")] = 25,
    processes: Annotated[int, typer.Option(min=1, max=2, help="That register side by side.")] = 2,
    real: Annotated[Path | None, typer.Option(help="Folder of real scans: see docs/test-data.md.")] = None,
    pictures: Annotated[int, typer.Option(min=0, help="Of impostors, with what contradicts them.")] = 0,
    all_impostors: Annotated[
        bool, typer.Option("--all-impostors", help="Leave none of these out, whatever --trials says.")
    ] = False,
    reasons: Annotated[
        bool, typer.Option(help="Look for why refused scans found no place; without, they cost half.")
    ] = True,
    fit: Annotated[
        bool,
        typer.Option("--fit", help="Fit the line of belief on the calibration part instead, and show it."),
    ] = False,
    out: Annotated[
        Path, typer.Option(help="Folder for placement.json, pictures, and maps and answers, which are kept.")
    ] = Path("bench/placement"),
    as_json: AsJson = False,
) -> None:
    """Send surveys of a map's place, of places like it, and spoilt ones; count what is believed at a wrong pose.

    Maps and answers are kept: what was begun goes on where it ended, and is done anew where the pipeline's code is
    another one.
    """
    from worker.benchmarks.documents import write_json  # noqa: PLC0415
    from worker.benchmarks.placement.benchmark import PlacementBenchmarkSettings, evaluate  # noqa: PLC0415
    from worker.benchmarks.placement.fit import fit_line, fit_table  # noqa: PLC0415
    from worker.benchmarks.placement.plan import KINDS, PlacementSettings, kinds_named  # noqa: PLC0415
    from worker.benchmarks.placement.report import tables  # noqa: PLC0415

    made = PlacementSettings(sites=sites)
    if not reasons:
        made = made.without_reasons()
    if fit:
        with terminal.progress_bar() as progress:
            line = fit_line(made, out, processes=processes, most=trials, progress=progress)
        terminal.show(line, fit_table, as_json=as_json)
        return
    settings = PlacementBenchmarkSettings(
        out=out,
        part=part,
        only=KINDS if only is None else kinds_named(only),
        trials=trials,
        all_impostors=all_impostors,
        processes=processes,
        real=real,
        pictures=pictures,
        made=made,
    )
    with terminal.progress_bar() as progress:
        result = {"command": command_line(context), **evaluate(settings, progress)}
    write_json(out / "placement.json", result)
    terminal.show(result, tables, f"saved in {out}", as_json=as_json)


def paper(
    context: typer.Context,
    model: Annotated[
        list[str] | None,
        typer.Option(
            envvar="SPICD_MODEL", help=f"name/version; may be given again. Left out: {PAPER_MODEL}."
        ),
    ] = None,
    model_store: ModelStore = MODEL_STORE,
    weights: Annotated[
        Path | None, typer.Option(help="Checkpoint of training to measure, under the model's card.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the corridor and the walk.")] = 1,
    validation_seed: Annotated[
        int, typer.Option(help="Of the corridor that thresholds are chosen on.")
    ] = 101,
    true_poses: Annotated[
        bool, typer.Option("--true-poses", help="Scans stand where they were taken; no registration.")
    ] = False,
    everywhere: Annotated[
        bool, typer.Option("--everywhere", help="Changes are in all scans of a tile, not in one alone.")
    ] = False,
    robustness: Annotated[
        bool, typer.Option(help="Also disturb one experiment of each kind, level by level.")
    ] = True,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="Three experiments on a short corridor: whether it runs, no figures to cite."
        ),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for report.html, paper.json and pictures; of several models a folder each."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Repeat the fourteen experiments of the paper on a simulated corridor, its figures beside ours."""
    from worker.benchmarks.paper.benchmark import QUICK, PaperSettings, evaluate_each  # noqa: PLC0415
    from worker.benchmarks.paper.report import document, tables, write_report  # noqa: PLC0415
    from worker.benchmarks.paper.site import QUICK_SITE, SiteSettings  # noqa: PLC0415

    settings = PaperSettings(
        site=replace(QUICK_SITE if quick else SiteSettings(), seed=seed, true_poses=true_poses),
        validation_seed=validation_seed,
        model_store=model_store,
        weights=weights,
        everywhere=everywhere,
        robustness=robustness,
        only=QUICK if quick else None,
    )
    models = tuple(model or (PAPER_MODEL,))
    if len(models) > 1 and (weights is not None or as_json):
        raise ValueError("--weights and --json are for one model; leave out the others")
    with terminal.progress_bar() as progress:
        for measured in evaluate_each(settings, models, progress):
            result = {"command": command_line(context), **document(measured)}
            name = measured.settings.model.replace("/", "-")
            folder = out if out is None or len(models) == 1 else out / name
            notes = [] if folder is None else [f"report: {write_report(measured, result, folder)}"]
            terminal.show(result, tables, *notes, as_json=as_json)


def revisit(
    context: typer.Context,
    visits: Annotated[
        int, typer.Option(min=1, help="Second visits; every eight go to a building of their own.")
    ] = 48,
    validation: Annotated[
        int, typer.Option(min=1, help="Visits to other buildings, on which thresholds are chosen.")
    ] = 48,
    hard: Annotated[bool, typer.Option(help="Also the hard part, counted by itself.")] = True,
    model: Model = DEFAULT_MODEL,
    model_store: ModelStore = MODEL_STORE,
    weights: Annotated[
        list[Path] | None,
        typer.Option(help="Checkpoint of `train`, instead of the model's weights; may be given again."),
    ] = None,
    others: Annotated[
        bool, typer.Option(help="Also the other models of the store, and what needs no training.")
    ] = True,
    ablations: Annotated[
        bool, typer.Option("--ablations", help="Also the model without its gate, and without free space.")
    ] = False,
    buildings: Annotated[
        str, typer.Option(help="Of room, office, corridor, loop, with commas; taken in turn.")
    ] = "room,office,corridor,loop",
    only_make: Annotated[
        bool, typer.Option("--only-make", help="Make the visits that are not there yet, and stop.")
    ] = False,
    out: Annotated[
        Path, typer.Option(help="Folder for revisit.json, pictures, and the visits, which are kept.")
    ] = Path("bench/revisit"),
    as_json: AsJson = False,
) -> None:
    """Compare two independent visits, whole objects added, removed, moved between them, by all models and baselines.

    Simulating and registering the visits takes most of the time and is done once; what was begun goes on where it
    ended. All changed tiles count that both visits could decide by the simulator's own hits.
    """
    from worker.benchmarks.documents import write_json  # noqa: PLC0415
    from worker.benchmarks.revisit.benchmark import RevisitBenchmarkSettings, evaluate, visited  # noqa: PLC0415
    from worker.benchmarks.revisit.plan import RevisitSettings, kinds_named  # noqa: PLC0415
    from worker.benchmarks.revisit.report import tables  # noqa: PLC0415

    settings = RevisitBenchmarkSettings(
        out=out,
        visits=visits,
        validation=validation,
        hard=hard,
        model=model,
        model_store=model_store,
        weights=tuple(weights or ()),
        others=others,
        ablations=ablations,
        made=RevisitSettings(kinds=kinds_named(buildings)),
    )
    with terminal.progress_bar() as progress:
        if only_make:
            made = sum(part.made for part in visited(settings, progress).values())
        else:
            result = {"command": command_line(context), **evaluate(settings, progress)}
    if only_make:
        terminal.output().print(f"{made} visits made, kept in {out}", highlight=False)
        return
    write_json(out / "revisit.json", result)
    terminal.show(result, tables, f"saved in {out}", as_json=as_json)


def real(
    context: typer.Context,
    folder: Annotated[Path, typer.Argument(help="Real scans: see docs/test-data.md.")],
    model: Annotated[
        list[str] | None, typer.Option(help="name/version; may be given again. Left out: all that there are.")
    ] = None,
    model_store: ModelStore = MODEL_STORE,
    place: Annotated[
        list[str] | None,
        typer.Option(help="room_scan, corridor_pair, 'ipad 808', 'ipad 560' or kinect; may be given again."),
    ] = None,
    seeds: Annotated[
        int, typer.Option(min=1, help="Draws of things that are put into each visit of each pair.")
    ] = 2,
    registered: Annotated[
        bool, typer.Option(help="Also ask with the poses of the product's own registration.")
    ] = True,
    out: Annotated[Path, typer.Option(help="Folder for real.json, real.md and pictures.")] = Path(
        "bench/real"
    ),
    as_json: AsJson = False,
) -> None:
    """Say what models make of real scans, as they are and with things put into one of two visits.

    Nobody knows all that truly changed in the scans; docs/real-scans.md says what can be seen in them.
    """
    from worker.benchmarks.real.benchmark import RealBenchmarkSettings, evaluate  # noqa: PLC0415
    from worker.benchmarks.real.report import tables, write_report  # noqa: PLC0415
    from worker.benchmarks.real.visits import PLACES  # noqa: PLC0415

    stored = sorted("/".join(card.parts[-3:-1]) for card in model_store.glob("*/*/card.json"))
    settings = RealBenchmarkSettings(
        folder=folder,
        models=tuple(model or stored),
        model_store=model_store,
        out=out,
        places=tuple(place or PLACES),
        seeds=seeds,
        registered=registered,
    )
    with terminal.progress_bar() as progress:
        result = {"command": command_line(context), **evaluate(settings, progress)}
    terminal.show(result, tables, f"saved in {write_report(result, out)}", as_json=as_json)


def precision(
    model: Model = PAPER_MODEL,
    device: Device = "auto",
    way: Annotated[
        Literal["cpu", "cuda"] | None,
        typer.Option(help="Compute as a processor or as a GPU does, whatever the device; else its own way."),
    ] = None,
    offices: Annotated[int, typer.Option(min=1, help="Simulated, each visited twice.")] = 3,
    scans: Annotated[int, typer.Option(min=2, help="Of each visit.")] = 6,
    seed: Annotated[int, typer.Option(help="Of the first office.")] = 1,
    put_on_card: Annotated[
        bool, typer.Option("--record", help="Put the result on the model's card.")
    ] = False,
    model_store: ModelStore = MODEL_STORE,
) -> None:
    """Measure how far the scores of a model move where its network computes in bfloat16."""
    from worker.benchmarks.precision import PrecisionSettings, measure, record, table  # noqa: PLC0415

    settings = PrecisionSettings(
        model=model,
        model_store=model_store,
        device=device,
        way=way,
        offices=offices,
        scans=scans,
        seed=seed,
    )
    with terminal.progress_bar() as progress:
        check = measure(settings, progress)
    terminal.output().print(table(check, model))
    if put_on_card:
        terminal.output().print(f"recorded in {record(settings, check)}", highlight=False)


def bench_network(
    device: Device = "auto",
    precision: Annotated[
        Literal["float32", "bfloat16"], typer.Option(help="Of the large products.")
    ] = "float32",
    compiled: Annotated[bool, typer.Option("--compile", help="By torch.compile.")] = False,
    graphs: Annotated[bool, typer.Option("--graphs", help="As a CUDA graph.")] = False,
    tiles: Annotated[int, typer.Option(min=1, help="Of the map.")] = 172,
    points: Annotated[int, typer.Option(min=1, help="Of each tile, all distinct.")] = 4096,
    batch: Annotated[int, typer.Option(min=1, help="Tiles of one product.")] = 64,
    repeats: Annotated[int, typer.Option(min=1, help="Of each, of which the median counts.")] = 20,
    out: Annotated[Path, typer.Option(help="Where the figures are saved.")] = Path("bench/network.json"),
    model_store: ModelStore = MODEL_STORE,
) -> None:
    """Time SPICD-Net's network on a map's tiles, and say the least time that their products need on this device."""
    from worker.benchmarks.documents import write_json  # noqa: PLC0415
    from worker.benchmarks.network_time import NetworkTimeSettings, measure, table  # noqa: PLC0415

    settings = NetworkTimeSettings(
        device=device,
        precision=precision,
        compiled=compiled,
        graphs=graphs,
        tiles=tiles,
        points=points,
        batch=batch,
        repeats=repeats,
        model_store=model_store,
    )
    with terminal.progress_bar() as progress:
        figures = measure(settings, progress)
    write_json(out, figures)
    terminal.show(figures, table, f"saved in {out}")


def _numbers(words: str) -> tuple[int, ...]:
    """Read whole numbers with commas. Raises ValueError for what is no list of them."""
    try:
        return tuple(int(word) for word in words.split(","))
    except ValueError:
        raise ValueError(f"--seeds {words}: give whole numbers with commas, as in 1,2,3") from None
