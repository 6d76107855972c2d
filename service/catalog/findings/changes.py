"""Changes: tiles of finished surveys, over all visits to a map."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

from sqlalchemy import ColumnElement, Select, and_, exists, func, select
from sqlalchemy.orm import InstrumentedAttribute, aliased

from service.catalog.findings.feeds import read_feed
from service.catalog.following.events import FeedCursor, Published
from service.catalog.records import Bounds, ChangeRecord, TileRecord, TileState
from service.catalog.sql import tables
from service.catalog.sql.database import Database
from service.catalog.sql.keyset import Key, Order, Values, behind, order_by

_TILE, _SURVEY, _TOLD = tables.SurveyTile, tables.Survey, tables.TileChange
#: Every tile of every survey, with the change that it belongs to.
_TILES = (
    select(_TILE, _SURVEY, _TOLD)
    .join(_SURVEY, _SURVEY.survey_id == _TILE.survey_id)
    .outerjoin(_TOLD, and_(_TOLD.survey_id == _TILE.told_by, _TOLD.tile_id == _TILE.tile_id))
)


#: What changes may be ordered by; with a minus: downwards.
ChangeSort = Literal[
    "first_seen", "-first_seen", "last_seen", "-last_seen", "captured_at", "-captured_at",
    "score", "-score", "max_score", "-max_score",
]  # fmt: skip
#: Likewise the tiles of one survey; `tile_index` is the order of the grid.
TileSort = Literal["tile_index", "-tile_index", "score", "-score"]
VoxelKind = Literal["appeared", "disappeared"]  #: what voxels of a tile did

_Tiles = Select[tables.SurveyTile, tables.Survey, tables.TileChange]
_SCORE = func.coalesce(_TILE.score, -1.0)  #: tiles without a score are below all others


@dataclass(frozen=True, kw_only=True, slots=True)
class ChangeFilter:
    """Which changed tiles are asked for; None takes all."""

    map_id: str
    change_id: str | None = None
    survey_id: str | None = None
    repeats: bool = False  #: each visit's, and not each change once; so it is too where a survey is named
    state: TileState = "changed"  #: another one than `changed` is each visit's as well
    kind: VoxelKind | None = None  #: with voxels that did so; None of detectors of tiles alone
    device_id: str | None = (
        None  #: of the visit; of a change that is told once: of one of its visits at least
    )
    bounds: Bounds | None = None  #: map frame; a tile is in when its box meets this one
    since: datetime | None = None  #: first seen, or with `repeats` captured, at or after
    until: datetime | None = None  #: likewise, at or before
    min_score: float | None = (
        None  #: 0..1, inclusive; of a change that is told once: in one of the visits at least
    )

    @property
    def once(self) -> bool:
        """Whether a change that stays over several surveys is told once."""
        return not self.repeats and self.survey_id is None and self.state == "changed"


@dataclass(frozen=True, kw_only=True, slots=True)
class TileFilter:
    """Which tiles of a survey are asked for; None takes all."""

    survey_id: str
    state: TileState | None = None
    kind: VoxelKind | None = None
    bounds: Bounds | None = None  #: map frame; a tile is in when its box meets this one
    min_score: float | None = None  #: 0..1, inclusive


@dataclass(frozen=True, kw_only=True, slots=True)
class ChangePage:
    """Some tiles of a longer list."""

    items: tuple[ChangeRecord, ...]
    matched: int  #: of all pages together
    following: Values | None  #: behind which row the next page starts, None at the end


class Changes:
    """The changes of the catalog."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def page(
        self,
        wanted: ChangeFilter,
        *,
        sort: ChangeSort | None = None,
        after: Values | None = None,
        limit: int = 100,
    ) -> ChangePage:
        """Return tiles of surveys that are ready: each change once, or with `repeats` for each visit.

        Newest first where no order is given, most certain first within a survey.
        """
        return self._page(_matching(wanted), change_order(wanted, sort), after, limit)

    def tiles(
        self,
        wanted: TileFilter,
        *,
        sort: TileSort = "tile_index",
        after: Values | None = None,
        limit: int | None = None,
    ) -> ChangePage:
        """Return tiles of a survey, unobserved ones too; all of them where there is no limit."""
        query = _TILES.where(_TILE.survey_id == wanted.survey_id)
        if wanted.state is not None:
            query = query.where(_TILE.state == wanted.state)
        if wanted.min_score is not None:
            query = query.where(_TILE.score >= wanted.min_score)
        query = _with_voxels(query, wanted.kind)
        return self._page(_meeting(query, wanted.bounds), tile_order(sort), after, limit)

    def published(
        self, wanted: ChangeFilter, *, after: FeedCursor, limit: int = 100
    ) -> Published[ChangeRecord]:
        """Return changes behind a cursor in the order of publication: what was told anew, then what is new.

        Raises Gone.
        """
        matching = _matching(wanted)
        with self._database.snapshot() as session:
            return read_feed(
                session, matching, _TOLD, _record, map_id=wanted.map_id, after=after, limit=limit
            )

    def of_survey(self, survey_id: str) -> tuple[ChangeRecord, ...]:
        """Return every tile of a survey, unobserved ones too, in the order of the grid."""
        return self.tiles(TileFilter(survey_id=survey_id)).items

    def _page(self, query: _Tiles, order: Order, after: Values | None, limit: int | None) -> ChangePage:
        count = select(func.count()).select_from(query.subquery())
        rows = query if after is None else query.where(behind(order, after))
        rows = rows.add_columns(*(key.column for key in order)).order_by(*order_by(order))
        rows = rows if limit is None else rows.limit(limit + 1)
        with self._database.read() as session:
            matched = session.scalar(count) or 0
            read: list[tuple[ChangeRecord, Values]] = [
                (_record(*row[:3]), tuple(row[3:])) for row in session.execute(rows)
            ]
        shown = read[:limit]
        following = shown[-1][1] if shown and len(read) > len(shown) else None
        return ChangePage(items=tuple(record for record, _ in shown), matched=matched, following=following)


def change_order(wanted: ChangeFilter, sort: ChangeSort | None = None) -> Order:
    """Return the keys that changes are ordered by."""
    chosen = sort or ("-first_seen" if wanted.once else "-captured_at")
    columns: dict[str, tuple[Any, type[datetime] | type[float]]] = {
        "first_seen": (func.coalesce(_TOLD.first_seen, _SURVEY.captured_at), datetime),
        "last_seen": (func.coalesce(_TOLD.last_seen, _SURVEY.captured_at), datetime),
        "captured_at": (_SURVEY.captured_at, datetime),
        "score": (_SCORE, float),
        "max_score": (func.coalesce(_TOLD.max_score, -1.0), float),
    }
    column, kind = columns[chosen.removeprefix("-")]
    return (
        Key(column=column, type=kind, descending=chosen.startswith("-")),
        Key(column=_SURVEY.survey_id, type=str, descending=True),
        Key(column=_SCORE, type=float, descending=True),
        Key(column=_TILE.tile_id, type=str),
    )


def tile_order(sort: TileSort) -> Order:
    """Return the keys that the tiles of a survey are ordered by."""
    down = sort.startswith("-")
    if sort in ("score", "-score"):
        return Key(column=_SCORE, type=float, descending=down), Key(column=_TILE.tile_id, type=str)
    return tuple(Key(column=column, type=int, descending=down) for column in (_TILE.i, _TILE.j, _TILE.k))


def _instant(wanted: ChangeFilter) -> InstrumentedAttribute[datetime]:
    """Return the column by which changes are asked for in time."""
    return _TOLD.first_seen if wanted.once else _SURVEY.captured_at


def _matching(wanted: ChangeFilter) -> _Tiles:
    query = _TILES.where(
        _SURVEY.map_id == wanted.map_id, _SURVEY.status == "ready", _TILE.state == wanted.state
    )
    if wanted.once:
        query = query.where(_TILE.survey_id == _TILE.told_by)
    if wanted.change_id is not None:
        query = query.where(_TOLD.change_id == wanted.change_id)
    instant, score = _instant(wanted), _TOLD.max_score if wanted.once else _TILE.score
    if wanted.survey_id is not None:
        query = query.where(_SURVEY.survey_id == wanted.survey_id)
    if wanted.device_id is not None:
        query = query.where(
            _seen_by(wanted.device_id) if wanted.once else _SURVEY.device_id == wanted.device_id
        )
    if wanted.since is not None:
        query = query.where(instant >= wanted.since)
    if wanted.until is not None:
        query = query.where(instant <= wanted.until)
    if wanted.min_score is not None:
        query = query.where(score >= wanted.min_score)
    return _meeting(_with_voxels(query, wanted.kind), wanted.bounds)


def _seen_by(device_id: str) -> ColumnElement[bool]:
    """Return the condition that one of the visits which saw a change is of this device."""
    tile, survey = aliased(tables.SurveyTile), aliased(tables.Survey)
    same = (
        tile.told_by == _TILE.survey_id,
        tile.tile_id == _TILE.tile_id,
        tile.survey_id == survey.survey_id,
    )
    return exists().where(survey.map_id == _SURVEY.map_id, survey.device_id == device_id, *same)


def _with_voxels(query: _Tiles, kind: VoxelKind | None) -> _Tiles:
    if kind is None:
        return query
    return query.where((_TILE.appeared if kind == "appeared" else _TILE.disappeared) > 0)


def _meeting(query: _Tiles, bounds: Bounds | None) -> _Tiles:
    """Keep the tiles whose box meets this one."""
    if bounds is None:
        return query
    low, high = bounds.min, bounds.max
    return query.where(
        and_(_TILE.min_x <= high[0], _TILE.min_y <= high[1], _TILE.min_z <= high[2]),
        and_(_TILE.max_x >= low[0], _TILE.max_y >= low[1], _TILE.max_z >= low[2]),
    )


def _record(tile: tables.SurveyTile, survey: tables.Survey, told: tables.TileChange | None) -> ChangeRecord:
    return ChangeRecord(
        tile=TileRecord.of_row(tile),
        map_id=survey.map_id,
        map_version=survey.map_version,
        survey_id=survey.survey_id,
        device_id=survey.device_id,
        model=survey.model,
        threshold=survey.threshold,
        captured_at=survey.captured_at,
        first_seen=None if told is None else told.first_seen,
        last_seen=None if told is None else told.last_seen,
        max_score=None if told is None else told.max_score,
        change_id=None if told is None else told.change_id,
    )
