"""How the figures are shown: one table, a table of the reasons that were named, and two curves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.console import Group, RenderableType
from rich.table import Table

from worker.benchmarks import plots
from worker.benchmarks.documents import Document, shown, titled_table
from worker.benchmarks.plots import QUIET, WRONG, coloured

RELIABILITY, ERRORS = "reliability.png", "errors.png"


def tables(result: Document) -> RenderableType:
    """Return the tables of what `evaluate` gave."""
    shown_tables = [_verdicts(result), _targets(result["targets"]), _reasons(result["rows"])]
    if "real" in result:
        shown_tables.append(_real(result["real"]))
    return Group(*shown_tables)


def draw(folder: Path, result: Document) -> None:
    """Write `errors.png`, and `reliability.png` where confidences were stated. Raises OSError."""
    if result["error_curve"]["lost"] or any(result["error_curve"]["believed"]):
        plots.save(_error_curve(result["error_curve"]), folder / ERRORS)
    if result["reliability"]:
        plots.save(_reliability(result["reliability"]), folder / RELIABILITY)


def _verdicts(result: Document) -> Table:
    columns = (
        "trials",
        "scans",
        "right",
        "wrong",
        "in doubt",
        "ambiguous",
        "refused",
        "wrong (95%)",
        "cm off, median (worst)",
        "degrees off",
        "seconds",
    )
    rows = [
        (
            row["name"],
            str(row["scans"]),
            _of(row["right"], row["here"]),
            *(str(row[verdict]) for verdict in ("wrong", "in_doubt", "ambiguous", "refused")),
            _interval(row["wrong_rate"]),
            *(_errors(row[unit], digits) for unit, digits in (("centimetres", 1), ("degrees", 2))),
            shown(None if row["seconds"] is None else row["seconds"]["median"], ".2f"),
        )
        for row in result["rows"]
    ]
    title = f"scans of simulated surveys ({result['part']}, from seed {result['first_seed']})"
    caption = "wrong: believed at a pose that is over 10 cm or 1 degree off, or of another place"
    return titled_table(title, columns, rows, caption=caption)


def _targets(targets: Document) -> Table:
    names = {
        "impostors_believed": "surveys of alike places that were believed",
        "believed_of_other_plans": "the same without hotel rooms of the very same plan and furniture",
        "mirrored_or_scaled_believed": "scans mirrored, or scaled by 2% and more, that were believed",
        "right_lost": "right scans, up to 25% changed, refused, ambiguous, in doubt or wrong",
    }
    rows = [
        (name, f"{targets[key]['count']} of {targets[key]['of']}", _interval(targets[key]))
        for key, name in names.items()
    ]
    good = targets["right_within_3_cm"]
    rows.append(("of the right ones within 3 cm and 0.5 degrees", f"{good['count']} of {good['of']}", ""))
    return titled_table("what the targets speak of", ("", "count", "rate (95%)"), rows)


def _reasons(rows: list[Document]) -> Table:
    """Show which reasons were told of the scans of each row."""
    names = sorted({reason for row in rows for reason in row["reasons"]})
    return titled_table(
        "reasons told, of refusals and in warnings",
        ("trials", "scans", "as it should be", *names),
        [
            (
                row["name"],
                str(row["scans"]),
                str(row["named"] or ""),
                *(str(row["reasons"].get(name, "")) for name in names),
            )
            for row in rows
        ],
    )


def _real(rows: list[Document]) -> Table:
    shown_rows = [
        (
            row["name"],
            row["verdict"],
            ""
            if row["centimetres"] is None
            else f"{row['centimetres']:.1f} cm, {row['degrees']:.2f} degrees",
            ", ".join(row["named"]),
            shown(row["confidence"], ".2f"),
            f"{row['seconds']:.1f}",
        )
        for row in rows
    ]
    return titled_table(
        "real scans", ("what was sent", "verdict", "off", "told", "confidence", "seconds"), shown_rows
    )


def _error_curve(curve: Document) -> Figure:
    figure, axes = plots.single("Belief in impostors against right scans lost")
    axes.plot(curve["bars"], curve["believed"], color=WRONG, label="impostors believed")
    for color, (name, lost) in coloured(sorted(curve["lost"].items(), key=lambda item: float(item[0][:-1]))):
        axes.plot(curve["bars"], lost, color=color, label=f"right, {name} of the furniture changed: lost")
    axes.set_ylim(-0.02, 1.02)
    plots.label(axes, "confidence asked for", "share of the surveys")
    return figure


def _reliability(rows: list[Document]) -> Figure:
    figure, axes = plots.single("How often a placement of a stated confidence is right")
    confidence, rate, low, high = (
        np.array([row[name] for row in rows]) for name in ("confidence", "rate", "low", "high")
    )
    axes.plot([0, 1], [0, 1], ":", color=QUIET)
    axes.errorbar(confidence, rate, yerr=np.abs([rate - low, high - rate]), fmt="o-", color=plots.COLORS[0])
    for row in rows:
        axes.annotate(str(row["surveys"]), (row["confidence"], row["rate"]), fontsize=7, color=QUIET)
    plots.label(axes, "confidence stated", "share that was right", legend=False)
    return figure


def _of(count: int, total: int) -> str:
    return f"{count} of {total}" if total else ""


def _interval(rate: Document) -> str:
    return "" if rate["rate"] is None else f"{rate['rate']:.1%} ({rate['low']:.1%} to {rate['high']:.1%})"


def _errors(spread: Document | None, digits: int) -> str:
    return "" if spread is None else f"{spread['median']:.{digits}f} ({spread['worst']:.{digits}f})"
