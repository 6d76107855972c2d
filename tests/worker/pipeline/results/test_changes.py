from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.support.rooms import scores_of
from tests.support.tilings import four_states, row_of
from worker.detectors.detector import Detection
from worker.pipeline.results.changes import ChangeSet, TileState, decide
from worker.pipeline.results.objects import ChangeObjects

NAN = (float("nan"),) * 3


def _states(*rows: tuple[float, float, float], threshold: float, observed: list[bool]) -> list[TileState]:
    pairs = row_of([600] * len(rows), [600] * len(rows), observed=observed)
    return [TileState(s) for s in decide(pairs, scores_of(*rows), threshold=threshold).states]


def _state(*row: float, threshold: float = 0.5, observed: bool = True) -> TileState:
    no_change, change, other = row
    return _states((no_change, change, other), threshold=threshold, observed=[observed])[0]


@pytest.mark.parametrize(
    ("score", "state"),
    [(0.375, TileState.UNCHANGED), (0.5, TileState.UNCHANGED), (0.625, TileState.CHANGED)],
)
def test_a_tile_is_changed_above_the_threshold_and_not_at_it(score: float, state: TileState) -> None:
    assert _state(1 - score, score, 0.0, threshold=0.5) is state


def test_the_threshold_decides_and_not_the_larger_class() -> None:
    assert _state(0.75, 0.25, 0.0, threshold=0.125) is TileState.CHANGED
    assert _state(0.25, 0.75, 0.0, threshold=0.875) is TileState.UNCHANGED


def test_a_tile_of_another_place_is_inconsistent_below_the_threshold() -> None:
    assert _state(0.25, 0.25, 0.5, threshold=0.875) is TileState.INCONSISTENT


def test_a_tile_of_another_place_is_changed_above_the_threshold() -> None:
    assert _state(0.0, 0.375, 0.625, threshold=0.75) is TileState.CHANGED


def test_what_counts_is_that_the_tile_is_not_as_it_was_as_another_thing_or_as_another_place() -> None:
    changes = decide(row_of([600], [600], observed=[True]), scores_of((0.25, 0.375, 0.375)), threshold=0.5)
    assert changes.scores.tolist() == [0.75]
    assert TileState(changes.states[0]) is TileState.CHANGED


@pytest.mark.parametrize("row", [NAN, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)])
def test_an_unobserved_tile_is_unobserved_whatever_it_scored(row: tuple[float, float, float]) -> None:
    assert _state(*row, threshold=0.0, observed=False) is TileState.UNOBSERVED


def test_what_a_detector_says_of_an_unobserved_tile_is_dropped() -> None:
    pairs = row_of([600] * 2, [600] * 2, observed=[False, True])
    changes = decide(pairs, scores_of((0.0, 1.0, 0.0), (1.0, 0.0, 0.0)), threshold=0.5)
    assert np.isnan(changes.probabilities[0]).all()
    assert changes.probabilities[1].tolist() == [1.0, 0.0, 0.0]
    assert changes.probabilities.dtype == np.float32


def test_nan_for_an_observed_tile_is_never_taken_for_no_change() -> None:
    with pytest.raises(ValueError, match="1 of 1 observed tiles"):
        _state(*NAN, observed=True)


def test_a_threshold_of_1_is_never_passed() -> None:
    assert _state(0.0, 1.0, 0.0, threshold=1.0) is TileState.UNCHANGED


def test_each_tile_gets_its_own_state() -> None:
    rows = [(0.0, 1.0, 0.0), NAN, (1.0, 0.0, 0.0), (0.25, 0.25, 0.5)]
    found = _states(*rows, threshold=0.875, observed=[True, False, True, True])
    assert found == [TileState.CHANGED, TileState.UNOBSERVED, TileState.UNCHANGED, TileState.INCONSISTENT]


def test_counts_name_every_state_and_add_up_to_the_tiles() -> None:
    pairs = row_of([600] * 3, [600] * 3, observed=[True, True, False])
    changes = decide(pairs, scores_of((1, 0, 0), (1, 0, 0), NAN), threshold=0.5)
    assert changes.counts() == {"unchanged": 2, "changed": 0, "inconsistent": 0, "unobserved": 1}


def test_a_map_of_no_tile_has_no_state() -> None:
    nothing = Detection(probabilities=np.empty((0, 3), np.float32))
    counts = decide(row_of([], [], observed=[]), nothing, threshold=0.5).counts()
    assert counts == {"unchanged": 0, "changed": 0, "inconsistent": 0, "unobserved": 0}


def _by_voxels(
    *rows: tuple[float, float, float], shares: list[float], threshold: float = 0.5, least: float = 0.5
) -> ChangeSet:
    """Decide on tiles of a detector of voxels, of which none has enough points."""
    count = len(rows)
    detection = Detection(
        probabilities=np.array(rows, np.float32),
        observed_share=np.array(shares, np.float32),
        appeared=np.arange(count, dtype=np.int32),
        disappeared=np.arange(count, dtype=np.int32) * 2,
    )
    pairs = row_of([3] * count, [3] * count, observed=[False] * count)
    return decide(pairs, detection, threshold=threshold, min_observed_share=least)


def test_with_voxels_a_tile_is_unobserved_by_the_share_that_could_be_judged() -> None:
    quiet = (0.9, 0.1, 0.0)
    changes = _by_voxels(quiet, quiet, quiet, shares=[0.49, 0.5, 1.0])
    assert [TileState(state).label for state in changes.states] == ["unobserved", "unchanged", "unchanged"]
    changes = _by_voxels(quiet, quiet, shares=[0.1, 0.3], least=0.2)
    assert [TileState(state).label for state in changes.states] == ["unobserved", "unchanged"]


def test_with_voxels_what_changed_has_changed_however_little_was_seen() -> None:
    changes = _by_voxels((0.1, 0.9, 0.0), (0.5, 0.5, 0.0), shares=[0.0, 0.01])
    assert [TileState(state).label for state in changes.states] == ["changed", "unobserved"]


def test_with_voxels_probabilities_stay_where_anything_could_be_judged() -> None:
    changes = _by_voxels((0.9, 0.1, 0.0), NAN, shares=[0.1, 0.0])
    assert changes.scores[0] == pytest.approx(0.1)
    assert np.isnan(changes.scores[1])
    assert [TileState(state).label for state in changes.states] == ["unobserved"] * 2


def test_with_voxels_a_tile_without_a_score_is_unobserved_even_if_no_share_is_asked_for() -> None:
    assert TileState(_by_voxels(NAN, shares=[0.0], least=0.0).states[0]) is TileState.UNOBSERVED


def test_with_voxels_no_tile_is_inconsistent() -> None:
    states = _by_voxels((0.2, 0.2, 0.6), shares=[1.0], threshold=0.9).states
    assert TileState(states[0]) is TileState.UNCHANGED


def test_with_voxels_nan_for_a_tile_that_could_be_judged_is_never_taken_for_no_change() -> None:
    with pytest.raises(ValueError, match="1 of 2 observed tiles"):
        _by_voxels(NAN, (1.0, 0.0, 0.0), shares=[0.2, 0.2])


def test_with_voxels_shares_and_counts_go_on() -> None:
    changes = _by_voxels((0.9, 0.1, 0.0), (0.1, 0.9, 0.0), shares=[0.25, 0.75])
    assert changes.observed_share is not None
    assert changes.appeared is not None
    assert changes.disappeared is not None
    assert changes.observed_share.tolist() == [0.25, 0.75]
    assert changes.appeared.tolist() == [0, 1]
    assert changes.disappeared.tolist() == [0, 2]


def test_with_objects_a_tile_that_none_lies_in_is_not_changed() -> None:
    """Two loud tiles of which one was hardly looked at, no object; without objects they stay changed."""
    loud = (0.1, 0.9, 0.0)
    changes = _by_voxels(loud, loud, shares=[1.0, 0.2])
    nothing = ChangeObjects(
        objects=(),
        moving=0,
        voxel_size=0.05,
        keys=np.empty(0, np.int64),
        now=np.empty(0, np.int32),
        before=np.empty(0, np.int32),
    )
    with_objects = replace(changes, objects=nothing).where_objects_lie(0.5)
    assert [TileState(state).label for state in with_objects.states] == ["unchanged", "unobserved"]
    without = changes.where_objects_lie(0.5)
    assert [TileState(state).label for state in without.states] == ["changed", "changed"]


def test_in_doubt_every_tile_that_was_looked_at_is_inconsistent_and_keeps_its_score() -> None:
    changes = four_states()
    doubted = changes.in_doubt(0.71)
    assert [TileState(state).label for state in doubted.states] == ["inconsistent"] * 3 + ["unobserved"]
    assert doubted.scores.tolist()[:3] == changes.scores.tolist()[:3]
    assert (doubted.doubtful_placement, changes.doubtful_placement) == (0.71, None)
    assert changes.counts()["unchanged"] == 1


def test_in_doubt_there_are_no_objects() -> None:
    loud = (0.1, 0.9, 0.0)
    nothing = ChangeObjects(
        objects=(),
        moving=3,
        voxel_size=0.05,
        keys=np.empty(0, np.int64),
        now=np.empty(0, np.int32),
        before=np.empty(0, np.int32),
    )
    doubted = replace(_by_voxels(loud, loud, shares=[1.0, 0.2]), objects=nothing).in_doubt(0.5)
    assert (doubted.objects, doubted.voxels) == (None, None)
    assert doubted.counts() == {"unchanged": 0, "changed": 0, "inconsistent": 2, "unobserved": 0}
