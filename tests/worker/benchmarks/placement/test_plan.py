"""Which places and surveys are planned, and from which seeds."""

from __future__ import annotations

from collections import Counter

import pytest

from worker.benchmarks.placement.plan import (
    FIRST_SEED,
    KINDS,
    PlacementSettings,
    kinds_named,
    plan_sites,
    trials,
)

SETTINGS = PlacementSettings()


def test_the_default_run_has_at_least_three_hundred_impostors_and_every_kind():
    planned = trials(SETTINGS, "figures")
    assert sum(trial.impostor for trial in planned) >= 300
    assert {trial.kind for trial in planned} == set(KINDS)
    assert len({trial.name for trial in planned}) == len(planned)
    priors = Counter(trial.prior for trial in planned if trial.impostor)
    assert priors[True] == priors[False]


def test_parts_share_no_seed_of_a_place_or_trial():
    seeds = {
        part: {seed for trial in trials(SETTINGS, part) for seed in (trial.seed, trial.site.seed)}
        for part in FIRST_SEED
    }
    assert not seeds["calibration"] & seeds["validation"]
    assert not seeds["calibration"] & seeds["figures"]
    assert not seeds["validation"] & seeds["figures"]
    assert min(map(min, seeds.values())) == 2_100_000
    assert max(seeds["figures"]) < 2_700_000


def test_trials_of_one_part_have_a_seed_each():
    planned = trials(SETTINGS, "calibration")
    seeds = {trial.seed for trial in planned}
    assert len(seeds) == len(planned)
    assert not seeds & {site.seed for site in plan_sites(SETTINGS, "calibration")}


def test_a_trial_is_the_same_whatever_is_asked_for_beside_it():
    everything = set(trials(SETTINGS, "figures"))
    assert set(trials(SETTINGS, "figures", only=("twin", "scaled"))) <= everything
    few = trials(SETTINGS, "figures", most=2)
    assert set(few) <= everything
    assert set(Counter(trial.row for trial in few).values()) == {2}
    assert {trial.row for trial in few} == {trial.row for trial in everything}
    fewer_sites = SETTINGS.with_values(sites=3)
    assert set(trials(fewer_sites, "figures")) <= everything
    assert fewer_sites.fingerprint == SETTINGS.fingerprint


def test_maps_made_otherwise_lie_elsewhere():
    assert SETTINGS.with_values(standing_s=1.0).fingerprint != SETTINGS.fingerprint


def test_limits_of_placement_leave_the_maps_and_make_the_answers_others():
    stricter = SETTINGS.pipeline.with_values(
        placement=SETTINGS.pipeline.placement.with_values(min_confidence=0.8)
    )
    settings = SETTINGS.with_values(pipeline=stricter)
    assert settings.fingerprint == SETTINGS.fingerprint
    assert settings.survey_fingerprint != SETTINGS.survey_fingerprint


def test_right_scans_of_places_that_repeat_have_a_row_of_their_own():
    rows = {trial.row for trial in trials(SETTINGS, "figures", only=("right",)) if trial.site.repeats}
    assert rows == {"right, hotel corridor", "right, hotel corridor, prior"}


def test_mirrored_rooms_of_a_hotel_have_a_row_of_their_own():
    planned = trials(SETTINGS, "figures", only=("hotel",))
    assert {trial.row.removesuffix(", prior") for trial in planned} == {
        "hotel room, mirrored",
        "hotel room, same plan",
        "hotel corridor",
    }
    mirrored = [trial for trial in planned if "mirrored" in trial.row]
    assert all(trial.other_number % 2 for trial in mirrored)


def test_kinds_are_named_with_commas():
    assert kinds_named("twin, mixed-1+1") == ("twin", "mixed-1+1")
    with pytest.raises(ValueError, match="no kind of trial foreign; there are right"):
        kinds_named("foreign")


def test_all_impostors_are_drawn_whatever_the_limit_of_a_row() -> None:
    settings = PlacementSettings(sites=4)
    few = trials(settings, "validation", most=1, all_impostors=True)
    everything = trials(settings, "validation")
    assert [trial for trial in few if trial.impostor] == [trial for trial in everything if trial.impostor]
    others = [trial.row for trial in few if not trial.impostor]
    assert len(others) == len(set(others))


def test_trials_without_reasons_are_laid_on_the_same_maps() -> None:
    settings = PlacementSettings()
    assert settings.without_reasons().fingerprint == settings.fingerprint
    assert settings.without_reasons().survey_fingerprint != settings.survey_fingerprint
