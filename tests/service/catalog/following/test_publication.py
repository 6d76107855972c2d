"""What is told: in the transaction of what happened, numbered as it can be seen, with no gap and nothing twice."""

from __future__ import annotations

import random
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path

import pytest
from sqlalchemy import select

from service.catalog.catalog import Catalog, open_catalog
from service.catalog.findings.changes import ChangeFilter
from service.catalog.following.deliveries import Outcome
from service.catalog.following.events import EventFilter, FeedCursor
from service.catalog.following.publication import tell
from service.catalog.records import ChangeRecord, EventRecord, EventType, ObjectRecord, Problem, TileState
from service.catalog.sql.tables import Event, TileChange, now
from service.errors import Gone
from service.settings import Settings
from tests.support.samples import (
    NOON,
    add_map,
    add_scan,
    add_survey,
    add_version,
    place,
    settings_in,
    thing,
    tile,
)
from tests.support.servers import postgresql

READY_TYPES: tuple[EventType, ...] = ("version.ready",)
READY = EventFilter(types=READY_TYPES)
LOBBY = ChangeFilter(map_id="lobby")
BEGINNING = FeedCursor(0, 0)


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.slow)])
def shared(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Settings]:
    """The settings of a catalog on either database."""
    settings = settings_in(tmp_path)
    if request.param == "sqlite":
        yield settings
        return
    with postgresql() as server:
        yield settings.model_copy(update={"database_url": server.database()})


def told(catalog: Catalog, after: int = 0) -> list[EventRecord]:
    return list(catalog.events.after(after, limit=1000).items)


def types(catalog: Catalog, after: int = 0) -> list[str]:
    return [event.type for event in told(catalog, after)]


def test_a_scan_a_map_and_a_survey_are_told_in_their_order(catalog: Catalog) -> None:
    add_map(catalog)
    seen = catalog.events.last()
    assert types(catalog) == ["scan.uploaded", "job.ended", "version.ready"]
    survey_id, job_id = add_survey(
        catalog, [tile(0, 0, "changed", 0.6), tile(1, 0, "changed", 0.9)], captured_at=NOON
    )
    events = told(catalog, seen)
    assert [event.type for event in events] == [
        "scan.uploaded",
        "job.ended",
        "survey.ready",
        "change.told",
        "change.told",
    ]
    assert [event.sequence for event in events] == [4, 5, 6, 7, 8]
    scan, job, survey, surest, other = events
    assert (scan.map_id, job.subject, survey.subject) == (None, job_id, survey_id)
    assert survey.data["counts"]["changed"] == 2
    assert (surest.data["tile_id"], other.data["tile_id"]) == ("tile_001_000_000", "tile_000_000_000")
    assert {event.map_id for event in events[1:]} == {"lobby"}
    assert len({event.event_id for event in events}) == 5


def test_what_is_rolled_back_was_not_told_and_leaves_no_gap(catalog: Catalog) -> None:
    with catalog.database.write() as session:
        tell(session, "scan.deleted", "first")
    with pytest.raises(KeyError), catalog.database.write() as session:
        tell(session, "scan.deleted", "never")
        raise KeyError
    with catalog.database.write() as session:
        tell(session, "scan.deleted", "second")
    assert [(event.sequence, event.subject) for event in told(catalog)] == [(1, "first"), (2, "second")]


def test_a_failed_survey_is_told_with_the_code_of_its_problem(catalog: Catalog) -> None:
    add_map(catalog)
    survey_id, job_id = add_survey(catalog, ready=False)
    seen = catalog.events.last()
    catalog.jobs.fail(job_id, Problem(code="registration_failed", detail="no scan"))
    job, survey = told(catalog, seen)
    assert (job.type, job.data["status"], job.data["problem"]) == (
        "job.ended",
        "failed",
        "registration_failed",
    )
    assert (survey.type, survey.subject) == ("survey.failed", survey_id)
    catalog.jobs.fail(job_id, Problem(code="registration_failed", detail="no scan"))
    assert catalog.events.last() == survey.sequence  # a job ends once


def test_a_page_is_of_the_types_and_maps_that_are_asked_for(catalog: Catalog) -> None:
    add_map(catalog)
    add_map(catalog, "hall")
    add_survey(catalog, [tile(0, 0)], map_id="hall")
    page = catalog.events.after(0, READY, limit=1)
    assert [event.map_id for event in page.items] == ["lobby"]
    page = catalog.events.after(page.cursor, READY, limit=1)
    assert [event.map_id for event in page.items] == ["hall"]
    page = catalog.events.after(page.cursor, READY, limit=1)
    assert (page.items, page.cursor) == (
        (),
        catalog.events.last(),
    )  # the place is kept though nothing was found
    of_hall = catalog.events.after(0, EventFilter(maps=("hall",))).items
    assert {event.type for event in of_hall} == {"job.ended", "version.ready", "survey.ready", "change.told"}


def test_a_cursor_behind_what_was_swept_is_gone_and_no_silent_gap(catalog: Catalog) -> None:
    add_scan(catalog, "first")
    add_scan(catalog, "second")
    with catalog.database.write() as session:
        session.get_one(Event, 1).created -= timedelta(days=40)
        session.get_one(Event, 2).created -= timedelta(days=40)
    add_scan(catalog, "third")
    assert catalog.events.sweep(now() - timedelta(days=30)) == 2
    assert catalog.events.sweep(now() - timedelta(days=30)) == 0
    with pytest.raises(Gone, match="up to 2 are not kept"):
        catalog.events.after(1)
    assert [event.sequence for event in catalog.events.after(2).items] == [3]
    assert [event.sequence for event in catalog.events.after(0).items] == [3]
    with pytest.raises(Gone, match="ahead of the latest"):
        catalog.events.after(4)
    add_scan(catalog, "fourth")
    assert catalog.events.last() == 4  # numbers are not given twice


def test_nothing_is_lost_doubled_or_out_of_order_while_surveys_end_at_once(shared: Settings) -> None:
    """Surveys of four maps end in four threads, for those of one map wait for each other anyway."""
    catalog = open_catalog(shared)
    maps = [f"map-{n}" for n in range(4)]
    jobs: dict[str, list[str]] = {}
    for n, map_id in enumerate(maps):
        add_map(catalog, map_id)
        for day in range(5):
            captured = NOON + timedelta(days=day, minutes=n)
            survey_id, job_id = add_survey(catalog, map_id=map_id, captured_at=captured, ready=False)
            catalog.surveys.save_result(survey_id, tiles=[tile(day, 0), tile(day, 1)], threshold=0.5)
            jobs.setdefault(map_id, []).append(job_id)
    begin = catalog.events.last()
    together, over = threading.Barrier(len(maps) + 1), threading.Event()
    read: list[int] = []
    followed: dict[str, list[str | None]] = {map_id: [] for map_id in maps}

    def end(map_id: str) -> None:
        own = open_catalog(shared, migrate=False)
        together.wait()
        for job_id in jobs[map_id]:
            own.jobs.succeed(job_id)
        own.close()

    def follow() -> None:
        own, cursor = open_catalog(shared, migrate=False), begin
        cursors = dict.fromkeys(maps, BEGINNING)
        together.wait()
        while True:
            last_look = over.is_set()
            page = own.events.after(cursor, limit=3)
            read.extend(event.sequence for event in page.items)
            cursor = page.cursor
            for map_id in maps:
                found = own.changes.published(ChangeFilter(map_id=map_id), after=cursors[map_id], limit=1000)
                followed[map_id] += [change.change_id for change in found.items[found.updated :]]
                cursors[map_id] = found.cursor
            if last_look and not page.items:
                break
        own.close()

    reader = threading.Thread(target=follow)
    writers = [threading.Thread(target=end, args=(map_id,)) for map_id in maps]
    for thread in (reader, *writers):
        thread.start()
    for thread in writers:
        thread.join()
    over.set()
    reader.join()
    last = catalog.events.last()
    assert last - begin == 4 * 5 * 4  # job, survey and two changes of each
    assert read == list(range(begin + 1, last + 1))
    for map_id in maps:
        assert len(followed[map_id]) == len(set(followed[map_id])) == 10
    catalog.close()


# changes in the order of publication


def changes(catalog: Catalog, after: FeedCursor = BEGINNING) -> list[tuple[str, str | None]]:
    found = catalog.changes.published(LOBBY, after=after)
    return [(change.tile.tile_id[5:8], change.change_id) for change in found.items]


def test_a_change_that_stays_over_six_surveys_is_published_once(catalog: Catalog) -> None:
    add_map(catalog)
    cursor, seen = BEGINNING, []
    for day in range(6):
        add_survey(catalog, [tile(0, 0)], captured_at=NOON + timedelta(days=day))
        page = catalog.changes.published(LOBBY, after=cursor)
        seen += [(change.change_id, number < page.updated) for number, change in enumerate(page.items)]
        assert [change.last_seen for change in page.items] == [NOON + timedelta(days=day)]
        cursor = page.cursor
    assert len({change_id for change_id, _ in seen}) == 1
    assert [updated for _, updated in seen] == [False, *[True] * 5]
    assert (types(catalog).count("change.told"), types(catalog).count("change.updated")) == (1, 5)


def delivered(catalog: Catalog, webhook_id: str) -> list[str]:
    """Take what a webhook has to get; its events in short."""
    got = []
    while webhook_id in catalog.deliveries.due():
        task = catalog.deliveries.claim(webhook_id)
        assert task is not None
        assert task.event is not None
        got.append(task.event.type + " only_times" * bool(task.event.data.get("only_times")))
        assert catalog.deliveries.record(task, Outcome(answered=204))
    return got


def test_a_webhook_that_names_no_types_is_not_told_that_all_is_as_it_was(shared: Settings) -> None:
    catalog = open_catalog(shared)
    add_map(catalog)
    named: list[EventType] = ["change.updated", "object.updated"]
    every, some = (
        catalog.webhooks.add("https://a.org", types=types)[0].webhook_id for types in (None, named)
    )
    box = thing(1, now=place(1, 1))
    again = ["change.updated only_times", "object.updated only_times"]

    def after_visit(day: int, score: float, one: ObjectRecord) -> tuple[list[str], list[str]]:
        seen = [tile(0, 0, score=score, observed_share=0.9)]
        add_survey(catalog, seen, captured_at=NOON + timedelta(days=day), objects=[one], moving=0)
        got = delivered(catalog, every)
        return [one for one in got if one.split(".")[0] in ("change", "object")], delivered(catalog, some)

    assert after_visit(1, 0.9, box) == (["change.told", "object.told"], [])
    new_to_still = ["object.updated"]  # its status is `still_there` by now
    assert after_visit(2, 0.901, box) == (new_to_still, [again[0], *new_to_still])
    assert after_visit(3, 0.8, box) == ([], again)
    assert after_visit(4, 0.95, box) == (["change.updated"], ["change.updated", again[1]])
    further = thing(1, now=place(1.2, 1))
    assert after_visit(5, 0.95, further) == (["object.updated"], [again[0], "object.updated"])
    assert after_visit(0, 0.9, box) == (  # late: both were seen first a day earlier
        ["change.updated", "object.updated"],
        ["change.updated", "object.updated"],
    )
    catalog.close()


def test_a_visit_that_is_uploaded_late_is_published_after_the_later_one(catalog: Catalog) -> None:
    add_map(catalog)
    add_survey(catalog, [tile(0, 0)], captured_at=NOON + timedelta(days=5))
    first = catalog.changes.published(LOBBY, after=BEGINNING)
    add_survey(catalog, [tile(0, 0), tile(1, 0)], captured_at=NOON + timedelta(days=4))
    second = catalog.changes.published(LOBBY, after=first.cursor)
    assert second.updated == 1
    assert [change.tile.tile_id for change in second.items] == ["tile_000_000_000", "tile_001_000_000"]
    assert second.items[0].first_seen == NOON + timedelta(days=4)
    third = catalog.changes.published(LOBBY, after=second.cursor)
    assert (third.items, third.withdrawn, third.cursor) == ((), (), second.cursor)


def test_a_change_keeps_its_id_when_the_survey_that_told_it_is_deleted(catalog: Catalog) -> None:
    add_map(catalog)
    first, _ = add_survey(catalog, [tile(0, 0)], captured_at=NOON)
    add_survey(catalog, [tile(0, 0)], captured_at=NOON + timedelta(days=1))
    before = changes(catalog)
    seen = catalog.events.last()
    catalog.surveys.delete(first)
    assert changes(catalog) == before
    assert types(catalog, seen) == ["survey.deleted", "change.updated"]  # first seen on the day after by now


def test_a_change_that_no_survey_sees_any_more_is_withdrawn(catalog: Catalog) -> None:
    add_map(catalog)
    only, _ = add_survey(catalog, [tile(0, 0)], captured_at=NOON)
    page = catalog.changes.published(LOBBY, after=BEGINNING)
    catalog.surveys.delete(only)
    after = catalog.changes.published(LOBBY, after=page.cursor)
    assert [(one.subject, one.merged_into) for one in after.withdrawn] == [(page.items[0].change_id, None)]
    assert (after.items, changes(catalog)) == ((), [])
    assert catalog.changes.published(LOBBY, after=after.cursor).withdrawn == ()


def test_of_two_changes_that_turn_out_to_be_one_the_older_goes_on(catalog: Catalog) -> None:
    add_map(catalog)
    add_survey(catalog, [tile(0, 0)], captured_at=NOON)
    between, _ = add_survey(catalog, [tile(0, 0, "unchanged", 0.1)], captured_at=NOON + timedelta(days=1))
    add_survey(catalog, [tile(0, 0)], captured_at=NOON + timedelta(days=2))
    page = catalog.changes.published(LOBBY, after=BEGINNING)
    older, newer = (change.change_id for change in page.items)
    catalog.surveys.delete(between)
    after = catalog.changes.published(LOBBY, after=page.cursor)
    assert [(one.subject, one.merged_into) for one in after.withdrawn] == [(newer, older)]
    assert ([change.change_id for change in after.items], after.updated) == ([older], 1)
    assert after.items[0].last_seen == NOON + timedelta(days=2)
    assert changes(catalog) == [("000", older)]


def test_a_late_visit_that_parts_a_change_tells_its_other_half_as_new(catalog: Catalog) -> None:
    add_map(catalog)
    for day in (0, 2):
        add_survey(catalog, [tile(0, 0)], captured_at=NOON + timedelta(days=day))
    page = catalog.changes.published(LOBBY, after=BEGINNING)
    (one,) = page.items
    add_survey(catalog, [tile(0, 0, "unchanged", 0.1)], captured_at=NOON + timedelta(days=1))
    rest, half = catalog.changes.published(LOBBY, after=page.cursor).items
    assert (rest.change_id, rest.last_seen) == (one.change_id, NOON)
    assert half.change_id != one.change_id
    assert half.first_seen == NOON + timedelta(days=2)
    assert changes(catalog)[0] == ("000", one.change_id)


def test_a_step_that_runs_again_gives_no_change_another_id(catalog: Catalog) -> None:
    add_map(catalog)
    survey_id, _ = add_survey(catalog, [tile(0, 0), tile(1, 0)], captured_at=NOON)
    before, seen = changes(catalog), catalog.events.last()
    catalog.surveys.save_result(survey_id, tiles=[tile(0, 0), tile(1, 0)], threshold=0.5)
    assert (changes(catalog), types(catalog, seen)) == (before, [])
    catalog.surveys.save_result(survey_id, tiles=[tile(1, 0), tile(2, 0)], threshold=0.5)
    assert types(catalog, seen) == ["change.withdrawn", "change.told"]


def test_pages_from_the_beginning_go_on_though_the_events_were_swept(catalog: Catalog) -> None:
    """Changes stay for as long as their surveys; the log of events does not."""
    add_map(catalog)
    add_survey(catalog, [tile(i, 0) for i in range(5)], captured_at=NOON)
    add_scan(catalog, "after")
    catalog.events.sweep(now() + timedelta(seconds=1))
    cursor, seen = BEGINNING, []
    for _ in range(3):
        page = catalog.changes.published(LOBBY, after=cursor, limit=2)
        seen += [change.change_id for change in page.items]
        cursor = FeedCursor.read(str(page.cursor))
    assert len(set(seen)) == 5
    with pytest.raises(Gone):  # what was withdrawn since is not known any more
        catalog.changes.published(LOBBY, after=FeedCursor(1, 1))


@pytest.mark.parametrize("seed", range(4))
def test_a_list_that_is_followed_is_the_list_that_is_asked_for(catalog: Catalog, seed: int) -> None:
    """Surveys come in any order and go again; readers with small pages, with filters and without, come between."""
    rng = random.Random(seed)
    add_map(catalog)
    wanted = [LOBBY, ChangeFilter(map_id="lobby", min_score=0.8), ChangeFilter(map_id="lobby", until=NOON)]
    readers = [Reader(catalog, one, limit) for one, limit in zip(wanted, (2, 1, 3), strict=True)]
    surveys: list[str] = []
    for _ in range(14):
        if surveys and rng.random() < 0.25:
            catalog.surveys.delete(surveys.pop(rng.randrange(len(surveys))))
        else:
            seen: list[TileState] = ["changed", "changed", "unchanged"]
            states = {i: rng.choice(seen) for i in rng.sample(range(5), 3)}
            tiles = [tile(i, 0, state, score=rng.random()) for i, state in states.items()]
            when = NOON + timedelta(days=rng.randrange(-9, 10))
            surveys.append(add_survey(catalog, tiles, captured_at=when)[0])
        for reader in readers:
            for _ in range(rng.randrange(3)):
                reader.look()
    for reader in readers:
        while reader.look():
            pass
        listed = catalog.changes.page(reader.wanted, limit=100).items
        assert reader.kept == {change.change_id: change for change in listed}


@dataclass
class Reader:
    """Who follows the changes of a map, and keeps a list of them."""

    catalog: Catalog
    wanted: ChangeFilter
    limit: int
    cursor: FeedCursor = BEGINNING
    kept: dict[str | None, ChangeRecord] = field(default_factory=dict)
    new: set[str | None] = field(default_factory=set)  #: told as new so far

    def look(self) -> bool:
        """Take in one page; returns whether there is more."""
        page = self.catalog.changes.published(self.wanted, after=self.cursor, limit=self.limit)
        assert max(len(page.items), len(page.withdrawn)) <= self.limit
        for number, change in enumerate(page.items):
            if number >= page.updated:
                assert change.change_id not in self.new  # as new it is told once
                self.new.add(change.change_id)
            elif self.wanted == LOBBY:
                assert change.change_id in self.new
            self.kept[change.change_id] = change
        for gone in page.withdrawn:
            self.kept.pop(gone.subject, None)
        assert page.more or page.cursor.told == page.cursor.since
        self.cursor = FeedCursor.read(str(page.cursor))
        return page.more


# objects


def test_what_becomes_of_an_object_is_told(catalog: Catalog) -> None:
    looked = [tile(i, j, "unchanged", 0.1, observed_share=0.9) for i in range(3) for j in range(3)]
    box = [thing(1, now=place(1, 1))]

    def visit(day: int, objects: list[ObjectRecord]) -> str:
        when = NOON + timedelta(days=day)
        return add_survey(catalog, looked, captured_at=when, objects=objects, moving=0)[0]

    add_map(catalog)
    visit(1, box)
    visit(2, box)
    visit(3, [])
    last = visit(4, box)
    add_version(catalog, survey_id=last)
    about = [event for event in told(catalog) if event.type.startswith("object.")]
    assert [event.type[7:] for event in about] == ["told", "updated", "gone_again", "seen_again", "accepted"]
    assert len({event.subject for event in about}) == 1


def test_the_row_of_a_change_has_the_number_of_its_event(catalog: Catalog) -> None:
    add_map(catalog)
    add_survey(catalog, [tile(0, 0)], captured_at=NOON)
    with catalog.database.read() as session:
        change = session.scalars(select(TileChange)).one()
        event = session.scalars(select(Event).where(Event.type == "change.told")).one()
    assert (change.published, change.change_id) == (event.sequence, event.subject)
