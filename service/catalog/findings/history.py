"""What holds over all surveys of a map: tile changes told once, objects, and what versions took over.

It is derived from the surveys that are ready, and written anew whenever one of them comes, changes or goes, in the
transaction that does so and with the row of the map locked: so it is the same whatever the order in which they end.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, get_args

from sqlalchemy import ColumnElement, Row, Select, and_, exists, select, update
from sqlalchemy.orm import Session

from service.catalog.findings.stays import Known, Look, Stay, heir, recognized, stays
from service.catalog.findings.tracking import (
    Accepted,
    Part,
    Parts,
    Side,
    Sighting,
    Track,
    Visit,
    track_objects,
)
from service.catalog.following.publication import Column, tell
from service.catalog.records import EventType, ObjectStatus, Place, rfc3339
from service.catalog.sql import tables
from service.catalog.sql.database import Database
from service.catalog.sql.tables import (
    Acceptance,
    MapObject,
    Survey,
    SurveyObject,
    SurveyTile,
    TileChange,
    new_id,
    now,
)

_MANY = 500  #: tiles that a query names; where there are more it reads those of the whole map
SAME_SCORE = 0.01  #: scores that differ by less are one: nobody would act on it
SAME_PLACE = (
    0.1  #: metres; a thing whose box differs by less, by what could be seen of it, stands where it stood
)
_STATE = ("kind", "status", "last_known", "transient", "first_seen", "accepted_in_version")
_BOX = ("min_x", "min_y", "min_z", "max_x", "max_y", "max_z")
#: Columns of an object that its surveys decide; where one changes it is told anew.
_TOLD = (
    *_STATE, "last_seen", "last_looked", "sightings", "survey_id", "number", "other_survey_id", "other_number",
    "probability", *_BOX,
)  # fmt: skip


def note(session: Session, ready: tables.MapVersion | Survey | tables.Model) -> None:
    """Take in that something of a map became ready; the caller has locked the map."""
    if isinstance(ready, tables.MapVersion) and ready.survey_id is not None:
        _accept(session, ready, ready.survey_id)
        rewrite(session, ready.map_id)
    elif isinstance(ready, Survey):
        rewrite(session, ready.map_id)


def rewrite(session: Session, map_id: str) -> None:
    """Write tile changes, objects and their counts of a map anew; the caller has locked the map."""
    session.flush()
    accepted = list(session.scalars(select(Acceptance).where(Acceptance.map_id == map_id)))
    _rewrite_tiles(session, map_id, accepted)
    tracks = _rewrite_objects(session, map_id, accepted)
    told = session.scalar(select(exists().where(_ready(map_id), Survey.objects.is_not(None))))
    counts = Counter(track.status for track in tracks)
    row = session.get_one(tables.Map, map_id)
    row.objects = {status: counts[status] for status in get_args(ObjectStatus)} if told else {}


def catch_up(database: Database) -> None:
    """Write it for maps whose surveys ended under a release that did not."""
    waiting = select(tables.Map.map_id).where(tables.Map.objects.is_(None))
    with database.read() as session:
        map_ids = list(session.scalars(waiting))
    for map_id in map_ids:
        with database.write() as session:
            row = session.get(tables.Map, map_id, with_for_update=True)
            if row is not None and row.objects is None:
                rewrite(session, map_id)


def _ready(map_id: str) -> ColumnElement[bool]:
    return and_(Survey.map_id == map_id, Survey.status == "ready")


def _accept(session: Session, version: tables.MapVersion, survey_id: str) -> None:
    """Keep what a version took over of a survey, for either may be deleted later."""
    tiles = select(SurveyTile.tile_id).where(SurveyTile.survey_id == survey_id, SurveyTile.state == "changed")
    replaced = list(session.scalars(tiles.order_by(SurveyTile.tile_id)))
    objects = select(SurveyObject.now, SurveyObject.before).where(SurveyObject.survey_id == survey_id)
    objects = objects.order_by(SurveyObject.number)
    session.add(
        Acceptance(
            map_id=version.map_id,
            version=version.version,
            tiles=replaced,
            objects=[
                _taken_over(now_at, before_at, set(replaced))
                for now_at, before_at in session.execute(objects)
            ],
        )
    )


def _taken_over(
    now_at: dict[str, Any] | None, before_at: dict[str, Any] | None, replaced: set[str]
) -> dict[str, Any]:
    """Return the places of an object that the map follows: what is new joins it; what is gone leaves replaced tiles."""
    left = before_at is not None and not replaced.isdisjoint(before_at["tiles"])
    return {"now": now_at, "before": before_at if left else None}


# tiles


def _rewrite_tiles(session: Session, map_id: str, accepted: Sequence[Acceptance]) -> None:
    """Write the changes of every tile that ever changed, and which of them each changed tile belongs to."""
    accepted_in: dict[str, list[int]] = {}
    for taken in accepted:
        for tile_id in taken.tiles:
            accepted_in.setdefault(tile_id, []).append(taken.version)
    looks, told = _looks(session, map_id)
    seen_by: dict[tuple[str | None, str], set[str]] = {}
    for (survey_id, tile_id), teller in told.items():
        seen_by.setdefault((teller, tile_id), set()).add(survey_id)
    rows: dict[str, list[TileChange]] = {}
    for row in session.scalars(_changes_of(map_id)):
        rows.setdefault(row.tile_id, []).append(row)
    links: list[dict[str, Any]] = []
    new: list[TileChange] = []
    updated: list[tuple[TileChange, bool]] = []  #: and whether nothing but its times is new
    for tile_id in sorted(looks.keys() | rows.keys()):
        before = rows.get(tile_id, [])
        told_by = {row.survey_id for row in before}
        found = stays(looks.get(tile_id, ()), accepted_in=accepted_in.get(tile_id, ()), told_by=told_by)
        known = [
            (
                row,
                Known(
                    change_id=row.change_id,
                    told_by=row.survey_id,
                    survey_ids=frozenset(seen_by.get((row.survey_id, tile_id), ())),
                ),
            )
            for row in before
        ]
        facts = {one.change_id: (_facts(row), one.survey_ids) for row, one in known}
        after = _write_changes(session, map_id, tile_id, found, known)
        links += _links(after, told)
        for row, stay in after:
            if row.change_id not in facts:
                new.append(row)
            elif facts[row.change_id] != (_facts(row), frozenset(stay.survey_ids)):
                updated.append((row, _stays_so(facts[row.change_id][0], _facts(row))))
    if links:
        session.execute(update(SurveyTile), links)
    for row in sorted(new, key=_surest_first):
        _tell_change(session, row, "change.told", "published")
    for row, only_times in sorted(updated, key=lambda one: _surest_first(one[0])):
        _tell_change(session, row, "change.updated", "updated", only_times=only_times)


def _surest_first(row: TileChange) -> tuple[Any, ...]:
    return -row.max_score, row.tile_id, row.first_seen


def _facts(row: TileChange) -> tuple[Any, ...]:
    """Return what is told of a change, beside which visits saw it."""
    return row.survey_id, row.first_seen, row.last_seen, row.max_score


def _stays_so(before: tuple[Any, ...], after: tuple[Any, ...]) -> bool:
    """Tell whether two `_facts` differ in nothing but when the change was seen last, and by less than the score says."""
    (teller, first, _, score), (teller_now, first_now, _, score_now) = before, after
    return (teller, first) == (teller_now, first_now) and abs(score_now - score) < SAME_SCORE


def _changes_of(map_id: str) -> Select[TileChange]:
    """Return a query for what was told of a map, oldest first."""
    return (
        select(TileChange)
        .where(TileChange.map_id == map_id)
        .order_by(TileChange.published, TileChange.change_id)
    )


def _looks(session: Session, map_id: str) -> tuple[dict[str, list[Look]], dict[tuple[str, str], str | None]]:
    """Return the looks at each tile that ever changed, and by (survey, tile) what each changed one is told by now."""
    surveys = select(Survey.survey_id, Survey.captured_at, Survey.map_version).where(_ready(map_id))
    about = {
        survey_id: (captured_at, version) for survey_id, captured_at, version in session.execute(surveys)
    }
    tile, of_survey = SurveyTile, Survey.survey_id == SurveyTile.survey_id
    ever = select(tile.tile_id).join(Survey, of_survey).where(_ready(map_id), tile.state == "changed")
    query = select(tile.tile_id, tile.survey_id, tile.state, tile.score, tile.told_by).join(Survey, of_survey)
    query = query.where(_ready(map_id), tile.state.in_(("changed", "unchanged")), tile.tile_id.in_(ever))
    looks: dict[str, list[Look]] = {}
    told: dict[tuple[str, str], str | None] = {}
    for tile_id, survey_id, state, score, told_by in session.execute(query):
        captured_at, version = about[survey_id]
        changed = state == "changed"
        look = Look(
            survey_id=survey_id,
            captured_at=captured_at,
            map_version=version,
            score=score if changed else None,
        )
        looks.setdefault(tile_id, []).append(look)
        if changed:
            told[survey_id, tile_id] = told_by
    return looks, told


def _write_changes(
    session: Session,
    map_id: str,
    tile_id: str,
    found: Sequence[Stay],
    known: Sequence[tuple[TileChange, Known]],
) -> list[tuple[TileChange, Stay]]:
    """Write the changes of one tile: those that go on keep their ids, and those that nobody sees are withdrawn."""
    rows = {one.change_id: row for row, one in known}
    named = recognized(found, [one for _, one in known])
    after: list[tuple[TileChange, Stay]] = []
    for n, stay in enumerate(found):
        row = rows[named[n].change_id] if n in named else None
        if row is None:
            row = TileChange(
                change_id=new_id("change"), map_id=map_id, tile_id=tile_id, survey_id=stay.told_by
            )
            session.add(row)
        if row.survey_id not in stay.survey_ids:
            row.survey_id = stay.told_by
        row.first_seen, row.last_seen, row.max_score = stay.first_seen, stay.last_seen, stay.max_score
        after.append((row, stay))
    going_on = {one.change_id for one in named.values()}
    for row, one in known:
        if one.change_id not in going_on:
            into = heir(found, one)
            _withdraw_change(session, row, None if into is None else after[into][0].change_id)
    return after


def _links(
    after: Sequence[tuple[TileChange, Stay]], told: Mapping[tuple[str, str], str | None]
) -> list[dict[str, Any]]:
    """Return what has to be written on the tiles of surveys that belong to another change by now."""
    return [
        {"survey_id": survey_id, "tile_id": row.tile_id, "told_by": row.survey_id}
        for row, stay in after
        for survey_id in stay.survey_ids
        if told[survey_id, row.tile_id] != row.survey_id
    ]


def _tell_change(session: Session, row: TileChange, event: EventType, column: Column, **more: bool) -> None:
    tell(
        session,
        event,
        row.change_id,
        map_id=row.map_id,
        publishes=TileChange,
        column=column,
        change_id=row.change_id,
        tile_id=row.tile_id,
        survey_id=row.survey_id,
        first_seen=rfc3339(row.first_seen),
        last_seen=rfc3339(row.last_seen),
        max_score=row.max_score,
        **more,
    )


def _withdraw_change(session: Session, row: TileChange, merged_into: str | None) -> None:
    told: dict[str, Any] = {"change_id": row.change_id, "tile_id": row.tile_id, "merged_into": merged_into}
    tell(session, "change.withdrawn", row.change_id, map_id=row.map_id, **told)
    session.delete(row)


# objects


def _rewrite_objects(session: Session, map_id: str, accepted: Sequence[Acceptance]) -> tuple[Track, ...]:
    """Write which object each sighting is of, and what became of each object."""
    sightings = _sightings(session, map_id)
    in_order_of_age = select(MapObject).where(MapObject.map_id == map_id)
    in_order_of_age = in_order_of_age.order_by(MapObject.created, MapObject.object_id)
    rows = {row.object_id: row for row in session.scalars(in_order_of_age)}
    taken = [
        Accepted(version=one.version, parts=tuple(_parts(**places) for places in one.objects))
        for one in accepted
    ]
    tracks = track_objects(_visits(session, map_id, sightings), taken, ids=list(rows))
    named = {track.object_id or new_id("object"): track for track in tracks}
    # what is known of them changed, and not what became of them; and whether a further look alone is new
    quiet: list[tuple[MapObject, bool]] = []
    for object_id, track in named.items():
        row = rows.get(object_id)
        before = None if row is None else _told_of(row)
        if row is None:
            row = MapObject(object_id=object_id, map_id=map_id, created=now())
            session.add(row)
        _write_track(row, track, sightings)
        event = _event_of(row, before)
        if event is not None:
            _tell_object(session, row, event)
        elif _told_of(row) != before or any(one.object_id != object_id for _, one in track.sightings):
            quiet.append((row, before is not None and _stands_so(before, _told_of(row))))
    for row, only_times in quiet:
        _tell_object(session, row, "object.updated", only_times=only_times)
    for object_id, row in rows.items():
        if object_id not in named:
            tell(session, "object.withdrawn", object_id, map_id=map_id, object_id=object_id)
            session.delete(row)
    _link(session, named)
    return tracks


def _tell_object(session: Session, row: MapObject, event: EventType, **more: bool) -> None:
    """Tell an object that is new, or anew one that was known."""
    tell(
        session,
        event,
        row.object_id,
        map_id=row.map_id,
        publishes=MapObject,
        column="published" if event == "object.told" else "updated",
        object_id=row.object_id,
        kind=row.kind,
        status=row.status,
        survey_id=row.survey_id,
        probability=row.probability,
        **more,
    )


def _stands_so(before: Mapping[str, Any], after: Mapping[str, Any]) -> bool:
    """Tell whether an object is what and where it was, and a further look alone is new."""
    same = all(before[name] == after[name] for name in _STATE)
    moved = max(abs(before[name] - after[name]) for name in _BOX)
    return same and moved < SAME_PLACE and abs(before["probability"] - after["probability"]) < SAME_SCORE


def _told_of(row: MapObject) -> dict[str, Any]:
    """Return what is told of an object."""
    return {name: getattr(row, name) for name in _TOLD}


def _event_of(row: MapObject, before: Mapping[str, Any] | None) -> EventType | None:
    """Return the event of an object that is new, or of what became of one; `before` is what was told of it."""
    if before is None:
        return "object.told"
    last_known, accepted_in = before["last_known"], before["accepted_in_version"]
    if row.accepted_in_version is not None and accepted_in is None:
        return "object.accepted"
    if row.accepted_in_version is None and (row.last_known == "gone_again") != (last_known == "gone_again"):
        return "object.gone_again" if row.last_known == "gone_again" else "object.seen_again"
    return None


def _link(session: Session, named: Mapping[str, Track]) -> None:
    """Write the object of each sighting that has another one so far, or none."""
    links = [
        {"survey_id": visit.survey_id, "number": one.number, "object_id": object_id}
        for object_id, track in named.items()
        for visit, one in track.sightings
        if one.object_id != object_id
    ]
    if links:
        session.execute(update(SurveyObject), links)


def _sightings(session: Session, map_id: str) -> dict[tuple[str, int], Row[Any]]:
    """Return what the tracking needs of every sighting, by survey and number."""
    row = SurveyObject
    query = select(
        row.survey_id, row.number, row.object_id, row.kind, row.probability, row.now, row.before
    ).join(Survey, Survey.survey_id == row.survey_id)
    query = query.where(_ready(map_id)).order_by(row.survey_id, row.number)
    return {(found.survey_id, found.number): found for found in session.execute(query)}


def _visits(session: Session, map_id: str, sightings: Mapping[tuple[str, int], Row[Any]]) -> list[Visit]:
    """Return the surveys that tell objects, with what they could judge of the tiles that any object touches."""
    found: dict[str, list[Sighting]] = {}
    for (survey_id, number), row in sightings.items():
        one = Sighting(number=number, parts=_parts(row.now, row.before), object_id=row.object_id)
        found.setdefault(survey_id, []).append(one)
    touched = {
        tile_id
        for of_survey in found.values()
        for one in of_survey
        for part in one.parts.values()
        for tile_id in part.tiles
    }
    observed = _observed(session, map_id, touched)
    query = select(Survey.survey_id, Survey.captured_at, Survey.map_version).where(
        Survey.objects.is_not(None)
    )
    return [
        Visit(
            survey_id=survey_id,
            captured_at=captured_at,
            map_version=map_version,
            sightings=tuple(found.get(survey_id, ())),
            observed=observed.get(survey_id, {}),
        )
        for survey_id, captured_at, map_version in session.execute(query.where(_ready(map_id)))
    ]


def _observed(session: Session, map_id: str, tile_ids: set[str]) -> dict[str, dict[str, float]]:
    """Return the share observed of these tiles, by survey and tile."""
    query = select(SurveyTile.survey_id, SurveyTile.tile_id, SurveyTile.observed_share).join(
        Survey, Survey.survey_id == SurveyTile.survey_id
    )
    query = query.where(SurveyTile.observed_share.is_not(None))
    if len(tile_ids) <= _MANY:
        query = query.where(SurveyTile.tile_id.in_(sorted(tile_ids)))
    observed: dict[str, dict[str, float]] = {}
    for survey_id, tile_id, share in session.execute(query.where(_ready(map_id))):
        observed.setdefault(survey_id, {})[tile_id] = share or 0.0
    return observed


def _parts(now: Mapping[str, Any] | None, before: Mapping[str, Any] | None) -> Parts:
    """Return the parts of an object, whose places are JSON."""
    places: dict[Side, Mapping[str, Any] | None] = {"now": now, "before": before}
    return {side: _part(place) for side, place in places.items() if place is not None}


def _part(place: Mapping[str, Any]) -> Part:
    return Part(
        center=tuple(place["center"]),
        size=tuple(place["size"]),
        yaw=place["yaw"],
        tiles=tuple(place["tiles"]),
    )


def _latest(seen: tuple[Visit, Sighting]) -> tuple[Any, ...]:
    """Order sightings by time; of two of one visit the one that says where the thing is now comes last."""
    visit, one = seen
    return visit.captured_at, visit.survey_id, "now" in one.parts, one.number


def _write_track(row: MapObject, track: Track, sightings: Mapping[tuple[str, int], Row[Any]]) -> None:
    latest_first = sorted(track.sightings, key=_latest, reverse=True)
    by_side = {side: next(seen for seen in latest_first if side in seen[1].parts) for side in track.sides}
    visit, one = latest_first[0]
    row.kind = "moved" if len(by_side) == 2 else "appeared" if "now" in by_side else "disappeared"
    row.probability = sightings[visit.survey_id, one.number].probability
    row.survey_id, row.number = visit.survey_id, one.number
    others = ((by.survey_id, other.number) for by, other in by_side.values() if (by, other) != (visit, one))
    row.other_survey_id, row.other_number = next(others, (None, None))
    row.status, row.last_known, row.transient = track.status, track.last_known, track.transient
    row.first_seen, row.last_seen = track.sightings[0][0].captured_at, visit.captured_at
    row.last_looked, row.accepted_in_version = track.last_looked, track.accepted_in_version
    row.sightings = track.visits
    bounds = _shown(by_side, sightings).bounds
    row.min_x, row.min_y, row.min_z = bounds.min
    row.max_x, row.max_y, row.max_z = bounds.max


def _shown(
    by_side: Mapping[Side, tuple[Visit, Sighting]], sightings: Mapping[tuple[str, int], Row[Any]]
) -> Place:
    """Return where an object is, or was where it is no more."""
    side: Side = "now" if "now" in by_side else "before"
    visit, one = by_side[side]
    return Place.model_validate(getattr(sightings[visit.survey_id, one.number], side))
