"""The report: one JSON document, the paper's figures beside ours, its tables, and one HTML file with every picture."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from rich.console import Group
from rich.table import Table

from worker.benchmarks.card_figures import COUNTS, RATIOS
from worker.benchmarks.documents import Document, shown, titled_table, write_bytes, write_json
from worker.benchmarks.paper.benchmark import MethodResult, PaperResult
from worker.benchmarks.paper.experiments import published
from worker.benchmarks.paper.figures import pictures
from worker.benchmarks.paper.robustness import chosen_trials
from worker.benchmarks.paper.site import Site
from worker.benchmarks.plots import png
from worker.metrics import Confusion, pooled, precision_recall, roc
from worker.simulation.scenes import ChangeKind
from worker.simulation.truth import KINDS

#: The name in the paper's Table 6 of each of ours that it has.
IN_TABLE_6 = {"C2C (mean)": "C2C", "M3C2-approx": "M3C2-approx"}
STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:62rem;margin:2rem auto;padding:0 1rem;color:#1a1a1a}
table{border-collapse:collapse;font-size:13px;display:block;overflow-x:auto}
th,td{padding:.2rem .6rem;text-align:right;border-bottom:1px solid #ddd}
th:first-child,td:first-child{text-align:left}tr:last-child td{font-weight:600}img{max-width:100%;height:auto}
figure{margin:2rem 0}figcaption,.quiet{color:#666;font-size:13px}"""


def document(result: PaperResult) -> Document:
    """Return the result as JSON; None where a ratio has no meaning."""
    tables = published()
    settings = result.settings
    return {
        "benchmark": "paper",
        "source": tables["source"],
        "model": settings.measured,
        "sha256": result.card.sha256,
        "fingerprint": result.card.fingerprint,
        "settings": {
            **asdict(settings.site),
            "validation_seed": settings.validation_seed,
            "everywhere": settings.everywhere,
        },
        "map": {**_map(result.site), "points": len(result.site.points)},
        "validation_map": _map(result.validation),
        "thresholds": {
            "validation": result.detector.threshold,
            "test": result.detector.test_threshold,
            "card": result.card.threshold,
            "paper": tables["table_6"]["SPICD-Net"]["threshold"],
        },
        "table_5": _experiments(result),
        "table_6": [_method(result, method, number == 0) for number, method in enumerate(result.methods)],
        "by_kind": {kind: _kind(result, kind) for kind in KINDS},
        "robustness_experiments": [trial.experiment.name for trial in chosen_trials(result.trials)],
        "robustness": [
            {"disturbance": point.disturbance, "level": point.level, **point.counts.figures()}
            for point in result.robustness
        ],
        "left_out": list(result.left_out),
        "scans_not_registered_again": sum(trial.left_out for trial in result.trials),
        "seconds": round(result.seconds, 1),
        "machine": result.machine,
    }


def _map(site: Site) -> Document:
    return {"scans": len(site.scans), "tiles": len(site.tiles.points)}


def _experiments(result: PaperResult) -> list[Document]:
    """Return the rows of Table 5: every experiment, and all of them together."""
    printed = published()["table_5"]
    ways = [result.detector.counts(threshold) for threshold in _both(result.detector)]
    rows = []
    for trial, chosen, best in zip(result.trials, *ways, strict=True):
        figures = {**chosen.figures(), "at_test_threshold": best.figures()}
        rows.append({**asdict(trial.experiment), **figures, "paper": printed[trial.experiment.name]})
    whole, best_whole = (pooled(way) for way in ways)
    aggregated = {"name": "aggregated", **whole.figures(), "at_test_threshold": best_whole.figures()}
    complete = len(result.trials) == len(published()["experiments"])
    return [*rows, {**aggregated, "paper": printed["aggregated"] if complete else None}]


def _method(result: PaperResult, method: MethodResult, ours: bool) -> Document:
    """Return a row of Table 6, with what it makes of removals and where nothing changed."""
    scores, truth = method.test.pooled, method.test.truth
    chosen, best = (pooled(method.counts(threshold)) for threshold in _both(method))
    return {
        "method": method.test.name,
        "threshold": method.threshold,
        **chosen.figures(),
        "test_threshold": method.test_threshold,
        "at_test_threshold": best.figures(),
        "area_under_roc": _known(roc(scores, truth).area),
        "average_precision": _known(precision_recall(scores, truth).average_precision),
        "removals": _of_operation(result, method, method.threshold, "remove").figures(),
        "false_positives_with_no_change": {
            "validation_threshold": _of_operation(result, method, method.threshold, None).false_positives,
            "test_threshold": _of_operation(result, method, method.test_threshold, None).false_positives,
        },
        "seconds": round(method.test.seconds, 2),
        "paper": published()["table_6"].get("SPICD-Net" if ours else IN_TABLE_6.get(method.test.name, "")),
    }


def _of_operation(
    result: PaperResult, method: MethodResult, threshold: float, operation: ChangeKind | None
) -> Confusion:
    """Count a method's tiles in the experiments of one operation; None: in the one without a change."""
    counts = zip(method.counts(threshold), result.trials, strict=True)
    return pooled(count for count, trial in counts if trial.experiment.operation == operation)


def _kind(result: PaperResult, kind: ChangeKind) -> Document:
    """Return the F1 of every method, micro-aggregated over the experiments of one operation."""
    tests = [test for test, trial in enumerate(result.trials) if trial.experiment.operation == kind]
    rows = {}
    for method in result.methods:
        ways = (method.counts(threshold) for threshold in _both(method))
        chosen, best = (pooled(counts[test] for test in tests) for counts in ways)
        rows[method.test.name] = {"f1": _known(chosen.f1), "f1_at_test_threshold": _known(best.f1)}
    return rows


def _both(method: MethodResult) -> tuple[float, float]:
    return method.threshold, method.test_threshold


def _known(value: float) -> float | None:
    return None if np.isnan(value) else round(value, 4)


Rows = list[list[str]]  #: the columns' names first


def tables(figures: Document) -> Group:
    """Show Tables 5 and 6 on a terminal, with the paper's figures beside ours."""
    threshold = figures["thresholds"]["validation"]
    first = f"Table 5: {figures['model']} above {threshold:.2f}, chosen on another corridor"
    second = "Table 6: all experiments; in brackets at the threshold that is best on them, as the paper's"
    return Group(
        _table(first, _table_5(figures), total=True), _table(second, _table_6(figures)), _summary(figures)
    )


def _table_5(figures: Document) -> Rows:
    names = ["precision", "recall", "F1", "accuracy"]
    rows = [["experiment", "TP", "FP", "FN", "TN", *names, *(f"paper's {name}" for name in names)]]
    for row in figures["table_5"]:
        paper = row["paper"] or {}
        ratios = [_ratio(source.get(name)) for source in (row, paper) for name in RATIOS]
        rows.append([row["name"], *(str(row[name]) for name in COUNTS), *ratios])
    return rows


def _table_6(figures: Document) -> Rows:
    names = ["precision", "recall", "F1", "accuracy"]
    rows = [["method", "threshold", *names, "area under ROC", "seconds a map", "paper's F1", "its seconds"]]
    for row in figures["table_6"]:
        best, paper = row["at_test_threshold"], row["paper"] or {}
        rows.append(
            [
                row["method"],
                f"{row['threshold']:.3g} ({row['test_threshold']:.3g})",
                *(f"{_ratio(row[name])} ({_ratio(best[name])})" for name in RATIOS),
                _ratio(row["area_under_roc"]),
                f"{row['seconds']:.1f}",
                _ratio(paper.get("f1")),
                f"{paper['seconds']:.1f}" if paper else "-",
            ]
        )
    return rows


def _summary(figures: Document) -> str:
    ours = figures["table_6"][0]["method"]
    kinds = ", ".join(f"{kind} {_ratio(rows[ours]['f1'])}" for kind, rows in figures["by_kind"].items())
    left_out = f"\nnot installed, left out: {', '.join(figures['left_out'])}" if figures["left_out"] else ""
    return f"F1 by kind: {kinds}; {figures['map']['tiles']} tiles, {figures['seconds']:.0f} s{left_out}"


def _table(title: str, rows: Rows, *, total: bool = False) -> Table:
    table = titled_table(title, rows[0], rows[1:])
    table.rows[-1].style = "bold" if total else ""
    return table


def _ratio(value: float | None) -> str:
    return shown(value, ".2f", missing="-")


def write_report(result: PaperResult, figures: Document, folder: Path) -> Path:
    """Write `report.html`, `paper.json` and a PNG a figure into the folder; return the report. Raises OSError."""
    every = pictures(result)
    images = []
    for picture in every:
        if picture.figure is not None:
            content = png(picture.figure)
            write_bytes(folder / f"{picture.name}.png", content)
            images.append((picture.caption, content))
    write_json(folder / "paper.json", figures)
    page = _page(figures, images, [picture.left_out for picture in every if picture.figure is None])
    write_bytes(folder / "report.html", page.encode())
    return folder / "report.html"


def _page(figures: Document, drawn: Sequence[tuple[str, bytes]], left_out: Sequence[str]) -> str:
    images = "".join(
        f'<figure><img alt="{html.escape(caption)}" '
        f'src="data:image/png;base64,{base64.b64encode(picture).decode()}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        for caption, picture in drawn
    )
    thresholds = figures["thresholds"]
    settings = figures["settings"]
    poses = "poses found by registration, modified scans registered again"
    poses = "true poses" if settings["true_poses"] else poses
    where = "in the modified scan alone, as in the paper"
    where = "in all scans of a tile" if settings["everywhere"] else where
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>The paper's benchmark: {html.escape(figures['model'])}</title><style>{STYLE}</style>"
        f"<h1>The paper's benchmark: {html.escape(figures['model'])}</h1>"
        f"<p>{figures['map']['tiles']} tiles of a simulated corridor, {figures['map']['scans']} scans, {poses}; "
        f"changes {where}. Threshold {thresholds['validation']:.2f}, chosen on another corridor; "
        f"{thresholds['test']:.2f} would be best here, {thresholds['card']:.2f} stands in the card.</p>"
        f"<h2>Table 5</h2>{_html(_table_5(figures))}<h2>Table 6</h2>{_html(_table_6(figures))}"
        '<p class="quiet">In brackets: at the threshold that is best on these experiments, as the paper chose '
        f"its own. Paper: {html.escape(figures['source'])}; its seconds are those of a GTX 1650.</p>"
        f"<h2>Pictures</h2>{images}"
        + "".join(f'<p class="quiet">Left out: {html.escape(words)}</p>' for words in left_out)
        + "</html>"
    )


def _html(rows: Rows) -> str:
    lines = []
    for number, row in enumerate(rows):
        tag = "td" if number else "th"
        lines.append("".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in row))
    return "<table>" + "".join(f"<tr>{line}</tr>" for line in lines) + "</table>"
