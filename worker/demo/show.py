"""How the demo tells what came of it: short, and honest about misses."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from worker.demo.verdict import JudgedTile, Judgement, Verdict

MOST_FALSE_ALARMS = 6  #: shown one by one

_STYLE = {
    Verdict.HIT: "green",
    Verdict.MISS: "bold red",
    Verdict.FALSE_ALARM: "yellow",
    Verdict.UNOBSERVED: "blue",
}
_ORDER = (Verdict.HIT, Verdict.MISS, Verdict.UNOBSERVED, Verdict.FALSE_ALARM)


def show_judgement(console: Console, judgement: Judgement) -> None:
    """What was done and whether it was found, then tile by tile."""
    console.print(_edit_table(judgement))
    console.print(_tile_table(judgement))
    console.print(_counts(judgement), highlight=False)


def show_files(console: Console, files: dict[str, Path]) -> None:
    """Where the results lie."""
    lines = [Text.assemble((f"{what:<10}", "bold"), str(path)) for what, path in files.items()]
    console.print(Group(*lines))


def _edit_table(judgement: Judgement) -> Table:
    table = Table("what was done between the visits", "tiles it changed", "of them found")
    for edit in judgement.edits:
        style = "green" if edit.found else "bold red"
        table.add_row(edit.sentence, str(edit.tiles), Text(str(edit.found), style))
    return table


def _tile_table(judgement: Judgement) -> Table:
    table = Table("tile", "center x, y, z (m)", "score", "the service says", "the truth", "")
    shown = [tile for verdict in _ORDER for tile in _of(judgement, verdict)]
    for tile in shown:
        where = ", ".join(f"{value:.2f}" for value in tile.center)
        score = "" if tile.score is None else f"{tile.score:.2f}"
        verdict = Text(tile.verdict.value, _STYLE[tile.verdict])
        table.add_row(tile.tile_id, where, score, tile.state, tile.truth or "nothing changed", verdict)
    return table


def _of(judgement: Judgement, verdict: Verdict) -> list[JudgedTile]:
    """Most certain first; of false alarms only some."""
    tiles = sorted(
        (tile for tile in judgement.tiles if tile.verdict is verdict), key=lambda tile: -(tile.score or 0.0)
    )
    return tiles[:MOST_FALSE_ALARMS] if verdict is Verdict.FALSE_ALARM else tiles


def _counts(judgement: Judgement) -> str:
    counts = judgement.counts()
    hits, misses, alarms = (counts[v] for v in (Verdict.HIT, Verdict.MISS, Verdict.FALSE_ALARM))
    unseen, quiet = counts[Verdict.UNOBSERVED], counts[Verdict.RIGHT]
    lines = [
        f"{len(judgement.tiles)} tiles: {hits} hits, {misses} missed, {alarms} false alarms, {quiet} rightly quiet"
    ]
    if alarms > MOST_FALSE_ALARMS:
        lines.append(f"{alarms - MOST_FALSE_ALARMS} of the false alarms are not listed above")
    if unseen:
        lines.append(f"{unseen} changed tiles were not seen well enough to say")
    if judgement.outside:
        lines.append(f"{judgement.outside} more changed where the map holds too few points for a tile")
    return "\n".join(lines)
