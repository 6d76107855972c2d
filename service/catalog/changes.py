"""Changes: tiles of finished surveys, over all visits to a map."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any, NamedTuple

from sqlalchemy import Select, and_, func, or_, select

from service.catalog import tables
from service.catalog.database import Database
from service.catalog.records import Bounds, ChangeRecord, TileRecord

_TILE, _SURVEY = tables.SurveyTile, tables.Survey
_TILES = select(_TILE, _SURVEY).join(_SURVEY, _SURVEY.survey_id == _TILE.survey_id)


class ChangePosition(NamedTuple):
    """Where a page ended."""

    captured_at: datetime
    survey_id: str
    score: float
    tile_id: str


@dataclass(frozen=True, kw_only=True, slots=True)
class ChangeFilter:
    """Which changed tiles are asked for; None takes all."""

    map_id: str
    survey_id: str | None = None
    bounds: Bounds | None = None  #: map frame; a tile is in when its box meets this one
    since: datetime | None = None  #: captured at or after
    until: datetime | None = None  #: captured at or before
    min_score: float | None = None  #: 0..1, inclusive


@dataclass(frozen=True, kw_only=True, slots=True)
class ChangePage:
    """Some changes of a longer list: newest survey first, most certain first within it."""

    items: tuple[ChangeRecord, ...]
    matched: int  #: of all pages together
    following: ChangePosition | None  #: where the next page starts, None at the end


class Changes:
    """The changes of the catalog."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def page(
        self, wanted: ChangeFilter, *, after: ChangePosition | None = None, limit: int = 100
    ) -> ChangePage:
        """Return changed tiles of surveys that are ready."""
        query = _matching(wanted)
        count = select(func.count()).select_from(query.subquery())
        rows = query if after is None else query.where(_behind(after))
        rows = rows.order_by(
            _SURVEY.captured_at.desc(), _SURVEY.survey_id.desc(), _TILE.score.desc(), _TILE.tile_id.asc()
        ).limit(limit + 1)
        with self._database.read() as session:
            matched = session.scalar(count) or 0
            records = [_record(tile, survey) for tile, survey in session.execute(rows)]
        items = tuple(records[:limit])
        return ChangePage(
            items=items, matched=matched, following=_position(items[-1]) if len(records) > limit else None
        )

    def of_survey(self, survey_id: str) -> tuple[ChangeRecord, ...]:
        """Return every tile of a survey, unobserved ones too, in the order of the grid."""
        query = _TILES.where(_TILE.survey_id == survey_id).order_by(_TILE.i, _TILE.j, _TILE.k)
        with self._database.read() as session:
            return tuple(_record(tile, survey) for tile, survey in session.execute(query))


def _matching(wanted: ChangeFilter) -> Select[tables.SurveyTile, tables.Survey]:
    query = _TILES.where(_SURVEY.map_id == wanted.map_id, _SURVEY.status == "ready", _TILE.state == "changed")
    if wanted.survey_id is not None:
        query = query.where(_SURVEY.survey_id == wanted.survey_id)
    if wanted.since is not None:
        query = query.where(_SURVEY.captured_at >= wanted.since)
    if wanted.until is not None:
        query = query.where(_SURVEY.captured_at <= wanted.until)
    if wanted.min_score is not None:
        query = query.where(_TILE.score >= wanted.min_score)
    if wanted.bounds is not None:
        low, high = wanted.bounds.min, wanted.bounds.max
        query = query.where(
            and_(_TILE.min_x <= high[0], _TILE.min_y <= high[1], _TILE.min_z <= high[2]),
            and_(_TILE.max_x >= low[0], _TILE.max_y >= low[1], _TILE.max_z >= low[2]),
        )
    return query


def _behind(after: ChangePosition) -> Any:
    same_time = _SURVEY.captured_at == after.captured_at
    same_survey = and_(same_time, _SURVEY.survey_id == after.survey_id)
    return or_(
        _SURVEY.captured_at < after.captured_at,
        and_(same_time, _SURVEY.survey_id < after.survey_id),
        and_(same_survey, _TILE.score < after.score),
        and_(same_survey, _TILE.score == after.score, _TILE.tile_id > after.tile_id),
    )


def _position(last: ChangeRecord) -> ChangePosition:
    return ChangePosition(last.captured_at, last.survey_id, last.tile.score or 0.0, last.tile.tile_id)


def _record(tile: tables.SurveyTile, survey: tables.Survey) -> ChangeRecord:
    return ChangeRecord(
        tile=TileRecord.of_row(tile),
        map_id=survey.map_id,
        map_version=survey.map_version,
        survey_id=survey.survey_id,
        model=survey.model,
        threshold=survey.threshold,
        captured_at=survey.captured_at,
    )
