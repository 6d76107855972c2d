"""Both detectors by voxels on a simulated room, in which a box came, one went, and one could not be seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support.visits import compared, seen_by, swapped
from worker.cloud.seen import Seen
from worker.cloud.tiling import Tiles
from worker.cloud.voxel_keys import Keys, rows_of
from worker.detectors.card import MODEL_STORE, Card
from worker.detectors.comparison import Comparison
from worker.detectors.detector import Detection, Detector, VoxelScores
from worker.detectors.store import make_detector, open_detector
from worker.detectors.voxel_net.detector import BLIND, SEEING, VoxelNet, VoxelNetSettings
from worker.detectors.voxels.evidence import Evidence, EvidenceSettings, gathered, missing
from worker.pipeline.results.objects import ObjectSettings, regions_of
from worker.simulation.scenes import Scene, random_room
from worker.simulation.scenes.mesh import box
from worker.simulation.visits import visit

SEED = 11
OLD, NEW = (0.5, 0.4, 0.6), (0.4, 0.6, 0.5)  # metres, of the box that goes and of the one that comes


def place_for(scene: Scene, size: tuple[float, float, float], seed: int) -> np.ndarray:
    """Return a free place on the floor, x and y."""
    rng = np.random.default_rng(seed)
    room = scene.rooms[0]
    for _ in range(500):
        place = rng.uniform(np.array(room.low) + 0.6, np.array(room.high) - 0.6)
        mesh = box(*size).at(float(place[0]), float(place[1]))
        if scene.is_free(mesh.bounds + np.array([[-0.3, -0.3, 0], [0.3, 0.3, 0]])):
            return place
    raise AssertionError("no place")


class Story:
    """The room as both visits found it."""

    def __init__(self) -> None:
        scene = random_room(SEED)
        self.gone = place_for(scene, OLD, 1)
        before, _ = scene.with_added("old", box(*OLD).at(*self.gone))
        self.came = place_for(before, NEW, 2)
        after, _ = scene.with_added("new", box(*NEW).at(*self.came))
        self.first = seen_by(visit(before, 5, seed=1))
        self.second = seen_by(visit(after, 4, seed=2))
        self.again = seen_by(visit(before, 4, seed=3))
        self.crowd = visit(before, 4, seed=3, people=2)
        self.peopled = seen_by(self.crowd)


@pytest.fixture(scope="module")
def story() -> Story:
    return Story()


def within(points: np.ndarray, place: np.ndarray, size: tuple[float, float, float]) -> np.ndarray:
    half = np.array([*size[:2], 2 * size[2]]) / 2 + 0.08
    return (np.abs(points - [*place, 0]) < half).all(axis=1)


def rule(**settings: object) -> Detector:
    card = open_detector(MODEL_STORE, "voxel-rule/1").card
    return make_detector(card.model_copy(update={"detector_settings": settings}), None)


def untrained() -> VoxelNet:
    torch.manual_seed(3)
    card = open_detector(MODEL_STORE, "voxel-rule/1").card.model_copy(
        update={"detector": "voxel-net", "detector_settings": {}}
    )
    return VoxelNet(card, {name: VoxelNetSettings().build() for name in (SEEING, BLIND)}, torch.device("cpu"))


def scores(detector: Detector, comparison: Comparison) -> tuple[Detection, VoxelScores]:
    detection = detector.detect(comparison)
    assert detection.voxels is not None
    return detection, detection.voxels


def found(
    seen: Seen, voxels: VoxelScores, p: np.ndarray, place: np.ndarray, size: tuple[float, ...]
) -> float:
    """Return the share of the voxels that a visit hit on a box, off the floor, which have P over 0.5."""
    chosen = within(seen.points, place, (size[0], size[1], size[2])) & (seen.points[:, 2] > 0.1)
    assert chosen.sum() > 100
    return float((p[rows_of(seen.keys[chosen], voxels.keys)] > 0.5).mean())


def test_the_rule_finds_what_came_and_what_went_and_nothing_else(story: Story) -> None:
    detection, voxels = scores(rule(), compared(story.first, story.second))
    assert found(story.first, voxels, voxels.disappeared, story.gone, OLD) > 0.8
    assert found(story.second, voxels, voxels.appeared, story.came, NEW) > 0.8
    for p, seen, place, size in (
        (voxels.disappeared, story.first, story.gone, OLD),
        (voxels.appeared, story.second, story.came, NEW),
    ):
        changed = rows_of(voxels.keys[p > 0.5], seen.keys)
        assert within(seen.points[changed], place, size).mean() > 0.95
    assert detection.appeared is not None
    assert detection.appeared.sum() == (voxels.appeared > 0.5).sum()


def test_a_visit_in_which_nothing_changed_is_quiet(story: Story) -> None:
    detection, voxels = scores(rule(), compared(story.first, story.again))
    assert (voxels.appeared > 0.5).sum() + (voxels.disappeared > 0.5).sum() < 10
    assert np.nanmax(detection.change) < 0.5


def test_the_map_against_one_of_its_own_scans_is_quiet(story: Story) -> None:
    own = seen_by(visit(random_room(SEED), 5, seed=1)[:1])
    whole = seen_by(visit(random_room(SEED), 5, seed=1))
    _, voxels = scores(rule(), compared(whole, own))
    assert (voxels.appeared > 0.5).sum() + (voxels.disappeared > 0.5).sum() == 0


def test_people_who_walk_by_are_no_change_but_told_as_moving(story: Story) -> None:
    _, quiet = scores(rule(), compared(story.first, story.again))
    _, voxels = scores(rule(), compared(story.first, story.peopled))
    assert voxels.moving.sum() > 100 > quiet.moving.sum()
    assert not (voxels.moving & (voxels.appeared > 0.5)).any()


@pytest.mark.parametrize("scans", [4, 1])
def test_who_walked_past_makes_neither_a_region_nor_a_tile_also_in_a_survey_of_one_scan(
    story: Story, scans: int
) -> None:
    """Every scan saw people, and past them what is behind; in one scan no other tells that they were gone."""
    peopled = seen_by(story.crowd[:scans])
    detection, voxels = scores(rule(), compared(story.first, peopled))
    assert voxels.moving.sum() > 100
    assert regions_of(voxels, voxels.appeared, ObjectSettings()) == []
    assert not (detection.change > 0.5).any()


def test_a_tile_that_the_survey_did_not_look_at_is_not_called_unchanged(story: Story) -> None:
    one = seen_by(visit(random_room(SEED), 4, seed=3)[:1])
    detection, _ = scores(rule(), compared(story.first, one))
    share = detection.observed_share
    assert share is not None
    assert (share < 0.3).any()
    assert (share > 0.7).any()
    whole, _ = scores(rule(), compared(story.first, story.again))
    assert whole.observed_share is not None
    assert whole.observed_share.mean() > share.mean()


@pytest.mark.parametrize("make", [rule, untrained])
def test_to_swap_map_and_survey_swaps_appeared_and_disappeared_exactly(story: Story, make: object) -> None:
    detector = make()  # type: ignore[operator]
    comparison = compared(story.first, story.second)
    _, there = scores(detector, comparison)
    _, back = scores(detector, swapped(comparison))
    assert there.appeared.max() > 0
    assert np.array_equal(there.appeared, back.disappeared)
    assert np.array_equal(there.disappeared, back.appeared)
    assert np.array_equal(there.judged, back.judged)


@pytest.mark.parametrize("make", [rule, untrained])
def test_the_gate_is_shut_where_the_other_visit_could_not_judge(story: Story, make: object) -> None:
    one = seen_by(visit(random_room(SEED), 4, seed=3)[:1])
    _, voxels = scores(make(), compared(story.first, one))  # type: ignore[operator]
    assert (~voxels.judged).sum() > 1000
    assert voxels.disappeared[~voxels.judged].max() == 0
    assert voxels.appeared[~voxels.judged].max() == 0


def test_probabilities_stand_only_where_the_visit_in_question_hit(story: Story) -> None:
    _, voxels = scores(untrained(), compared(story.first, story.second))
    assert set(voxels.keys[voxels.appeared > 0]) <= set(story.second.keys)
    assert set(voxels.keys[voxels.disappeared > 0]) <= set(story.first.keys)


def test_clouds_without_a_sensors_place_go_without_free_space(story: Story) -> None:
    first, second = (replace(seen, sights=None) for seen in (story.first, story.second))
    _, by_rule = scores(rule(), compared(first, second))
    assert (
        by_rule.appeared.max() == by_rule.disappeared.max() == 0
    )  # nothing proves that something is missing
    net = untrained()
    asked = dict.fromkeys((SEEING, BLIND), 0)
    for name, network in net._networks.items():
        network.register_forward_hook(lambda *_, name=name: asked.update({name: asked[name] + 1}))
    scores(net, compared(first, second))
    assert (asked[SEEING], asked[BLIND]) == (0, 2)
    scores(net, compared(story.first, story.second))
    assert (asked[SEEING], asked[BLIND]) == (2, 2)


def test_sights_of_one_visit_alone_count_for_nothing(story: Story) -> None:
    """A phone's walk beside a scan, or two walks of which one looks like a scan."""
    detector = open_detector(MODEL_STORE, "voxel-net/1")
    walks = tuple(replace(seen, sights=None) for seen in (story.first, story.second))
    _, expected = scores(detector, compared(*walks))
    assert expected.appeared.max() > 0.5
    for pair in ((walks[0], story.second), (story.first, walks[1])):
        _, told = scores(detector, compared(*pair))
        assert np.array_equal(told.appeared, expected.appeared)
        assert np.array_equal(told.disappeared, expected.disappeared)
        assert np.array_equal(told.moving, expected.moving)


def test_a_visit_that_saw_nothing_gives_an_answer_of_nothing(story: Story) -> None:
    nothing = Seen.of([], voxel_size=0.05)
    comparison = compared(story.first, story.second)
    empty = replace(comparison, current=replace(comparison.current, seen=nothing))
    detection, voxels = scores(rule(), empty)
    assert not voxels.judged.any()
    assert np.isnan(detection.change).all()


def test_without_what_was_seen_there_is_no_answer(story: Story) -> None:
    comparison = compared(story.first, story.second)
    blank = replace(comparison, reference=replace(comparison.reference, seen=None))
    with pytest.raises(ValueError, match="what both visits saw"):
        rule().detect(blank)


def test_candidates_are_hit_by_one_and_seen_through_by_the_other(story: Story) -> None:
    settings = EvidenceSettings()
    lacks = missing(story.first, story.second, settings)
    rows = rows_of(lacks.candidates, story.first.keys)
    assert (rows >= 0).all()
    assert (rows_of(lacks.candidates, story.second.keys) < 0).all()
    assert (lacks.seen_through[rows] > 0).all()
    assert lacks.judged[rows].all()
    evidence = gathered(story.first, story.second, lacks.candidates, settings)
    assert evidence.channels.shape == (len(evidence.keys), 12)
    assert evidence.candidate.sum() == len(lacks.candidates)
    assert (evidence.other.through[evidence.candidate] > 0).all()


def test_the_reference_needs_no_encoding(story: Story) -> None:
    comparison = compared(story.first, story.second)
    tiles: Tiles = comparison.tile_pairs.reference
    assert rule().encode_reference(comparison.reference, tiles) == {}
    assert untrained().encode_reference(comparison.reference, tiles) == {}


def test_a_network_comes_back_from_its_weights(story: Story) -> None:
    net = untrained()
    back = VoxelNet.load(net.card, net.weights(), torch.device("cpu"))
    comparison = compared(story.first, story.second)
    assert np.array_equal(scores(net, comparison)[1].appeared, scores(back, comparison)[1].appeared)
    broken = {name: value for name, value in net.weights().items() if not name.startswith(BLIND)}
    with pytest.raises(RuntimeError):
        VoxelNet.load(net.card, broken, torch.device("cpu"))


def test_unsound_settings_are_named() -> None:
    card: Card = open_detector(MODEL_STORE, "voxel-rule/1").card
    with pytest.raises(ValueError, match="min_region"):
        card.model_copy(update={"detector_settings": {"min_region": 0}}).settings_as(rule().settings_class)  # type: ignore[attr-defined]


def test_a_region_that_was_hardly_surely_seen_through_is_no_proof(
    story: Story, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unsure(own: Seen, other: Seen, candidates: Keys, settings: EvidenceSettings) -> Evidence:
        evidence = gathered(own, other, candidates, settings)
        nowhere = np.zeros(len(evidence.keys), np.int16)
        return replace(evidence, other=replace(evidence.other, surely=nowhere))

    comparison = compared(story.first, story.second)
    detector = rule(min_sure_share=0.0)  # its own limit is off
    assert (scores(detector, comparison)[1].disappeared > 0.5).sum() > 100
    monkeypatch.setattr("worker.detectors.voxels.scores.gathered", unsure)
    assert (scores(detector, comparison)[1].disappeared > 0.5).sum() == 0
