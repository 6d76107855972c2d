"""The composition of Section 3.5.3."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.worker.training.conftest import HALF
from worker.detectors.spicd_net.training import Batch
from worker.training.anomalies import move_object
from worker.training.augmentation import (
    Augmentation,
    Nuisance,
    augmented,
    replenished,
    second_observation,
    turned_alike,
)
from worker.training.dataset import TileSet
from worker.training.pairs import (
    PAPER_PAIRS,
    Disturbance,
    PairMaker,
    PairSettings,
    changed,
    composition,
    disturbed,
)
from worker.training.settings import TrainSettings

STILL = Augmentation(jitter=0, dropout=0, shift=0, yaw=0)
SAME_OBSERVATION = Nuisance(yaw=0, shift=0, dropout=(0, 0), magnitude=(-0.02, -0.02))  # 0.001 + 0.05 m is 0
PLAIN = PairSettings(
    patch_points=512,
    min_shown=0,
    augmentation=STILL,
    nuisance=SAME_OBSERVATION,
    symmetries=False,
    rerun_share=1.0,
    edited_share=0.0,
    rebuilt_share=0.0,
    beside_share=0.0,
)


def rows(points: np.ndarray) -> set[tuple[float, ...]]:
    return set(map(tuple, points.round(4)))


def test_the_classes_have_their_exact_shares():
    groups = composition(2000, (0.50, 0.35, 0.15))
    assert np.bincount([label for group in groups for label in group]).tolist() == [1000, 700, 300]


def test_every_changed_pair_has_an_unchanged_one_of_its_tile_while_there_are_any():
    assert composition(20, (0.50, 0.35, 0.15)) == [(0, 1)] * 7 + [(0,)] * 3 + [(2,)] * 3
    assert composition(10, (0.2, 0.6, 0.2)) == [(0, 1)] * 2 + [(1,)] * 4 + [(2,)] * 2


def test_the_papers_pairs_are_drawn_one_by_one():
    assert composition(20, (0.50, 0.35, 0.15), matched_pairs=False) == [(0,)] * 10 + [(1,)] * 7 + [(2,)] * 3


def test_the_papers_preset_is_section_3_5():
    preset = PAPER_PAIRS
    assert (preset.shares, preset.rerun_share) == ((0.50, 0.35, 0.15), 0.7)
    assert (preset.magnitude, preset.density) == ((0.10, 0.50), (0.075, 0.075))
    assert (preset.changed_intensity, preset.min_separation) == (0.5, 3.0)
    assert preset.nuisance.dropout == (0.10, 0.50)
    # and nothing of ours
    assert (preset.revisit_share, preset.min_shown, preset.symmetries, preset.matched_pairs) == (
        0.0,
        0,
        False,
        False,
    )
    assert (preset.chamfer_points, preset.stored_still) == (128, False)
    assert (preset.edited_share, preset.rebuilt_share, preset.beside_share) == (0.0, 0.0, 0.0)


def test_the_papers_pairs_are_of_one_dense_tile_seven_in_ten_sampled_anew(tiles):
    preset = replace(PAPER_PAIRS, patch_points=512, augmentation=STILL)
    owner = {len(points): i for i, points in enumerate(tiles.points_a)}
    assert len(owner) < len(tiles)  # tiles are told apart below by their points, not by their number
    maker, anew = PairMaker(tiles, preset), 0
    for seed in range(200):
        pair = maker.pair(0, np.random.default_rng(seed))
        if len(pair.current) < len(
            pair.reference
        ):  # the second observation lost a tenth of its points and more
            anew += 1
        else:
            assert np.abs(pair.current - pair.reference).max() < 6 * 0.0001
    assert 0.6 < anew / 200 < 0.8


def test_the_papers_changed_pairs_lose_half_as_much(tiles):
    preset = replace(
        PAPER_PAIRS, patch_points=512, augmentation=STILL, magnitude=(0.0, 0.0), density=(0.0, 0.0)
    )
    preset = replace(preset, nuisance=replace(preset.nuisance, dropout=(0.4, 0.4)))
    maker = PairMaker(tiles, preset)
    for seed in range(10):
        pair = maker.pair(1, np.random.default_rng(seed))
        lost = 1 - len(pair.current) / len(pair.reference)
        assert lost == pytest.approx(0.2, abs=0.01)  # a point come or gone is the smallest change


def test_in_a_small_place_only_tiles_that_have_another_3_m_away_are_different_ones(tiles):
    row = np.array([0.0, 1.5, 3.0])
    small = replace(
        tiles.subset(np.arange(40) < 3), centres=np.c_[row, 0 * row, 0 * row], buildings=np.zeros(3, np.int32)
    )
    maker = PairMaker(small, PLAIN)
    ends = {frozenset(rows(small.points_a[i])) for i in (0, 2)}
    for seed in range(20):
        pair = maker.pair(2, np.random.default_rng(seed))
        assert {frozenset(rows(pair.reference)), frozenset(rows(pair.current))} == ends


def test_where_no_two_tiles_are_3_m_apart_there_is_no_different_pair(tiles):
    near = replace(tiles.subset(np.arange(40) < 2), buildings=np.zeros(2, np.int32))
    with pytest.raises(ValueError, match=r"no two tiles are 3\.0 m apart"):
        PairMaker(near, PLAIN).pair(2, np.random.default_rng(0))


def test_a_changed_pair_and_its_unchanged_one_look_at_the_same_tile(tiles):
    maker = PairMaker(tiles, replace(PLAIN, shares=(0.5, 0.5, 0.0), revisit_share=1.0))
    first, second = next(maker.batches(2, 2, np.random.default_rng(0)))
    assert sorted([first.label, second.label]) == [0, 1]
    assert rows(first.reference) == rows(second.reference)


def test_a_change_that_would_not_show_is_drawn_again(tiles):
    settings = replace(PLAIN, magnitude=(0.0, 0.4), density=(0.1, 0.1), min_shown=15)
    points = tiles.points_a[0]
    for seed in range(20):
        result = changed(points, settings, HALF, np.random.default_rng(seed), operation=move_object)
        moved = (result != points).any(axis=1)
        gone, come = points[moved], result[moved]
        far = [
            (np.linalg.norm(one[:, None] - other, axis=2).min(axis=1) > 0.075).sum()
            for one, other in ((come, points), (gone, result))
        ]
        assert sum(far) >= 15


def batches(tiles: TileSet, settings: PairSettings, *, count: int) -> list[Batch]:
    """So many pairs, eight at a time, as the network takes them."""
    rng = np.random.default_rng(0)
    network = TrainSettings(pairs=settings).network
    return [network.collate(pairs, rng) for pairs in PairMaker(tiles, settings).batches(count, 8, rng)]


def test_a_batch_holds_both_branches_end_to_end_about_their_centroids(tiles):
    (batch, *rest) = batches(tiles, PairSettings(), count=20)
    assert len(rest) == 1  # 20 pairs are two batches of 8
    assert len(batch.sizes) == 16
    assert sum(batch.sizes) == len(batch.points)
    for cloud in np.split(batch.points, np.cumsum(batch.sizes)[:-1]):
        assert cloud.mean(axis=0) == pytest.approx(0, abs=1e-5)
    assert batch.chamfer_sizes == batch.sizes  # all points are compared, in the frame of the tile
    moved = np.split(batch.chamfer_points - batch.points, np.cumsum(batch.sizes)[:-1])
    assert max(np.ptp(cloud, axis=0).max() for cloud in moved) < 1e-6
    assert max(np.abs(cloud).max() for cloud in moved) > 0.05


def test_the_papers_chamfer_branch_gets_128_points_of_each_patch(tiles):
    batch = batches(tiles, PAPER_PAIRS, count=16)[0]
    assert batch.chamfer_sizes == [128] * 16
    for sample, size in zip(batch.chamfer_points.reshape(16, 128, 3), batch.sizes, strict=True):
        assert len(rows(sample)) > 0.5 * min(size, 128)  # of a padded patch, so a few points come twice


def drawn(maker: PairMaker, label_counts: int, seed: int) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """A changed pair and the unchanged one that matches it, (reference, current) by label."""
    pairs = next(maker.batches(label_counts, label_counts, np.random.default_rng(seed)))
    return {pair.label: (pair.reference, pair.current) for pair in pairs}


def observations_of(tiles: TileSet, *, changed: bool, rebuilt: bool) -> set[frozenset[tuple[float, ...]]]:
    kind = (changed, rebuilt)
    return {
        frozenset(rows(observation.points))
        for observation in tiles.observations
        if (observation.changed, observation.rebuilt) == kind
    }


def test_of_changed_pairs_the_given_share_is_of_whole_things_beside_an_honest_unchanged_pair(tiles):
    settings = replace(PLAIN, shares=(0.5, 0.5, 0.0), edited_share=0.6, revisit_share=1.0)
    maker, found = PairMaker(tiles, settings), 0
    real = observations_of(tiles, changed=True, rebuilt=False)
    assert len(real) == len(tiles) / 4
    for seed in range(100):
        pairs = drawn(maker, 2, seed)
        edited = [frozenset(rows(cloud)) in real for cloud in pairs[1]]
        assert not any(frozenset(rows(cloud)) in real for cloud in pairs[0])
        if any(edited):
            found += 1
            same = [rows(a) == rows(b) for a, b in zip(pairs[0], pairs[1], strict=True)]
            assert sum(same) == 1  # the other observation is that of the unchanged pair
            assert sorted(edited) == [False, True]
    assert 45 < found < 75


def test_of_changed_pairs_the_given_share_is_of_rebuilt_maps_untouched_but_for_the_change(tiles):
    noisy = replace(PLAIN, augmentation=Augmentation(), nuisance=Nuisance())
    settings = replace(noisy, shares=(0.5, 0.5, 0.0), rebuilt_share=0.6, revisit_share=1.0)
    maker, found = PairMaker(tiles, settings), 0
    owner = {
        frozenset(rows(observation.points)): observation
        for observation in tiles.observations
        if observation.rebuilt
    }
    for seed in range(100):
        pairs = drawn(maker, 2, seed)
        observations = {label: owner.get(frozenset(rows(current))) for label, (_, current) in pairs.items()}
        if observations[1] is not None:
            found += 1
            assert observations[0] is not None
            assert (observations[0].changed, observations[1].changed) == (False, True)
            for label, observation in observations.items():
                assert observation is not None
                map_points = tiles.points_a[observation.tile]
                assert rows(pairs[label][0]) == rows(map_points)  # the map is the reference
    assert 45 < found < 75


def test_unchanged_pairs_beside_a_change_are_observations_of_that_visit(tiles):
    maker = PairMaker(tiles, replace(PLAIN, shares=(1.0, 0.0, 0.0), beside_share=0.5, revisit_share=1.0))
    beside = observations_of(tiles, changed=False, rebuilt=False)
    found = sum(
        any(frozenset(rows(cloud)) in beside for cloud in drawn(maker, 1, seed)[0]) for seed in range(100)
    )
    assert 35 < found < 65


def test_a_set_without_further_observations_has_synthetic_changes_alone(tiles):
    bare = replace(tiles, observations=())
    settings = replace(PLAIN, edited_share=0.5, rebuilt_share=0.5, beside_share=1.0, revisit_share=0.0)
    pair = PairMaker(bare, settings).pair(1, np.random.default_rng(0))
    assert rows(pair.reference) != rows(pair.current)


def test_a_stored_patch_comes_back_without_augmentation_and_so_does_a_change_of_one(tiles):
    noise = replace(PLAIN, augmentation=Augmentation(), nuisance=Nuisance())
    maker = PairMaker(tiles, replace(noise, revisit_share=0.0, rerun_share=0.0))
    for seed in range(10):
        same, changed = (maker.pair(label, np.random.default_rng(seed)) for label in (0, 1))
        assert nearest(same.current, same.reference).max() < 6 * 0.0001
        assert frozenset(rows(changed.reference)) in {frozenset(rows(points)) for points in tiles.points_a}
        untouched = nearest(changed.current, changed.reference) < 6 * 0.0001
        assert 0.6 < untouched.mean() < 1 or len(changed.current) < 0.95 * len(changed.reference)


def nearest(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - others, axis=2).min(axis=1)


def test_a_still_pair_that_is_disturbed_has_one_level_on_its_current_points_alone(tiles):
    settings = replace(
        PLAIN,
        rerun_share=0.0,
        revisit_share=0.0,
        rebuilt_share=1.0,
        noisy_share=1.0,
        noise=0.02,
        thinning=0.4,
    )
    maker = PairMaker(tiles, settings)
    suffered, stored = [], {tuple(point) for points in tiles.points_a for point in points.round(4)}
    for seed in range(20):
        observations = maker._observations((1, 0), np.random.default_rng(seed))
        unchanged = maker.pair(0, np.random.default_rng(seed), observations)
        assert rows(unchanged.reference) <= stored
        assert not rows(unchanged.current) & stored
        assert observations.disturbance is not None
        suffered.append(observations.disturbance)
    assert 0 < min(one.noise for one in suffered) < max(one.noise for one in suffered) < 0.02
    assert 4 < sum(one.lost > 0 for one in suffered) < 16
    assert max(one.lost for one in suffered) < 0.4


def test_a_disturbed_cloud_loses_the_share_and_moves_by_the_noise():
    cloud = np.random.default_rng(0).random((1000, 3), dtype=np.float32)
    moved = disturbed(cloud, Disturbance(noise=0.01, lost=0.0), np.random.default_rng(1))
    assert (moved - cloud).std() == pytest.approx(0.01, rel=0.1)
    thinner = disturbed(cloud, Disturbance(noise=0.0, lost=0.3), np.random.default_rng(1))
    assert len(thinner) == 700
    assert rows(thinner) <= rows(cloud)
    assert disturbed(cloud, None, np.random.default_rng(1)) is cloud


def test_no_still_pair_is_disturbed_where_no_share_is_asked_for(tiles):
    maker = PairMaker(tiles, replace(PLAIN, rerun_share=0.0, revisit_share=0.0, rebuilt_share=1.0))
    drawn = [maker._observations((1, 0), np.random.default_rng(seed)) for seed in range(20)]
    assert {observations.disturbance for observations in drawn} == {None}


def test_the_same_stream_gives_the_same_pairs(tiles):
    first, again = (batches(tiles, PairSettings(), count=8)[0] for _ in range(2))
    assert np.array_equal(first.points, again.points)
    assert np.array_equal(first.labels, again.labels)


def test_with_no_nuisance_an_unchanged_pair_of_one_visit_is_the_same_tile(tiles):
    pair = PairMaker(tiles, replace(PLAIN, revisit_share=0.0)).pair(0, np.random.default_rng(0))
    assert rows(pair.reference) == rows(pair.current)


def test_revisits_pair_the_two_observations_of_one_tile(tiles):
    maker = PairMaker(tiles, replace(PLAIN, revisit_share=1.0))
    both = {frozenset((frozenset(rows(a)), frozenset(rows(b)))) for a, b in _visits(tiles)}
    for seed in range(10):
        pair = maker.pair(0, np.random.default_rng(seed))
        assert frozenset((frozenset(rows(pair.reference)), frozenset(rows(pair.current)))) in both


def test_a_changed_pair_differs_by_a_cluster(tiles):
    maker = PairMaker(tiles, replace(PLAIN, revisit_share=0.0))
    for seed in range(10):
        pair = maker.pair(1, np.random.default_rng(seed))
        differing = rows(pair.reference) ^ rows(pair.current)
        share = len(differing) / len(pair.reference)
        assert 0.05 < share < 0.2  # 7.5% gone or come, twice that if moved


def test_different_tiles_are_3_m_apart_or_of_two_buildings(tiles):
    maker = PairMaker(tiles, PLAIN)
    owner = {frozenset(rows(points)): i for i, points in enumerate(tiles.points_a)}
    within = 0
    for seed in range(60):
        pair = maker.pair(2, np.random.default_rng(seed))
        i, j = (owner[frozenset(rows(points))] for points in (pair.reference, pair.current))
        if tiles.buildings[i] == tiles.buildings[j]:
            within += 1
            assert np.linalg.norm(tiles.centres[i] - tiles.centres[j]) >= 3.0
    assert within > 5  # both kinds were drawn
    assert within < 55


def test_a_second_look_loses_points_and_keeps_the_shape_at_half_intensity(tiles):
    reference = tiles.points_a[0]
    nuisance = replace(SAME_OBSERVATION, dropout=(0.5, 0.5))
    for intensity, expected in ((1.0, 0.5), (0.5, 0.75)):
        _, current = second_observation(reference, reference, nuisance, intensity, np.random.default_rng(0))
        assert len(current) == round(expected * len(reference))
        assert rows(current) <= rows(reference)


def test_both_observations_are_turned_and_shifted_together(tiles):
    points = tiles.points_a[0]
    nuisance = replace(SAME_OBSERVATION, yaw=1.0, shift=0.3)
    reference, current = second_observation(points, points, nuisance, 1.0, np.random.default_rng(0))
    assert rows(reference) == rows(current)
    assert np.abs(reference - points).max() > 0.1


def test_replenished_points_lie_beside_points_that_are_left(tiles):
    points = tiles.points_a[0]
    filled = replenished(points, Augmentation(dropout=0.2), np.random.default_rng(0))
    new = filled[(filled != points).any(axis=1)]
    old = filled[(filled == points).all(axis=1)]
    assert len(new) == round(0.2 * len(points))
    distance = np.linalg.norm(new[:, None] - old, axis=2).min(axis=1)
    assert distance.max() < 6 * 0.002


def test_augmentation_of_a_branch_is_small(tiles):
    points = tiles.points_a[0]
    moved = augmented(points, Augmentation(dropout=0), np.random.default_rng(0)) - points
    assert 0.004 < moved.std(axis=0).mean() < 0.03


def test_symmetries_keep_the_tile_and_the_distances(tiles):
    a, b = tiles.points_a[0], tiles.points_a[1]
    count = min(len(a), len(b))
    seen = set()
    for seed in range(40):
        turned_a, turned_b = turned_alike(a, b, np.random.default_rng(seed))
        apart = np.linalg.norm(turned_a[:count] - turned_b[:count], axis=1)
        assert apart == pytest.approx(np.linalg.norm(a[:count] - b[:count], axis=1), abs=1e-6)
        assert (np.abs(turned_a) <= [0.75, 0.75, 0.5]).all()
        seen.add(tuple(turned_a[0].round(5)))
    assert len(seen) == 8


def _visits(tiles: TileSet) -> list[tuple[np.ndarray, np.ndarray]]:
    return list(zip(tiles.points_a, tiles.points_b, strict=True))
