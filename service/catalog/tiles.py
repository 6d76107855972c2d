"""Tiles of surveys: rows and records."""

from __future__ import annotations

from service.catalog import tables
from service.catalog.records import Bounds, TileRecord


def tile_row(survey_id: str, tile: TileRecord) -> tables.SurveyTile:
    """The row of a record."""
    (i, j, k), low, high = tile.tile_index, tile.bounds.min, tile.bounds.max
    p_unchanged, p_changed, p_different = tile.probabilities or (None, None, None)
    return tables.SurveyTile(
        survey_id=survey_id,
        tile_id=tile.tile_id,
        i=i,
        j=j,
        k=k,
        min_x=low[0],
        min_y=low[1],
        min_z=low[2],
        max_x=high[0],
        max_y=high[1],
        max_z=high[2],
        state=tile.state,
        score=tile.score,
        p_unchanged=p_unchanged,
        p_changed=p_changed,
        p_different=p_different,
        n_reference=tile.n_reference,
        n_current=tile.n_current,
    )


def tile_record(row: tables.SurveyTile) -> TileRecord:
    """The record of a row."""
    scored = row.p_unchanged is not None
    return TileRecord(
        tile_id=row.tile_id,
        tile_index=(row.i, row.j, row.k),
        bounds=Bounds(min=(row.min_x, row.min_y, row.min_z), max=(row.max_x, row.max_y, row.max_z)),
        state=row.state,
        score=row.score,
        probabilities=(row.p_unchanged, row.p_changed, row.p_different) if scored else None,
        n_reference=row.n_reference,
        n_current=row.n_current,
    )
