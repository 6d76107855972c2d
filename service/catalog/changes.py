"""Changes: tiles of finished surveys, over all visits to a map."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any, NamedTuple

from sqlalchemy import Select, and_, func, or_, select
from sqlalchemy.orm import InstrumentedAttribute

from service.catalog import tables
from service.catalog.database import Database
from service.catalog.events import FeedCursor, Withdrawn, check_cursor, withdrawn
from service.catalog.records import Bounds, ChangeRecord, TileRecord

_TILE, _SURVEY, _TOLD = tables.SurveyTile, tables.Survey, tables.TileChange
#: Every tile of every survey, with the change that it belongs to.
_TILES = (
    select(_TILE, _SURVEY, _TOLD)
    .join(_SURVEY, _SURVEY.survey_id == _TILE.survey_id)
    .outerjoin(_TOLD, and_(_TOLD.survey_id == _TILE.told_by, _TOLD.tile_id == _TILE.tile_id))
)


class ChangePosition(NamedTuple):
    """Where a page ended."""

    instant: datetime  #: by which the list is ordered
    survey_id: str
    score: float
    tile_id: str


@dataclass(frozen=True, kw_only=True, slots=True)
class ChangeFilter:
    """Which changed tiles are asked for; None takes all."""

    map_id: str
    survey_id: str | None = None
    repeats: bool = False  #: each visit's, and not each change once; so it is too where a survey is named
    bounds: Bounds | None = None  #: map frame; a tile is in when its box meets this one
    since: datetime | None = None  #: first seen, or with `repeats` captured, at or after
    until: datetime | None = None  #: likewise, at or before
    min_score: float | None = (
        None  #: 0..1, inclusive; of a change that is told once: in one of the visits at least
    )

    @property
    def once(self) -> bool:
        """Whether a change that stays over several surveys is told once."""
        return not self.repeats and self.survey_id is None


@dataclass(frozen=True, kw_only=True, slots=True)
class PublishedChanges:
    """Some changes in the order in which they were first told."""

    items: tuple[ChangeRecord, ...]
    withdrawn: tuple[Withdrawn, ...]  #: since the cursor, of this map, whether or not a filter took it
    matched: int  #: behind the cursor, those of later answers among them
    cursor: FeedCursor  #: where to go on, also where nothing was told


@dataclass(frozen=True, kw_only=True, slots=True)
class ChangePage:
    """Some changes of a longer list: newest first, most certain first within a survey."""

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
        """Return changed tiles of surveys that are ready: each change once, or with `repeats` for each visit."""
        query = _matching(wanted)
        count = select(func.count()).select_from(query.subquery())
        instant = _instant(wanted)
        rows = query if after is None else query.where(_behind(instant, after))
        rows = rows.order_by(
            instant.desc(), _SURVEY.survey_id.desc(), _TILE.score.desc(), _TILE.tile_id.asc()
        ).limit(limit + 1)
        with self._database.read() as session:
            matched = session.scalar(count) or 0
            records = [_record(*row) for row in session.execute(rows)]
        items = tuple(records[:limit])
        following = _position(items[-1], wanted) if len(records) > limit else None
        return ChangePage(items=items, matched=matched, following=following)

    def published(self, wanted: ChangeFilter, *, after: FeedCursor, limit: int = 100) -> PublishedChanges:
        """Return changes behind a cursor in the order of publication, each once. Raises Gone."""
        query = _matching(wanted).where(_TOLD.published > after.told)
        with self._database.snapshot() as session:
            last = check_cursor(session, after.withdrawn)
            matched = session.scalar(select(func.count()).select_from(query.subquery())) or 0
            rows = session.execute(query.order_by(_TOLD.published).limit(limit)).all()
            gone = withdrawn(session, "change.withdrawn", wanted.map_id, after)
        told = rows[-1][2].published if matched > len(rows) else last
        return PublishedChanges(
            items=tuple(_record(*row) for row in rows),
            withdrawn=gone,
            matched=matched,
            cursor=FeedCursor(told, last),
        )

    def of_survey(self, survey_id: str) -> tuple[ChangeRecord, ...]:
        """Return every tile of a survey, unobserved ones too, in the order of the grid."""
        query = _TILES.where(_TILE.survey_id == survey_id).order_by(_TILE.i, _TILE.j, _TILE.k)
        with self._database.read() as session:
            return tuple(_record(*row) for row in session.execute(query))


def _instant(wanted: ChangeFilter) -> InstrumentedAttribute[datetime]:
    """Return the column by which changes are ordered and asked for in time."""
    return _TOLD.first_seen if wanted.once else _SURVEY.captured_at


def _matching(wanted: ChangeFilter) -> Select[tables.SurveyTile, tables.Survey, tables.TileChange]:
    query = _TILES.where(_SURVEY.map_id == wanted.map_id, _SURVEY.status == "ready", _TILE.state == "changed")
    if wanted.once:
        query = query.where(_TILE.survey_id == _TILE.told_by)
    instant, score = _instant(wanted), _TOLD.max_score if wanted.once else _TILE.score
    if wanted.survey_id is not None:
        query = query.where(_SURVEY.survey_id == wanted.survey_id)
    if wanted.since is not None:
        query = query.where(instant >= wanted.since)
    if wanted.until is not None:
        query = query.where(instant <= wanted.until)
    if wanted.min_score is not None:
        query = query.where(score >= wanted.min_score)
    if wanted.bounds is not None:
        low, high = wanted.bounds.min, wanted.bounds.max
        query = query.where(
            and_(_TILE.min_x <= high[0], _TILE.min_y <= high[1], _TILE.min_z <= high[2]),
            and_(_TILE.max_x >= low[0], _TILE.max_y >= low[1], _TILE.max_z >= low[2]),
        )
    return query


def _behind(instant: InstrumentedAttribute[datetime], after: ChangePosition) -> Any:
    same_time = instant == after.instant
    same_survey = and_(same_time, _SURVEY.survey_id == after.survey_id)
    return or_(
        instant < after.instant,
        and_(same_time, _SURVEY.survey_id < after.survey_id),
        and_(same_survey, _TILE.score < after.score),
        and_(same_survey, _TILE.score == after.score, _TILE.tile_id > after.tile_id),
    )


def _position(last: ChangeRecord, wanted: ChangeFilter) -> ChangePosition:
    instant = last.first_seen if wanted.once and last.first_seen is not None else last.captured_at
    return ChangePosition(instant, last.survey_id, last.tile.score or 0.0, last.tile.tile_id)


def _record(tile: tables.SurveyTile, survey: tables.Survey, told: tables.TileChange | None) -> ChangeRecord:
    return ChangeRecord(
        tile=TileRecord.of_row(tile),
        map_id=survey.map_id,
        map_version=survey.map_version,
        survey_id=survey.survey_id,
        model=survey.model,
        threshold=survey.threshold,
        captured_at=survey.captured_at,
        first_seen=None if told is None else told.first_seen,
        last_seen=None if told is None else told.last_seen,
        max_score=None if told is None else told.max_score,
        change_id=None if told is None else told.change_id,
    )
