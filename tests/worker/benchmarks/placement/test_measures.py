"""Rates with their intervals, what the targets speak of, and the curves, on answers that are put in."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.support.placement import ROOM
from worker.benchmarks.placement.answers import ScanAnswer, TrialAnswer, Verdict
from worker.benchmarks.placement.measures import (
    Answered,
    document,
    error_curve,
    figures,
    reliability,
    targets,
    wilson,
)
from worker.benchmarks.placement.plan import Kind, SitePlan, Trial


def scan(verdict: Verdict, *, here: bool = True, reason: str | None = None) -> ScanAnswer:
    accepted = verdict in ("right", "wrong", "in doubt")
    off = {"right": 0.01, "wrong": 3.0, "in doubt": 0.05}.get(verdict) if here else None
    return ScanAnswer(
        verdict=verdict,
        here=here,
        accepted=accepted,
        metres=off,
        degrees=None if off is None else 0.1,
        reason=reason,
    )


def answered(
    kind: Kind,
    *scans: ScanAnswer,
    confidence: float | None = None,
    in_doubt: bool = False,
    amount: float = 0.0,
    site: SitePlan = ROOM,
    prior: bool = False,
) -> Answered:
    trial = Trial(site=site, number=1, kind=kind, scans=len(scans), amount=amount, prior=prior)
    answer = TrialAnswer(name=trial.name, scans=scans, seconds=1.0, confidence=confidence, in_doubt=in_doubt)
    return Answered(trial=trial, answer=answer)


def test_wilsons_interval_of_known_counts():
    assert wilson(0, 300) == pytest.approx((0.0, 0.01264), abs=1e-4)
    assert wilson(5, 10) == pytest.approx((0.2366, 0.7634), abs=1e-4)
    assert wilson(0, 0) == (0.0, 1.0)


def test_a_row_counts_each_verdict_of_all_its_scans():
    row = figures(
        [
            answered("mixed-1+1", scan("right"), scan("wrong", here=False)),
            answered("mixed-1+1", scan("refused"), scan("refused", here=False, reason="other_place")),
            answered("mixed-1+1", scan("ambiguous"), scan("in doubt", here=False)),
        ]
    )
    assert (row["surveys"], row["scans"], row["here"]) == (3, 6, 3)
    counts = [row[verdict] for verdict in ("right", "wrong", "in_doubt", "ambiguous", "refused")]
    assert counts == [1, 1, 1, 1, 2]
    assert row["wrong_rate"]["rate"] == pytest.approx(1 / 6)
    assert row["right_rate"]["rate"] == pytest.approx(1 / 3)
    assert (row["reasons"], row["named"]) == ({"other_place": 1}, 1)
    assert row["centimetres"]["median"] == pytest.approx(1.0)


def test_targets_count_impostors_by_survey_and_right_scans_up_to_a_quarter_changed():
    stranger = scan("wrong", here=False)
    counted = targets(
        [
            answered("twin", stranger, stranger),
            answered("other", scan("refused", here=False)),
            answered("hotel", scan("in doubt", here=False), in_doubt=True),
            answered("mirrored", stranger),
            answered("scaled", scan("right"), amount=0.99),
            answered("scaled", scan("refused", here=False), amount=1.02),
            answered("right", scan("right"), amount=0.25),
            answered("right", scan("ambiguous"), amount=0.1),
            answered("right", scan("refused"), amount=0.4),
            answered("right", scan("refused"), site=SitePlan(kind="hotel-corridor", seed=1)),
        ]
    )
    assert [counted["impostors_believed"][key] for key in ("count", "of")] == [1, 3]
    assert [counted["believed_of_other_plans"][key] for key in ("count", "of")] == [1, 3]
    assert [counted["mirrored_or_scaled_believed"][key] for key in ("count", "of")] == [1, 2]
    assert [counted["right_lost"][key] for key in ("count", "of")] == [1, 2]
    assert counted["right_within_3_cm"] == {"of": 1, "count": 1}


def test_hotel_rooms_of_the_same_plan_are_counted_and_left_out_beside():
    hotel = SitePlan(kind="hotel-room", seed=1)
    believed = scan("wrong", here=False)
    pair = [answered("hotel", believed, site=hotel), answered("twin", scan("refused", here=False))]
    same = Answered(trial=replace(pair[0].trial, number=3), answer=pair[0].answer)
    assert same.trial.same_plan
    counted = targets([same, pair[1]])
    assert [counted["impostors_believed"][key] for key in ("count", "of")] == [1, 2]
    assert [counted["believed_of_other_plans"][key] for key in ("count", "of")] == [0, 1]


def test_reliability_holds_stated_confidence_against_how_often_it_was_right():
    sure = [answered("right", scan("right"), confidence=0.95) for _ in range(3)]
    sure.append(answered("twin", scan("wrong", here=False), confidence=0.95))
    low = answered("twin", scan("in doubt", here=False), confidence=0.12, in_doubt=True)
    refused = answered("twin", scan("refused", here=False), confidence=0.0)
    rows = reliability([*sure, low, refused])
    assert [(row["surveys"], row["right"]) for row in rows] == [(1, 0), (4, 3)]
    assert rows[1]["confidence"] == pytest.approx(0.95)
    assert rows[1]["rate"] == pytest.approx(0.75)


def test_the_error_curve_falls_for_impostors_and_rises_for_right_scans():
    curve = error_curve(
        [
            answered("twin", scan("wrong", here=False), confidence=0.45),
            answered("twin", scan("refused", here=False)),
            answered("right", scan("right"), confidence=0.95),
            answered("right", scan("right"), confidence=0.65),
            answered("right", scan("wrong"), confidence=0.95, amount=0.4),
        ],
        steps=11,
    )
    assert curve["believed"] == [0.5] * 5 + [0.0] * 6
    assert curve["lost"]["0%"] == [0.0] * 7 + [0.5] * 3 + [1.0]
    assert curve["lost"]["40%"] == [1.0] * 11


def test_rows_stand_in_the_order_of_the_kinds():
    rows = document(
        [
            answered("twin", scan("refused", here=False)),
            answered("right", scan("right"), amount=0.1),
            answered("right", scan("right")),
            answered("twin", scan("refused", here=False), prior=True),
        ]
    )["rows"]
    assert [row["name"] for row in rows] == ["right 0% changed", "right 10% changed", "twin", "twin, prior"]
