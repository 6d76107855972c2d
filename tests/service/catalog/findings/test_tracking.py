"""Objects over time, of plain values: which sightings are one thing, and what became of it."""

from __future__ import annotations

import itertools
import math
import random
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import timedelta

import pytest

from service.catalog.findings.tracking import (
    MIN_REACH,
    Accepted,
    Part,
    Parts,
    Sighting,
    Track,
    Verdict,
    Visit,
    comes_and_goes,
    difference,
    track_objects,
)
from tests.support.samples import NOON

CHAIR, DESK, DOOR = (0.5, 0.5, 0.9), (1.6, 0.8, 0.75), (0.9, 0.1, 2.0)
EVERYWHERE = {"hall": 1.0, "office": 1.0}


def part(
    x: float, y: float, size: tuple[float, float, float] = CHAIR, tile: str = "hall", yaw: float = 0
) -> Part:
    return Part(center=(x, y, size[2] / 2), size=size, yaw=yaw, tiles=(tile,))


def came(x: float, y: float, size: tuple[float, float, float] = CHAIR, tile: str = "hall") -> Parts:
    return {"now": part(x, y, size, tile)}


def went(x: float, y: float, size: tuple[float, float, float] = CHAIR, tile: str = "hall") -> Parts:
    return {"before": part(x, y, size, tile)}


def moved(before: Parts, now: Parts) -> Parts:
    return {**before, **now}


def visit(
    day: int,
    *seen: Parts,
    version: int = 1,
    observed: Mapping[str, float] = EVERYWHERE,
    ids: Mapping[int, str] | None = None,
) -> Visit:
    """The visit of a day; `ids` are those that its sightings had, by number from 1."""
    return Visit(
        survey_id=f"survey-{day}",
        captured_at=NOON + timedelta(days=day),
        map_version=version,
        sightings=tuple(
            Sighting(number=n, parts=parts, object_id=(ids or {}).get(n)) for n, parts in enumerate(seen, 1)
        ),
        observed=observed,
    )


def days(track: Track) -> list[int]:
    """The days on which it was seen."""
    return [(seen.captured_at - NOON).days for seen, _ in track.sightings]


def told(tracks: Sequence[Track]) -> list[tuple[list[int], str, bool]]:
    return [(days(track), track.status, track.transient) for track in tracks]


def with_ids(visits: Sequence[Visit], tracks: Sequence[Track]) -> tuple[list[Visit], list[str]]:
    """The visits as the database has them after these tracks were written, and the ids from old to new."""
    ids = {
        (seen.survey_id, one.number): track.object_id or f"object-{n}"
        for n, track in enumerate(tracks)
        for seen, one in track.sightings
    }
    again = [
        Visit(
            survey_id=one.survey_id,
            captured_at=one.captured_at,
            map_version=one.map_version,
            sightings=tuple(
                Sighting(number=s.number, parts=s.parts, object_id=ids[one.survey_id, s.number])
                for s in one.sightings
            ),
            observed=one.observed,
        )
        for one in visits
    ]
    return again, sorted(set(ids.values()))


# the story of three visits: a desk is moved, a chair is taken, a box is brought and taken back


DESK_MOVED = moved(went(1, 1, DESK), came(1, 4, DESK))
CHAIR_TAKEN = went(5, 1)
BOX_BROUGHT = came(7, 7, (0.6, 0.4, 0.4))


def test_three_visits_tell_what_stays_what_is_new_and_what_is_gone_again() -> None:
    first = visit(1, DESK_MOVED, BOX_BROUGHT)
    second = visit(2, DESK_MOVED, CHAIR_TAKEN, BOX_BROUGHT)
    third = visit(3, CHAIR_TAKEN, DESK_MOVED)
    tracks = track_objects([first, second, third])
    assert told(tracks) == [
        ([1, 2, 3], "still_there", False),
        ([1, 2], "gone_again", False),
        ([2, 3], "still_there", False),
    ]
    assert told(track_objects([first, second]))[2] == ([2], "new", False)


def test_a_thing_that_is_brought_back_to_its_place_is_gone_again() -> None:
    tracks = track_objects([visit(1, DESK_MOVED), visit(2, CHAIR_TAKEN), visit(3, CHAIR_TAKEN)])
    assert told(tracks) == [([1], "gone_again", False), ([2, 3], "still_there", False)]
    assert tracks[0].last_looked == NOON + timedelta(days=3)


def test_the_order_in_which_visits_end_does_not_matter() -> None:
    visits = [visit(1, DESK_MOVED, BOX_BROUGHT), visit(2, DESK_MOVED, CHAIR_TAKEN), visit(3, CHAIR_TAKEN)]
    expected = told(track_objects(visits))
    for order in itertools.permutations(visits):
        assert told(track_objects(order)) == expected


def test_visits_of_one_instant_are_taken_by_id() -> None:
    twice = [visit(1, came(1, 1)), visit(1, came(1, 1))]
    twice[1] = Visit(
        survey_id="survey-0",
        captured_at=twice[0].captured_at,
        map_version=1,
        sightings=twice[0].sightings,
        observed=EVERYWHERE,
    )
    for order in (twice, twice[::-1]):
        (track,) = track_objects(order)
        assert [seen.survey_id for seen, _ in track.sightings] == ["survey-0", "survey-1"]
        assert track.status == "still_there"


# ids


def test_a_second_computation_gives_the_same_ids() -> None:
    visits = [visit(1, DESK_MOVED, BOX_BROUGHT), visit(2, DESK_MOVED, CHAIR_TAKEN), visit(3, CHAIR_TAKEN)]
    tracks = track_objects(visits)
    assert [track.object_id for track in tracks] == [None] * 3
    again, ids = with_ids(visits, tracks)
    assert [track.object_id for track in track_objects(again, ids=ids)] == [
        "object-0",
        "object-1",
        "object-2",
    ]


def test_a_new_object_has_no_id_yet_and_the_others_keep_theirs() -> None:
    before = visit(1, CHAIR_TAKEN, ids={1: "object-a"})
    tracks = track_objects([before, visit(2, CHAIR_TAKEN, BOX_BROUGHT)], ids=["object-a"])
    assert [track.object_id for track in tracks] == ["object-a", None]


def test_a_late_visit_of_an_earlier_day_joins_the_object_and_not_the_other_way_round() -> None:
    known = visit(5, CHAIR_TAKEN, ids={1: "object-a"})
    (track,) = track_objects([known, visit(2, CHAIR_TAKEN)], ids=["object-a"])
    assert (track.object_id, days(track)) == ("object-a", [2, 5])


def test_two_objects_that_turn_out_to_be_one_keep_the_older_id() -> None:
    drift = [visit(1, came(0, 0), ids={1: "object-b"}), visit(3, came(0.5, 0), ids={1: "object-a"})]
    assert len(track_objects(drift, ids=["object-b", "object-a"])) == 2
    between = visit(2, came(0.25, 0))
    (track,) = track_objects([*drift, between], ids=["object-b", "object-a"])
    assert track.object_id == "object-b"


def test_an_object_that_turns_out_to_be_two_leaves_its_id_where_it_was_seen_most() -> None:
    one_id = {1: "object-a"}
    apart = [
        visit(1, came(0, 0), ids=one_id),
        visit(2, came(5, 5), ids=one_id),
        visit(3, came(5, 5), ids=one_id),
    ]
    assert [track.object_id for track in track_objects(apart, ids=["object-a"])] == [None, "object-a"]


# one thing that moved, told as two


def test_what_came_and_what_went_become_one_object_once_they_are_told_as_moved() -> None:
    as_two = visit(1, went(1, 1, DESK), came(1, 4, DESK), ids={1: "object-a", 2: "object-b"})
    as_one = visit(2, DESK_MOVED)
    (track,) = track_objects([as_two, as_one], ids=["object-a", "object-b"])
    assert (track.object_id, track.status, track.visits) == ("object-a", "still_there", 2)


def test_what_moved_and_is_later_told_as_two_stays_one_object() -> None:
    (track,) = track_objects([visit(1, DESK_MOVED), visit(2, came(1, 4, DESK), went(1, 1, DESK))])
    assert (days(track), track.status, track.visits) == ([1, 2, 2], "still_there", 2)


def test_a_desk_that_moves_on_is_still_the_desk_that_left_its_place() -> None:
    further = moved(went(1, 1, DESK), came(6, 4, DESK))
    (track,) = track_objects([visit(1, DESK_MOVED), visit(2, further), visit(3, came(6, 4, DESK))])
    assert (days(track), track.status) == ([1, 2, 3], "still_there")


def test_two_chairs_whose_pairs_are_swapped_stay_two_objects() -> None:
    first = visit(1, moved(went(0, 0), came(5, 0)), moved(went(0, 3), came(5, 3)))
    second = visit(2, moved(went(0, 0), came(5, 3)), moved(went(0, 3), came(5, 0)))
    assert [track.status for track in track_objects([first, second])] == ["still_there"] * 2


# which sides of what moved stand


OLD, NEW = {"office": 1.0}, {"hall": 1.0}  # tiles that a visit looked at
DESK_ACROSS = moved(went(1, 1, DESK, "office"), came(1, 4, DESK, "hall"))
DESK_HERE, DESK_GONE = came(1, 4, DESK, "hall"), went(1, 1, DESK, "office")


@pytest.mark.parametrize(
    ("seen", "observed", "sides"),
    [
        ([DESK_HERE], NEW, "both"),  # the old place was not looked at
        ([DESK_HERE], EVERYWHERE, "now"),  # there stands something as in the map again
        ([DESK_GONE], OLD, "both"),
        ([DESK_GONE], EVERYWHERE, "before"),  # it was taken away from its new place
        ([DESK_HERE, DESK_GONE], EVERYWHERE, "both"),
        ([DESK_GONE, DESK_HERE], {}, "both"),
        ([DESK_ACROSS], EVERYWHERE, "both"),
        ([], {}, "both"),
        ([], OLD, "both"),
        ([], NEW, "both"),
        ([], EVERYWHERE, "both"),  # gone again: that is what it was
    ],
)
def test_what_was_not_looked_at_still_stands(
    seen: Sequence[Parts], observed: Mapping[str, float], sides: str
) -> None:
    visits = [visit(1, DESK_ACROSS), visit(2, *seen, observed=observed)]
    for order in (visits, visits[::-1]):
        (track,) = track_objects(order)
        assert track.sides == ({"now", "before"} if sides == "both" else {sides})
        assert track.visits == 1 + bool(seen)


def test_a_side_that_was_found_as_in_the_map_stays_so_where_nobody_looks() -> None:
    visits = [visit(1, DESK_ACROSS), visit(2, observed=OLD), visit(3, DESK_HERE, observed=NEW)]
    (track,) = track_objects(visits)
    assert track.sides == {"now"}
    (track,) = track_objects([*visits, visit(4, DESK_ACROSS)])
    assert track.sides == {"now", "before"}


def test_what_moved_is_gone_again_where_two_visits_looked_at_a_place_each() -> None:
    visits = [visit(1, DESK_ACROSS), visit(2, observed=OLD), visit(3, observed=NEW)]
    assert [track_objects(visits[:n])[0].status for n in (2, 3)] == ["unknown", "gone_again"]
    (track,) = track_objects([*visits, visit(4, observed=OLD)])  # the new place was not looked at
    assert (track.status, track.last_known) == ("unknown", "gone_again")


def test_what_came_is_gone_again_without_a_look_at_the_place_that_is_as_in_the_map() -> None:
    visits = [visit(1, DESK_ACROSS), visit(2, DESK_HERE), visit(3, observed=NEW)]
    (track,) = track_objects(visits)
    assert track.status == "gone_again"
    assert track.sides == {"now"}


def test_a_side_that_a_version_took_over_does_not_stand_against_it() -> None:
    """The version has the desk in its new place, and its points in the old one too: those were not replaced."""
    taken = [Accepted(version=2, parts=(DESK_HERE,))]
    visits = [visit(1, DESK_ACROSS), visit(2, DESK_GONE, version=2, observed=OLD)]
    (track,) = track_objects(visits, taken)
    assert days(track) == [1, 2]
    assert track.sides == {"before"}


@pytest.mark.parametrize("swapped", [False, True])
def test_a_thing_does_not_stand_in_two_places_at_once(swapped: bool) -> None:
    """The desk is where it was moved to, and another one is told to have come from its old place."""
    other = moved(went(1, 1, DESK), came(6, 4, DESK))
    seen = [other, came(1, 4, DESK)]
    visits = [visit(1, DESK_MOVED), visit(2, *(seen[::-1] if swapped else seen)), visit(3, DESK_MOVED)]
    first, second = track_objects(visits)
    assert (days(first), days(second)) == ([1, 2, 3], [2])
    assert [one.parts.keys() for _, one in first.sightings][1] == {"now"}


# side by side, and alike or not


def test_two_alike_objects_side_by_side_stay_two() -> None:
    pair = [came(1, 1), came(1.5, 1)]
    tracks = track_objects([visit(1, *pair), visit(2, *pair[::-1]), visit(3, pair[1])])
    assert told(tracks) == [([1, 2], "gone_again", False), ([1, 2, 3], "still_there", False)]


def test_of_two_alike_objects_each_takes_the_nearer_sighting() -> None:
    first = visit(1, came(0, 0, DESK), came(0, 0.9, DESK))
    second = visit(2, came(0, 1.0, DESK), came(0, 0.1, DESK))
    tracks = track_objects([first, second])
    assert [[one.number for _, one in track.sightings] for track in tracks] == [[1, 2], [2, 1]]


@pytest.mark.parametrize(
    ("a", "b", "alike"),
    [
        (part(0, 0), part(0.29, 0), True),
        (part(0, 0), part(0.31, 0), False),
        (part(0, 0, DESK), part(0.79, 0, DESK), True),  # along the desk, half of it
        (part(0, 0, DESK), part(0, 0.79, DESK), False),  # across it, half of its depth
        (part(0, 0, DESK, yaw=math.pi / 2), part(0, 0.79, DESK, yaw=math.pi / 2), True),
        (part(0, 0, (0.8, 1.6, 0.75)), part(0.3, 0, DESK), True),  # the same box, turned by a right angle
        (part(0, 0), part(0, 0, (1.0, 0.5, 0.9)), True),  # seen from one side
        (part(0, 0), part(0, 0, (1.6, 0.5, 0.9)), False),
        (part(0, 0), part(0, 0, (0.5, 0.5, 2.4)), False),
        (part(0, 0, (0.05, 0.05, 0.05)), part(0, 0, (0.15, 0.15, 0.15)), True),  # a few voxels
    ],
)
def test_parts_are_alike_that_lie_in_each_other_and_are_of_like_size(a: Part, b: Part, alike: bool) -> None:
    assert (difference(a, b) is not None) == alike
    assert difference(a, b) == difference(b, a)


def test_a_lamp_over_a_chair_is_another_thing() -> None:
    lamp = Part(center=(0, 0, 2.5), size=CHAIR, yaw=0, tiles=("hall",))
    assert difference(part(0, 0), lamp) is None
    near = Part(center=(0, 0, part(0, 0).center[2] + MIN_REACH), size=CHAIR, yaw=0, tiles=("hall",))
    assert difference(part(0, 0), near) is not None


def test_a_thing_that_comes_where_another_left_is_another_object() -> None:
    tracks = track_objects([visit(1, went(1, 1)), visit(2, went(1, 1), came(1, 1))])
    assert [days(track) for track in tracks] == [[1, 2], [2]]


# who looked, and who did not


def test_where_the_latest_visit_did_not_look_nobody_knows() -> None:
    tracks = track_objects(
        [visit(1, came(1, 1)), visit(2, came(1, 1)), visit(3, observed={"hall": 0.49}), visit(4, observed={})]
    )
    (track,) = tracks
    assert (track.status, track.last_known) == ("unknown", "still_there")
    assert track.last_looked == NOON + timedelta(days=2)


def test_half_of_the_tiles_is_a_look() -> None:
    (track,) = track_objects([visit(1, came(1, 1)), visit(2, observed={"hall": 0.5})])
    assert track.status == "gone_again"


def test_a_tile_that_a_visit_does_not_have_counts_as_not_observed() -> None:
    spread = Part(center=(1.5, 1, 0.4), size=DESK, yaw=0, tiles=("hall", "office"))
    for observed, status in (({"hall": 0.99}, "unknown"), ({"hall": 0.99, "office": 0.02}, "gone_again")):
        (track,) = track_objects([visit(1, {"now": spread}), visit(2, observed=observed)])
        assert track.status == status


def test_what_moved_is_gone_again_only_where_both_places_were_looked_at() -> None:
    desk = moved(went(1, 1, DESK, "office"), came(1, 4, DESK, "hall"))
    for observed, status in (({"hall": 1.0}, "unknown"), (EVERYWHERE, "gone_again")):
        (track,) = track_objects([visit(1, desk), visit(2, observed=observed)])
        assert track.status == status


def test_what_is_found_again_after_a_gap_in_looking_was_never_gone() -> None:
    (track,) = track_objects([visit(1, came(1, 1)), visit(2, observed={}), visit(3, came(1, 1))])
    assert (days(track), track.status, track.transient) == ([1, 3], "still_there", False)


def test_visits_before_the_first_sighting_have_no_say() -> None:
    (track,) = track_objects([visit(1), visit(2, came(1, 1))])
    assert (track.status, track.last_looked) == ("new", NOON + timedelta(days=2))


# what comes and goes


def test_a_door_that_is_open_closed_and_open_comes_and_goes() -> None:
    opened = went(3, 0, DOOR)
    visits = [visit(1, opened), visit(2), visit(3, opened)]
    assert told(track_objects(visits)) == [([1, 3], "still_there", True)]
    assert told(track_objects([*visits, visit(4)])) == [([1, 3], "gone_again", True)]


@pytest.mark.parametrize(
    ("looks", "transient"),
    [
        ("s", False),
        ("ss", False),
        ("sg", False),  # a change that was undone
        ("sggg", False),
        ("sgs", True),
        ("sgsg", True),
        ("sgss", True),
        ("sgsss", False),  # it has settled
        ("sgsssg", False),  # and is gone: undone again
        ("sgsssgs", True),
        ("sgsgggg", True),
    ],
)
def test_transient_is_what_came_back_and_has_not_settled(looks: str, transient: bool) -> None:
    names: dict[str, Verdict] = {"s": "seen", "g": "gone"}
    assert comes_and_goes([names[look] for look in looks]) == transient


# what a version of the map took over


def test_what_a_version_took_over_has_not_gone_again() -> None:
    visits = [visit(1, BOX_BROUGHT), visit(2, BOX_BROUGHT, CHAIR_TAKEN), visit(3, version=2)]
    (box, chair) = track_objects(visits, [Accepted(version=2, parts=(BOX_BROUGHT, CHAIR_TAKEN))])
    for track in (box, chair):
        assert (track.status, track.accepted_in_version, track.transient) == ("accepted", 2, False)
    assert box.last_looked == NOON + timedelta(days=2)  # the third visit asked a map that has it


def test_that_holds_when_the_survey_that_was_taken_over_is_deleted() -> None:
    (box,) = track_objects(
        [visit(1, BOX_BROUGHT), visit(3, version=2)], [Accepted(version=2, parts=(BOX_BROUGHT,))]
    )
    assert (days(box), box.status, box.accepted_in_version) == ([1], "accepted", 2)


def test_what_was_gone_when_a_version_took_a_survey_over_stays_gone_again() -> None:
    visits = [visit(1, BOX_BROUGHT), visit(2, CHAIR_TAKEN), visit(3, version=2)]
    (box, chair) = track_objects(visits, [Accepted(version=2, parts=(CHAIR_TAKEN,))])
    assert (box.status, box.accepted_in_version) == ("gone_again", None)
    assert chair.status == "accepted"


def test_an_extended_version_goes_on_with_the_same_objects() -> None:
    visits = [visit(1, BOX_BROUGHT), visit(2, BOX_BROUGHT, version=2), visit(3, version=3)]
    assert told(track_objects(visits)) == [([1, 2], "gone_again", False)]


def test_what_is_found_against_a_map_that_has_the_thing_is_another_object() -> None:
    taken = [
        Accepted(version=2, parts=(BOX_BROUGHT,)),
        Accepted(version=3, parts=(went(7, 7, (0.6, 0.4, 0.4)),)),
    ]
    removed = went(7, 7, (0.6, 0.4, 0.4))
    visits = [
        visit(1, BOX_BROUGHT),
        visit(2, removed, version=2),
        visit(3, removed, version=2),
        visit(4, BOX_BROUGHT, version=3),
    ]
    tracks = track_objects(visits, taken)
    assert [(days(track), track.status, track.accepted_in_version) for track in tracks] == [
        ([1], "accepted", 2),
        ([2, 3], "accepted", 3),
        ([4], "new", None),
    ]


def test_a_late_visit_against_the_old_map_joins_the_object_that_was_taken_over() -> None:
    """It was captured before the survey that was accepted, or after; it ran against the version before."""
    taken = [Accepted(version=2, parts=(BOX_BROUGHT,))]
    for late in (1, 4):
        visits = [visit(2, BOX_BROUGHT), visit(3, version=2), visit(late, BOX_BROUGHT)]
        (box,) = track_objects(visits, taken)
        assert (days(box), box.status) == (sorted([late, 2]), "accepted")


def test_a_visit_of_before_the_acceptance_compared_with_the_new_map_is_no_look() -> None:
    taken = [Accepted(version=2, parts=(BOX_BROUGHT,))]
    (box,) = track_objects([visit(1, BOX_BROUGHT), visit(2, version=2), visit(3, BOX_BROUGHT)], taken)
    assert (days(box), box.status, box.transient) == ([1, 3], "accepted", False)


# whatever comes


def random_visits(seed: int) -> list[Visit]:
    """Twelve visits of a hall with nine places for chairs, some of which come, go, move or are not looked at."""
    drawn = random.Random(seed)
    visits = []
    for day in range(12):
        places = [
            (2.0 * i + drawn.gauss(0, 0.05), 2.0 * j + drawn.gauss(0, 0.05))
            for i in range(3)
            for j in range(3)
        ]
        taken = drawn.sample(places, 6)
        seen = [moved(went(*taken[0]), came(*taken[1])), went(*taken[2]), *(came(*at) for at in taken[3:])]
        shown = drawn.sample(seen, drawn.randint(0, 4))
        observed = {"hall": drawn.choice([0.2, 0.9])}
        visits.append(visit(day, *shown, version=1 + day // 5, observed=observed))
    return visits


def gathered(tracks: Sequence[Track]) -> list[list[tuple[str, int]]]:
    return [[(seen.survey_id, one.number) for seen, one in track.sightings] for track in tracks]


@pytest.mark.parametrize("seed", range(20))
def test_every_sighting_is_of_one_object_and_every_object_has_one_id(seed: int) -> None:
    visits, drawn = random_visits(seed), random.Random(seed)
    accepted = [Accepted(version=2, parts=tuple(one.parts for one in visits[4].sightings))]
    expected = track_objects(visits, accepted)
    sightings = [(seen.survey_id, one.number) for seen in visits for one in seen.sightings]
    assert sorted(itertools.chain(*gathered(expected))) == sorted(sightings)
    known: list[Visit] = []
    ids: list[str] = []
    for arriving in drawn.sample(visits, len(visits)):  # in any order, named as the database would
        tracks = track_objects([*known, arriving], accepted, ids=ids)
        given = [track.object_id or f"{arriving.survey_id}-{n}" for n, track in enumerate(tracks)]
        assert len(set(given)) == len(given)
        named = [replace(track, object_id=one) for track, one in zip(tracks, given, strict=True)]
        known, _ = with_ids([*known, arriving], named)
        ids += [one for one in given if one not in ids]
    again = track_objects(known, accepted, ids=ids)
    assert told(again) == told(expected)
    assert gathered(again) == gathered(expected)
    assert all(track.object_id for track in again)
    for track in expected:
        told_sides = Counter((seen.survey_id, side) for seen, one in track.sightings for side in one.parts)
        assert max(told_sides.values()) == 1


def test_no_visits_have_no_objects() -> None:
    assert track_objects([]) == ()
    assert track_objects([visit(1), visit(2)]) == ()
