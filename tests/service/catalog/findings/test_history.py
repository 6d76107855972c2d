"""What holds over all surveys of a map, in the database: right whatever order they end in, and kept by ids."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Mapping, Sequence
from datetime import timedelta

import pytest
from sqlalchemy import select, update

from service.catalog.catalog import Catalog, open_catalog
from service.catalog.findings import history
from service.catalog.findings.objects import ObjectFilter, SightingFilter
from service.catalog.following.events import FeedCursor
from service.catalog.records import MapObjectRecord, Motion, ObjectRecord, SightingRecord, TileRecord
from service.catalog.sql import tables
from service.settings import Settings
from tests.support.samples import NOON, add_map, add_survey, add_version, place, thing, tile

LOOKED = [tile(i, j, "unchanged", 0.1, observed_share=0.9) for i in range(6) for j in range(3)]
BOX, CHAIR, DESK = place(1, 1), place(4, 1), place(7, 1, size=(1.6, 0.8, 0.75))
DESK_BEFORE = place(7, 3.4, size=(1.6, 0.8, 0.75))

CHAIR_TILE = (2, 0)

Told = list[tuple[str, str, int]]  #: kind, status and number of sightings


def visit(catalog: Catalog, day: int, *objects: ObjectRecord, ready: bool = True) -> str:
    """A survey of a day that looked everywhere; its id."""
    return add_survey(
        catalog, LOOKED, captured_at=NOON + timedelta(days=day), objects=objects, moving=0, ready=ready
    )[0]


def rows(catalog: Catalog, map_id: str = "lobby") -> dict[str, tables.MapObject]:
    query = select(tables.MapObject).where(tables.MapObject.map_id == map_id)
    with catalog.database.read() as session:
        found = session.scalars(query.order_by(tables.MapObject.first_seen, tables.MapObject.number))
        return {row.object_id: row for row in found}


def told(catalog: Catalog) -> Told:
    return [(row.kind, row.status, row.sightings) for row in rows(catalog).values()]


def ids_of(catalog: Catalog, survey_id: str) -> list[str | None]:
    table = tables.SurveyObject
    query = select(table.object_id).where(table.survey_id == survey_id).order_by(table.number)
    with catalog.database.read() as session:
        return list(session.scalars(query))


def test_three_visits_tell_their_story(catalog: Catalog) -> None:
    add_map(catalog)
    desk = thing(1, now=DESK, before=DESK_BEFORE)
    first = visit(catalog, 1, desk, thing(2, now=BOX))
    assert told(catalog) == [("moved", "new", 1), ("appeared", "new", 1)]
    second = visit(catalog, 2, desk, thing(2, before=CHAIR), thing(3, now=BOX))
    visit(catalog, 3, thing(1, before=CHAIR), desk.model_copy(update={"number": 2}))
    assert told(catalog) == [
        ("moved", "still_there", 3),
        ("appeared", "gone_again", 2),
        ("disappeared", "still_there", 2),
    ]
    assert ids_of(catalog, first) == [ids_of(catalog, second)[0], ids_of(catalog, second)[2]]
    assert catalog.maps.get("lobby").objects == {
        "new": 0,
        "still_there": 2,
        "gone_again": 1,
        "unknown": 0,
        "accepted": 0,
    }


STORY: Mapping[int, Sequence[ObjectRecord]] = {
    1: [thing(1, now=DESK, before=DESK_BEFORE), thing(2, now=BOX)],
    2: [thing(1, before=CHAIR), thing(2, now=DESK, before=DESK_BEFORE)],
    3: [thing(1, now=BOX), thing(2, before=CHAIR)],
}


@pytest.mark.parametrize("order", list(itertools.permutations(STORY)))
def test_surveys_may_end_in_any_order(catalog: Catalog, order: Sequence[int]) -> None:
    add_map(catalog)
    jobs = {}
    for day in STORY:
        survey_id, jobs[day] = add_survey(catalog, captured_at=NOON + timedelta(days=day), ready=False)
        catalog.surveys.save_result(survey_id, tiles=LOOKED, threshold=0.5, objects=STORY[day], moving=0)
    assert rows(catalog) == {}  # none is ready
    seen: set[str] = set()
    for day in order:
        catalog.jobs.succeed(jobs[day])
        assert seen <= set(rows(catalog))  # no id is given up on the way
        seen |= set(rows(catalog))
    assert sorted(told(catalog)) == [
        ("appeared", "still_there", 2),
        ("disappeared", "still_there", 2),
        ("moved", "gone_again", 2),
    ]
    assert [row.kind for row in rows(catalog).values() if row.transient] == ["appeared"]


def test_a_step_that_runs_twice_changes_nothing(catalog: Catalog) -> None:
    add_map(catalog)
    visit(catalog, 1, *STORY[1])
    survey_id, job_id = add_survey(catalog, captured_at=NOON + timedelta(days=2), ready=False)
    save = {"tiles": LOOKED, "threshold": 0.5, "objects": STORY[2], "moving": 0}
    for _ in range(2):  # the first run was killed before it could say that it had succeeded
        catalog.surveys.save_result(survey_id, **save)  # type: ignore[arg-type]
    assert catalog.jobs.succeed(job_id)
    before, ids = told(catalog), ids_of(catalog, survey_id)
    catalog.surveys.save_result(survey_id, **save)  # type: ignore[arg-type]  # a run that was thought lost
    assert not catalog.jobs.succeed(job_id)
    assert (told(catalog), ids_of(catalog, survey_id)) == (before, ids)
    assert None not in ids


def test_a_survey_that_is_deleted_takes_its_sightings_and_leaves_the_ids_of_the_others(
    catalog: Catalog,
) -> None:
    add_map(catalog)
    first, second, third = (visit(catalog, day, thing(1, now=BOX)) for day in (1, 2, 3))
    (object_id,) = rows(catalog)
    catalog.surveys.delete(first)
    assert ids_of(catalog, second) == ids_of(catalog, third) == [object_id]
    (row,) = rows(catalog).values()
    assert (row.object_id, row.sightings, row.first_seen) == (object_id, 2, NOON + timedelta(days=2))
    catalog.surveys.delete(second)
    catalog.surveys.delete(third)
    assert rows(catalog) == {}
    assert catalog.maps.get("lobby").objects == {}


def test_surveys_that_end_at_once_are_all_counted(settings: Settings, catalog: Catalog) -> None:
    add_map(catalog)
    jobs = []
    for day in range(8):
        survey_id, job_id = add_survey(catalog, captured_at=NOON + timedelta(days=day), ready=False)
        objects = [thing(1, now=BOX), thing(2, before=CHAIR)]
        catalog.surveys.save_result(survey_id, tiles=LOOKED, threshold=0.5, objects=objects, moving=0)
        jobs.append(job_id)
    together = threading.Barrier(len(jobs))

    def succeed(job_id: str) -> None:
        own = open_catalog(settings, migrate=False)
        together.wait()
        own.jobs.succeed(job_id)
        own.close()

    threads = [threading.Thread(target=succeed, args=(job_id,)) for job_id in jobs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert told(catalog) == [("appeared", "still_there", 8), ("disappeared", "still_there", 8)]


def test_a_survey_that_ends_while_another_is_deleted_does_not_wait_for_ever(
    settings: Settings, catalog: Catalog
) -> None:
    add_map(catalog)
    for day in range(4):
        kept, job_id = add_survey(catalog, captured_at=NOON + timedelta(days=day), ready=False)
        catalog.surveys.save_result(kept, tiles=LOOKED, threshold=0.5, objects=[thing(1, now=BOX)])
        together = threading.Barrier(2)

        def delete(survey_id: str = kept, together: threading.Barrier = together) -> None:
            own = open_catalog(settings, migrate=False)
            together.wait()
            own.surveys.delete(survey_id)
            own.close()

        thread = threading.Thread(target=delete)
        thread.start()
        together.wait()
        catalog.jobs.succeed(job_id)
        thread.join(timeout=20)
        assert not thread.is_alive()
        assert rows(catalog) == {}


def test_a_survey_that_failed_has_no_say(catalog: Catalog) -> None:
    add_map(catalog)
    visit(catalog, 1, thing(1, now=BOX))
    survey_id, job_id = add_survey(catalog, captured_at=NOON + timedelta(days=2), ready=False)
    catalog.surveys.save_result(survey_id, tiles=LOOKED, threshold=0.5, objects=[])
    catalog.jobs.dismiss(job_id)
    assert told(catalog) == [("appeared", "new", 1)]


def test_a_survey_that_tells_tiles_alone_says_nothing_of_objects(catalog: Catalog) -> None:
    add_map(catalog)
    assert catalog.maps.get("lobby").objects == {}
    visit(catalog, 1, thing(1, now=BOX))
    add_survey(catalog, [tile(0, 0, "unchanged", 0.1)], captured_at=NOON + timedelta(days=2))
    assert told(catalog) == [("appeared", "new", 1)]


def test_maps_do_not_share_objects(catalog: Catalog) -> None:
    add_map(catalog)
    add_map(catalog, "hall")
    visit(catalog, 1, thing(1, now=BOX))
    add_survey(
        catalog, LOOKED, map_id="hall", captured_at=NOON + timedelta(days=2), objects=[thing(1, now=BOX)]
    )
    (ours,), (theirs,) = rows(catalog), rows(catalog, "hall")
    assert ours != theirs
    catalog.maps.delete("hall")
    assert list(rows(catalog)) == [ours]


# what moved, and is told in part


OLD_PLACE, NEW_PLACE = (
    tile(4, 2, "unchanged", 0.1, observed_share=0.9),
    tile(4, 0, "unchanged", 0.1, observed_share=0.9),
)
MOVED = thing(1, now=DESK, before=DESK_BEFORE)
HERE, GONE = thing(1, now=DESK, probability=0.7), thing(2, before=DESK_BEFORE, probability=0.6)


def short_visit(catalog: Catalog, day: int, *objects: ObjectRecord, looked: Sequence[TileRecord]) -> str:
    """A survey of a day that looked at some tiles alone; its id."""
    at = NOON + timedelta(days=day)
    return add_survey(catalog, list(looked), captured_at=at, objects=objects, moving=0)[0]


def only(catalog: Catalog) -> tuple[MapObjectRecord, tuple[SightingRecord, ...]]:
    """The one object of the map as the list has it, and its history; its own document tells the same."""
    (listed,) = catalog.objects.page(ObjectFilter(map_id="lobby")).items
    record, history = catalog.objects.get("lobby", listed.object_id)
    assert record == listed
    assert len(history) == record.sightings
    return record, history


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize(
    ("objects", "looked", "kind", "told"),
    [
        ([HERE], [NEW_PLACE], "moved", "appeared"),
        ([HERE], LOOKED, "appeared", "appeared"),
        ([GONE], [OLD_PLACE], "moved", "disappeared"),
        ([GONE], LOOKED, "disappeared", "disappeared"),
        ([HERE, GONE], LOOKED, "moved", "moved"),
        ([HERE, GONE], [], "moved", "moved"),
        ([], [], "moved", None),
        ([], LOOKED, "moved", None),
    ],
)
def test_what_moved_stays_moved_where_a_visit_tells_a_part_of_it(
    catalog: Catalog,
    objects: Sequence[ObjectRecord],
    looked: Sequence[TileRecord],
    kind: str,
    told: str | None,
    late: bool,
) -> None:
    add_map(catalog)
    at = NOON + timedelta(days=1)
    first, job_id = add_survey(catalog, captured_at=at, ready=False)
    catalog.surveys.save_result(first, tiles=LOOKED, threshold=0.5, objects=[MOVED], moving=0)
    if not late:
        catalog.jobs.succeed(job_id)
    second = short_visit(catalog, 2, *objects, looked=looked)
    if late:
        catalog.jobs.succeed(job_id)
    record, history = only(catalog)
    now, before = (DESK if kind != "disappeared" else None), (DESK_BEFORE if kind != "appeared" else None)
    thing_now = record.latest.thing
    assert (thing_now.kind, thing_now.now, thing_now.before) == (kind, now, before)
    assert [(seen.survey_id, seen.thing.kind) for seen in history] == [(first, "moved")] + [
        (second, told)
    ] * bool(told)
    (row,) = rows(catalog).values()
    shown = (now or before or DESK).bounds
    assert (row.kind, (row.min_x, row.min_y), (row.max_x, row.max_y)) == (kind, shown.min[:2], shown.max[:2])


def test_what_is_told_of_both_sides_is_told_in_one(catalog: Catalog) -> None:
    add_map(catalog)
    visit(catalog, 1, MOVED)
    survey_id = visit(
        catalog, 2, GONE.model_copy(update={"number": 1}), HERE.model_copy(update={"number": 2})
    )
    record, (_, seen) = only(catalog)
    assert record.latest == seen
    assert (seen.thing.number, seen.thing.probability) == (2, 0.7)  # of where it is
    motion = seen.thing.motion
    assert motion is not None
    assert motion.translation == pytest.approx((0, -2.4, 0))
    assert motion.yaw is None  # nobody has compared the two places
    of_survey = catalog.objects.of_survey(SightingFilter(survey_id=survey_id)).items
    assert [(one.thing.kind, one.object_id) for one in of_survey] == [
        ("disappeared", record.object_id),
        ("appeared", record.object_id),
    ]  # as the survey told it


def test_the_turn_of_what_moved_is_kept_where_a_later_visit_tells_one_side(catalog: Catalog) -> None:
    add_map(catalog)
    turned = MOVED.model_copy(update={"motion": Motion(translation=(0, -2.4, 0), yaw=1.5)})
    visit(catalog, 1, turned)
    further = place(7.2, 1, size=(1.6, 0.8, 0.75))
    short_visit(catalog, 2, thing(1, now=further), looked=[NEW_PLACE])
    record, _ = only(catalog)
    motion = record.latest.thing.motion
    assert motion is not None
    assert motion.translation == pytest.approx((0.2, -2.4, 0))
    assert motion.yaw == 1.5


def test_a_survey_that_is_deleted_takes_what_it_alone_told_of_a_move(catalog: Catalog) -> None:
    add_map(catalog)
    first = visit(catalog, 1, MOVED)
    second = short_visit(catalog, 2, HERE, looked=[NEW_PLACE])
    third = short_visit(catalog, 3, GONE, looked=[OLD_PLACE])
    record, history = only(catalog)
    assert [seen.survey_id for seen in history] == [first, second, third]
    object_id = record.object_id
    catalog.surveys.delete(third)
    record, _ = only(catalog)
    assert (record.object_id, record.latest.thing.kind, record.latest.survey_id) == (
        object_id,
        "moved",
        second,
    )
    catalog.surveys.delete(first)  # nobody is left who saw the old place
    record, history = only(catalog)
    assert (record.object_id, record.latest.thing.kind, len(history)) == (object_id, "appeared", 1)


def test_what_changes_of_a_move_is_told_once(catalog: Catalog) -> None:
    """A visit that tells the same two sides apart says nothing new of the kind."""
    add_map(catalog)
    visit(catalog, 1, MOVED)
    wanted = ObjectFilter(map_id="lobby")
    start = catalog.objects.published(wanted, after=FeedCursor(0, 0)).cursor
    visit(catalog, 2, HERE, GONE)
    told = catalog.objects.published(wanted, after=start)
    assert [(one.latest.thing.kind, one.sightings) for one in told.items] == [("moved", 2)]
    assert told.withdrawn == ()


# versions


def test_an_accepted_survey_closes_its_objects_and_they_are_not_gone_again(catalog: Catalog) -> None:
    add_map(catalog)
    visit(catalog, 1, thing(1, now=BOX), thing(2, before=CHAIR))
    accepted = visit(catalog, 2, thing(1, now=BOX))
    add_version(catalog, survey_id=accepted)
    assert told(catalog) == [("appeared", "accepted", 2), ("disappeared", "gone_again", 1)]
    box, chair = rows(catalog).values()
    assert (box.accepted_in_version, chair.accepted_in_version) == (2, None)
    visit(catalog, 3)
    assert told(catalog) == [("appeared", "accepted", 2), ("disappeared", "gone_again", 1)]


def test_what_disappeared_from_a_tile_that_was_not_replaced_goes_on(catalog: Catalog) -> None:
    """Its older points stay in the map, and later surveys miss it still."""
    add_map(catalog)
    taken = tile(*CHAIR_TILE, observed_share=0.9)
    tiles = [taken, *(each for each in LOOKED if each.tile_id != taken.tile_id)]
    objects = [thing(1, before=CHAIR), thing(2, before=DESK_BEFORE)]
    accepted, _ = add_survey(catalog, tiles, objects=objects, moving=0)
    add_version(catalog, survey_id=accepted)
    visit(catalog, 1, thing(1, before=DESK_BEFORE))
    assert sorted(told(catalog)) == [("disappeared", "accepted", 1), ("disappeared", "still_there", 2)]


def test_that_is_known_when_survey_and_version_are_deleted(catalog: Catalog) -> None:
    add_map(catalog)
    visit(catalog, 1, thing(1, now=BOX))
    accepted = visit(catalog, 2, thing(1, now=BOX))
    add_version(catalog, survey_id=accepted)
    add_version(catalog)
    catalog.surveys.delete(accepted)
    catalog.versions.delete("lobby", 2)
    visit(catalog, 3)
    assert told(catalog) == [("appeared", "accepted", 1)]


def test_a_version_that_is_not_built_takes_nothing_over(catalog: Catalog) -> None:
    add_map(catalog)
    survey_id = visit(catalog, 1, thing(1, now=BOX))
    job_id = add_version(catalog, survey_id=survey_id, ready=False)
    assert told(catalog) == [("appeared", "new", 1)]
    catalog.jobs.dismiss(job_id)
    assert told(catalog) == [("appeared", "new", 1)]


def test_an_extended_map_goes_on_with_its_objects(catalog: Catalog) -> None:
    add_map(catalog)
    visit(catalog, 1, thing(1, now=BOX))
    (object_id,) = rows(catalog)
    add_version(catalog)
    visit(catalog, 2, thing(1, now=BOX))
    assert told(catalog) == [("appeared", "still_there", 2)]
    assert list(rows(catalog)) == [object_id]


def test_a_tile_that_was_taken_over_and_changes_again_is_another_change(catalog: Catalog) -> None:
    add_map(catalog)
    accepted, _ = add_survey(catalog, [tile(0, 0), tile(1, 0)], captured_at=NOON)
    add_version(catalog, survey_id=accepted)
    again, _ = add_survey(catalog, [tile(0, 0)], captured_at=NOON + timedelta(days=1))
    with catalog.database.read() as session:
        changes = {(row.survey_id, row.tile_id) for row in session.scalars(select(tables.TileChange))}
    assert changes == {
        (accepted, "tile_000_000_000"),
        (accepted, "tile_001_000_000"),
        (again, "tile_000_000_000"),
    }


# what ended under an earlier release


def test_maps_of_an_earlier_release_are_caught_up_with_once(catalog: Catalog) -> None:
    add_map(catalog)
    add_survey(catalog, [tile(0, 0)])
    with catalog.database.write() as session:
        session.execute(update(tables.Map).values(objects=None))
        session.execute(update(tables.SurveyTile).values(told_by=None))
        session.query(tables.TileChange).delete()
    assert catalog.maps.get("lobby").objects == {}
    history.catch_up(catalog.database)
    with catalog.database.read() as session:
        assert len(session.scalars(select(tables.TileChange)).all()) == 1
        assert session.scalars(select(tables.Map.objects)).all() == [{}]
