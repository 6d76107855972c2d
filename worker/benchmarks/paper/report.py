"""The report: one HTML file with every table and picture in it, and the same pictures as files beside it."""

from __future__ import annotations

import base64
import html
import io
import json
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from worker.benchmarks.paper.benchmark import PaperResult
from worker.benchmarks.paper.pictures import pictures
from worker.benchmarks.paper.tables import COUNTS, ratio

STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:62rem;margin:2rem auto;padding:0 1rem;color:#1a1a1a}
table{border-collapse:collapse;font-size:13px;display:block;overflow-x:auto}th,td{padding:.2rem .6rem;text-align:right;border-bottom:1px solid #ddd}
th:first-child,td:first-child{text-align:left}tr:last-child td{font-weight:600}img{max-width:100%;height:auto}
figure{margin:2rem 0}figcaption,.quiet{color:#666;font-size:13px}"""


def write_report(result: PaperResult, told: dict[str, Any], folder: Path) -> Path:
    """`report.html`, `paper.json` and a PNG a figure, each written aside and renamed. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    every = pictures(result)
    drawn = [(one.name, one.caption, _png(one.figure)) for one in every if one.figure is not None]
    for name, _, picture in drawn:
        _save(folder / f"{name}.png", picture)
    _save(folder / "paper.json", (json.dumps(told, indent=2, allow_nan=False) + "\n").encode())
    page = _page(told, drawn, [one.left_out for one in every if one.figure is None])
    _save(folder / "report.html", page.encode())
    return folder / "report.html"


def _page(told: dict[str, Any], drawn: list[tuple[str, str, bytes]], left_out: list[str]) -> str:
    images = "".join(
        f'<figure><img alt="{html.escape(caption)}" src="data:image/png;base64,{base64.b64encode(picture).decode()}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        for _, caption, picture in drawn
    )
    thresholds = told["thresholds"]
    poses = (
        "true poses"
        if told["settings"]["true_poses"]
        else "poses found by registration, modified scans registered again"
    )
    where = (
        "in all scans of a tile"
        if told["settings"]["everywhere"]
        else "in the modified scan alone, as in the paper"
    )
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>The paper's benchmark: {html.escape(told['model'])}</title><style>{STYLE}</style>"
        f"<h1>The paper's benchmark: {html.escape(told['model'])}</h1>"
        f"<p>{told['map']['tiles']} tiles of a simulated corridor, {told['map']['scans']} scans, {poses}; changes {where}. "
        f"Threshold {thresholds['validation']:.2f}, chosen on another corridor; {thresholds['test']:.2f} would be best here, "
        f"{thresholds['card']:.2f} stands in the card.</p>"
        f"<h2>Table 5</h2>{_rows(_table_5(told))}<h2>Table 6</h2>{_rows(_table_6(told))}"
        f'<p class="quiet">In brackets: at the threshold that is best on these experiments, as the paper chose its own. Paper: {html.escape(told["source"])}; '
        f"its seconds are those of a GTX 1650.</p><h2>Pictures</h2>{images}"
        + "".join(f'<p class="quiet">Left out: {html.escape(words)}</p>' for words in left_out)
        + "</html>"
    )


def _table_5(told: dict[str, Any]) -> list[list[str]]:
    rows = [
        [
            "experiment",
            "TP",
            "FP",
            "FN",
            "TN",
            "precision",
            "recall",
            "F1",
            "accuracy",
            "paper's precision",
            "recall",
            "F1",
            "accuracy",
        ]
    ]
    for row in told["table_5"]:
        paper = row["paper"] or {}
        ratios = ("precision", "recall", "f1", "accuracy")
        rows.append(
            [
                row["name"],
                *(str(row[name]) for name in COUNTS),
                *(ratio(row[name]) for name in ratios),
                *(ratio(paper.get(name)) for name in ratios),
            ]
        )
    return rows


def _table_6(told: dict[str, Any]) -> list[list[str]]:
    rows = [
        [
            "method",
            "threshold",
            "precision",
            "recall",
            "F1",
            "accuracy",
            "area under ROC",
            "seconds",
            "paper's F1",
            "seconds",
        ]
    ]
    for row in told["table_6"]:
        best, paper = row["at_test_threshold"], row["paper"] or {}
        rows.append(
            [
                row["method"],
                f"{row['threshold']:.3g} ({row['test_threshold']:.3g})",
                *(
                    f"{ratio(row[name])} ({ratio(best[name])})"
                    for name in ("precision", "recall", "f1", "accuracy")
                ),
                ratio(row["area_under_roc"]),
                f"{row['seconds']:.1f}",
                ratio(paper.get("f1")),
                f"{paper['seconds']:.1f}" if paper else "-",
            ]
        )
    return rows


def _rows(rows: list[list[str]]) -> str:
    head, *body = [[html.escape(cell) for cell in row] for row in rows]
    lines = ["<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in body]
    return (
        "<table><tr>" + "".join(f"<th>{cell}</th>" for cell in head) + "</tr>" + "".join(lines) + "</table>"
    )


def _png(figure: Figure) -> bytes:
    into = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(into, format="png")
    return into.getvalue()


def _save(path: Path, content: bytes) -> None:
    aside = path.with_name(path.name + ".tmp")
    aside.write_bytes(content)
    aside.replace(path)
