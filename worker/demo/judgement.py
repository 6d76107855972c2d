"""What the service said of each tile and scan beside what is true, and how that is told: short, honest about misses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from worker.cloud.poses import difference
from worker.cloud.tiling import TileGrid
from worker.cloud.types import Floats, Indices, Matrix4
from worker.simulation.sensor import SimulatedScan
from worker.simulation.truth import TileTruth

MOST_FALSE_ALARMS = 6  #: shown one by one


class Verdict(Enum):
    """How an answer stands to the truth; the value is what a person reads."""

    HIT = "hit"
    MISS = "missed"
    FALSE_ALARM = "false alarm"
    UNOBSERVED = "not seen well"  #: truly changed, and the service said that it cannot tell
    RIGHT = "rightly quiet"


@dataclass(frozen=True, kw_only=True, slots=True)
class JudgedTile:
    """One tile of the map."""

    tile_id: str
    center: tuple[float, float, float]  #: metres, map frame
    score: float | None
    state: str  #: as the service named it
    truth: str | None  #: what truly changed in it; None if nothing did
    verdict: Verdict


@dataclass(frozen=True, kw_only=True, slots=True)
class JudgedEdit:
    """One thing that was done between the visits."""

    sentence: str
    tiles: int  #: that it truly changed, of those in the map
    found: int  #: of these, called changed


@dataclass(frozen=True, kw_only=True, slots=True)
class Judgement:
    """The whole survey."""

    tiles: tuple[JudgedTile, ...]
    edits: tuple[JudgedEdit, ...]
    outside: int  #: truly changed tiles that the map does not keep: too few points before

    def counts(self) -> Counter[Verdict]:
        return Counter(tile.verdict for tile in self.tiles)


def grid_of(manifest: dict[str, Any]) -> TileGrid:
    """Read the grid of a map's tile manifest."""
    origin, size = (np.array(manifest[name], np.float64) for name in ("tile_origin", "tile_size"))
    shape, lowest = (tuple(manifest[name]) for name in ("n_tiles_grid", "tile_lowest_idx"))
    return TileGrid(origin=origin, size=size, shape=shape, lowest=lowest)


def judge(
    features: Sequence[Mapping[str, Any]], truth: TileTruth, edits: Sequence[tuple[str, TileTruth]]
) -> Judgement:
    """Compare every feature of `/surveys/{id}/tiles` with the truth; `edits` names each edit with its own truth."""
    tiles = [feature["properties"] for feature in features]
    indices = np.array([tile["tile_index"] for tile in tiles], np.int32).reshape(-1, 3)
    flagged = indices[[tile["state"] == "changed" for tile in tiles]]
    changed = truth.of(indices)
    return Judgement(
        tiles=tuple(
            JudgedTile(
                tile_id=tile["tile_id"],
                center=tuple(tile["center"]),
                score=tile["score"],
                state=tile["state"],
                truth=_main_edit(index, edits) if is_changed else None,
                verdict=_verdict(tile["state"], is_changed),
            )
            for tile, index, is_changed in zip(tiles, indices, changed.tolist(), strict=True)
        ),
        edits=tuple(
            JudgedEdit(sentence=sentence, tiles=int(own.of(indices).sum()), found=int(own.of(flagged).sum()))
            for sentence, own in edits
        ),
        outside=int(truth.changed.sum() - changed.sum()),
    )


def _verdict(state: str, changed: bool) -> Verdict:
    if state == "changed":
        return Verdict.HIT if changed else Verdict.FALSE_ALARM
    if not changed:
        return Verdict.RIGHT
    return Verdict.UNOBSERVED if state == "unobserved" else Verdict.MISS


def _main_edit(index: Indices, edits: Sequence[tuple[str, TileTruth]]) -> str:
    """Name the edit that changed most of the tile."""
    sentence, _ = max(edits, key=lambda edit: edit[1].cells_of(index[None]).sum())
    return sentence


_STYLE = {
    Verdict.HIT: "green",
    Verdict.MISS: "bold red",
    Verdict.FALSE_ALARM: "yellow",
    Verdict.UNOBSERVED: "blue",
}
_ORDER = (Verdict.HIT, Verdict.MISS, Verdict.UNOBSERVED, Verdict.FALSE_ALARM)


def show_judgement(console: Console, judgement: Judgement) -> None:
    """Show what was done and whether it was found, then tile by tile."""
    console.print(_edit_table(judgement))
    console.print(_tile_table(judgement))
    console.print(counts_line(judgement), highlight=False)


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
    """List the tiles of a verdict, most certain first; of false alarms only some."""
    tiles = sorted(
        (tile for tile in judgement.tiles if tile.verdict is verdict), key=lambda tile: -(tile.score or 0.0)
    )
    return tiles[:MOST_FALSE_ALARMS] if verdict is Verdict.FALSE_ALARM else tiles


def counts_line(judgement: Judgement) -> str:
    """Count the tiles by verdict."""
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


def placement_line(visit: str, outcomes: Sequence[dict[str, Any]], scans: Sequence[SimulatedScan]) -> str:
    """Tell in one line how well scans were placed; `outcomes` are those of a map or survey document, in their order."""
    placed = [(outcome, scan) for outcome, scan in zip(outcomes, scans, strict=True) if outcome["accepted"]]
    line = f"{visit}: {len(placed)} of {len(scans)} scans placed"
    if not placed:
        return line
    before = _errors([(scan.prior, scan.world_from_sensor) for _, scan in placed])
    after = _errors([(np.array(out["map_from_scan"]), scan.world_from_sensor) for out, scan in placed])
    fitted = [outcome["fitness"] for outcome, _ in placed if outcome["fitness"] is not None]
    fitness = f", median fitness {np.median(fitted):.2f}" if fitted else ""
    return (
        f"{line}{fitness}; off by {_words(np.median(after, axis=0))}, "
        f"at worst {_words(after.max(axis=0))}; the robot's own odometry: {_words(np.median(before, axis=0))}"
    )


def _errors(pairs: list[tuple[Matrix4, Matrix4]]) -> Floats:
    """Return metres and radians between what was found and what is true: (N, 2)"""
    return np.array([difference(pose, true) for pose, true in pairs])


def _words(error: Floats) -> str:
    return f"{error[0] * 100:.1f} cm and {np.degrees(error[1]):.1f}°"
