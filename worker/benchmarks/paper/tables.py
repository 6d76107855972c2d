"""The figures of `spicd-worker evaluate paper` on a terminal."""

from __future__ import annotations

from typing import Any

from rich.console import Group
from rich.table import Table


def tables(told: dict[str, Any]) -> Group:
    """Tables 5 and 6 with the paper's figures beside ours; `told` is the document."""
    return Group(_table_5(told), _table_6(told), _words(told))


def _table_5(told: dict[str, Any]) -> Table:
    threshold = told["thresholds"]["validation"]
    table = Table(
        title=f"Table 5: {told['model']} above {threshold:.2f}, chosen on another corridor",
        title_justify="left",
        title_style="bold",
    )
    table.add_column("experiment")
    for column in ("TP", "FP", "FN", "TN", "precision", "recall", "F1", "paper's F1", "accuracy", "paper's"):
        table.add_column(column, justify="right")
    for row in told["table_5"]:
        paper = row["paper"] or {}
        table.add_row(
            row["name"],
            *(str(row[name]) for name in COUNTS),
            *(ratio(row[name]) for name in ("precision", "recall", "f1")),
            ratio(paper.get("f1")),
            ratio(row["accuracy"]),
            ratio(paper.get("accuracy")),
            style="bold" if row["name"] == "aggregated" else "",
        )
    return table


COUNTS = ("true_positives", "false_positives", "false_negatives", "true_negatives")


def _table_6(told: dict[str, Any]) -> Table:
    table = Table(
        title="Table 6: all experiments; in brackets at the threshold that is best on them, as the paper's",
        title_justify="left",
        title_style="bold",
    )
    table.add_column("method")
    for column in ("threshold", "precision", "recall", "F1", "paper's F1", "area under ROC", "seconds a map"):
        table.add_column(column, justify="right")
    for row in told["table_6"]:
        best = row["at_test_threshold"]
        table.add_row(
            row["method"],
            f"{row['threshold']:.3g} ({row['test_threshold']:.3g})",
            *(f"{ratio(row[name])} ({ratio(best[name])})" for name in ("precision", "recall", "f1")),
            ratio((row["paper"] or {}).get("f1")),
            ratio(row["area_under_roc"]),
            f"{row['seconds']:.1f}",
        )
    return table


def _words(told: dict[str, Any]) -> str:
    ours = told["table_6"][0]["method"]
    kinds = ", ".join(f"{kind} {ratio(rows[ours]['f1'])}" for kind, rows in told["by_kind"].items())
    left_out = f"\nnot installed, left out: {', '.join(told['left_out'])}" if told["left_out"] else ""
    return f"F1 by kind: {kinds}; {told['map']['tiles']} tiles, {told['seconds']:.0f} s{left_out}"


def ratio(value: float | None) -> str:
    """Two decimals, a dash where there is none."""
    return "-" if value is None else f"{value:.2f}"
