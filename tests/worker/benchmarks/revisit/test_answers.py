"""What methods say of tiles, put to the tiles of the table."""

from __future__ import annotations

import numpy as np
import pytest

from worker.benchmarks.methods import RevisitMethod
from worker.benchmarks.revisit.answers import answers_of, tile_scores_of
from worker.benchmarks.revisit.plan import RevisitSettings, plan_visits
from worker.benchmarks.revisit.visits import path_of
from worker.cloud import npz
from worker.cloud.voxel_keys import near
from worker.detectors.comparison import Comparison
from worker.detectors.detector import Detection, VoxelScores
from worker.pipeline.settings import PipelineSettings
from worker.simulation.hits import Visit


def test_scores_go_to_the_tiles_they_are_of_and_the_others_have_none():
    tiles = np.array([[0, 0, 0], [1, 0, 0], [-1, 2, 0], [5, 5, 5]], np.int32)
    told = np.array([[-1, 2, 0], [7, 7, 7], [0, 0, 0]], np.int32)
    scores = tile_scores_of(tiles, told, np.array([0.3, 0.9, 0.5]))
    assert scores.tolist() == pytest.approx([0.5, np.nan, 0.3, np.nan], nan_ok=True)


def by_voxels(comparison: Comparison) -> Detection:
    """A method that calls changed whatever only one side hit, four voxels or more from what the other hit."""
    first, second = comparison.reference.seen, comparison.current.seen
    assert first is not None
    assert second is not None
    keys = np.union1d(first.keys, second.keys)
    come, gone = ~near(keys, first.keys, 3), ~near(keys, second.keys, 3)
    count = len(comparison.tiles)
    return Detection(
        probabilities=np.tile(np.array([0.25, 0.75, 0.0], np.float32), (count, 1)),
        voxels=VoxelScores(
            keys=keys,
            appeared=np.where(come, 0.9, 0).astype(np.float32),
            disappeared=np.where(gone, 0.9, 0).astype(np.float32),
            judged=np.ones(len(keys), bool),
            moving=np.zeros(len(keys), bool),
            seen_through=np.ones(len(keys), np.int16),
        ),
    )


def test_a_method_by_voxels_is_given_all_tiles_and_makes_objects(made_visit, made_site, upright, tmp_path):
    (plan,) = plan_visits(1, RevisitSettings(kinds=("room",)), first_seed=1)
    npz.save(path_of(plan.site.name, tmp_path), made_site(plan.site.name, tiles=3, gone=[upright(0, 120)]))
    changes = [(upright(0, 120), "remove", Visit.FIRST, True), (upright(2, 30), "add", Visit.SECOND, True)]
    visit = made_visit(plan.name, tiles=3, changes=changes)
    pipeline = PipelineSettings()
    method = RevisitMethod(name="voxels", detect=by_voxels, tiles="touched")
    (answer,) = answers_of(method, [plan], [visit], tmp_path, pipeline).visits
    assert answer.scores.tolist() == [0.75] * 3
    assert answer.objects is not None
    assert sorted((thing.kind, len(thing.before), len(thing.now)) for thing in answer.objects) == [
        ("appeared", 0, 30),
        ("disappeared", 120, 0),
    ]
    assert answer.reliability is not None
    assert answer.reliability.changed.sum() == 150


def test_a_method_by_points_has_scores_of_dense_tiles_alone(made_visit, made_site, upright, tmp_path):
    (plan,) = plan_visits(1, RevisitSettings(kinds=("room",)), first_seed=1)
    npz.save(path_of(plan.site.name, tmp_path), made_site(plan.site.name, tiles=3, gone=[upright(1, 60)]))
    visit = made_visit(plan.name, tiles=3, changes=[(upright(1, 60), "remove", Visit.FIRST, True)])
    method = RevisitMethod(
        name="points",
        detect=lambda comparison: Detection.of_scores(np.ones(len(comparison.tiles))),
        min_points=30,
    )
    (answer,) = answers_of(method, [plan], [visit], tmp_path, PipelineSettings()).visits
    assert answer.scores.tolist() == pytest.approx([np.nan, 1.0, np.nan], nan_ok=True)
    assert answer.objects is None
