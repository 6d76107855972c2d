"""The figures of `spicd-worker evaluate revisit` as tables on a terminal."""

from __future__ import annotations

from typing import Any

from rich.console import Group
from rich.table import Table

TITLES = {
    "kind": "recall by kind of change",
    "case": "second visit",
    "building": "building",
    "misfit": "survey off the map, by its true poses",
    "sigma": "by the sigmas stored with the survey",
}


def tables(result: dict[str, Any]) -> Group:
    """What there was to find, the methods in one table, and their recall and false alarms by groups of tiles."""
    return Group(_methods(result), _groups(result), *_notes(result["test"]))


def _methods(result: dict[str, Any]) -> Table:
    there = result["test"]
    title = (
        f"{there['visits']} visits, {there['without_change']} of them without a change: "
        f"{there['observed']} of {there['tiles']} tiles observed, {there['changed']['counted']} of them changed"
    )
    table = Table(title=title, title_justify="left", title_style="bold")
    table.add_column("method")
    for column in (
        "F1 (95%)", "precision", "recall", "false alarms", "quiet visits alarmed", "threshold",
        "test-optimal: F1", "threshold", "ROC area", "AP", "seconds",
    ):  # fmt: skip
        table.add_column(column, justify="right")
    for row in result["methods"]:
        table.add_row(row["name"], *_row(row))
    chosen = result["validation"]
    table.caption = (
        f"thresholds: best F1 on {chosen['visits']} visits to other buildings with {chosen['changed']['counted']} "
        "changed tiles; test-optimal: best F1 on the test visits themselves"
    )
    return table


def _row(row: dict[str, Any]) -> tuple[str, ...]:
    chosen, best = row["chosen"], row["best"]
    low, high = chosen["f1_interval"]
    return (
        f"{_share(chosen['f1'], 2)} ({low:.2f}-{high:.2f})",
        _share(chosen["precision"], 2),
        _share(chosen["recall"], 2),
        _percent(chosen["false_positive_rate"]),
        f"{row['unchanged_visits_with_false_alarm']} of {row['unchanged_visits']}",
        f"{chosen['threshold']:.3g}",
        _share(best["f1"], 2),
        f"{best['threshold']:.3g}",
        f"{row['area_under_roc']:.3f}",
        f"{row['average_precision']:.3f}",
        f"{row['seconds']:.1f}",
    )


def _groups(result: dict[str, Any]) -> Table:
    methods = result["methods"]
    table = Table(title="changes found; false alarms", title_justify="left", title_style="bold")
    table.add_column("tiles")
    for row in methods:
        table.add_column(row["name"], justify="right")
    for by, title in TITLES.items():
        table.add_section()
        table.add_row(f"[bold]{title}")
        for group in methods[0]["groups"][by]:
            cells = [_cell(row["groups"][by][group]) for row in methods]
            if any(cells):
                table.add_row(f"  {group}", *cells)
    return table


def _cell(counts: dict[str, Any]) -> str:
    """As in `12 of 30; 1.4%`; what cannot be is left out."""
    changed = counts["true_positives"] + counts["false_negatives"]
    said = [f"{counts['true_positives']} of {changed}"] if changed else []
    if counts["false_positive_rate"] is not None:
        said.append(_percent(counts["false_positive_rate"]))
    return "; ".join(said)


def _notes(there: dict[str, Any]) -> list[str]:
    changed, scans = there["changed"], there["scans"]["second"]
    off = there["misfit_centimetres"]
    lines = [
        f"changed tiles that no method is asked about: {changed['unobserved']} not observed by the survey, "
        f"{changed['out_of_sight']} whose change was in no sensor's sight, {changed['outside_the_map']} where "
        "the map has too few points for a tile",
        f"scans of the second visits: {scans['accepted']} of {scans['of']} placed, {scans['wrong']} of them over 10 cm off",
    ]
    if off is not None:
        lines.append(
            f"survey off the map by its poses: median {off['median']:.1f} cm, 95% {off['95%']:.1f} cm, "
            f"worst {off['worst']:.1f} cm"
        )
    return lines


def _share(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _percent(value: float | None) -> str:
    return "" if value is None else f"{value:.1%}"
