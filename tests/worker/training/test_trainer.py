"""Training on a handful of tiles: it learns, it resumes, it keeps to its time."""

from __future__ import annotations

import csv
import threading
from dataclasses import replace

import pytest
import torch

from worker.detectors.siamese.head import PairHead
from worker.errors import Cancelled
from worker.training.dataset import save_tiles
from worker.training.log import LOG
from worker.training.pairs import PairSettings
from worker.training.prefetch import prefetched
from worker.training.settings import PAPER, Schedule, TrainSettings
from worker.training.trainer import BEST, CHECKPOINT, INITIALIZATION_PAIRS, train

TINY = TrainSettings(
    epochs=2, batch=8, train_pairs=48, validation_pairs=16, held_out=0.2, pairs=PairSettings(patch_points=256)
)


def log_of(folder) -> list[dict[str, float]]:
    with (folder / LOG).open() as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def dataset(tiles, tmp_path_factory):
    path = tmp_path_factory.mktemp("tiles") / "tiles.npz"
    save_tiles(tiles, path)
    return path


@pytest.fixture(scope="module")
def trained(dataset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return train(replace(TINY, epochs=4, train_pairs=96), dataset, folder)


def test_the_loss_falls_and_every_epoch_is_logged(trained):
    log = log_of(trained.parent)
    assert [row["epoch"] for row in log] == [1, 2, 3, 4]
    assert log[-1]["train_loss"] < 0.8 * log[0]["train_loss"]
    assert log[-1]["learning_rate"] < 0.1 * log[0]["learning_rate"]


def test_the_best_checkpoint_says_what_it_reached(trained):
    state = torch.load(trained, weights_only=True)
    log = log_of(trained.parent)
    assert trained.name == BEST
    assert state["measured"]["accuracy"] == max(row["accuracy"] for row in log)


def test_a_stopped_training_goes_on_where_it_was(dataset, tmp_path):
    calls = iter(range(10_000))

    def stop_in_the_second_epoch(stage: str, share: float) -> None:
        if next(calls) > TINY.train_pairs // TINY.batch + 1:
            raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        train(TINY, dataset, tmp_path, stop_in_the_second_epoch)
    train(TINY, dataset, tmp_path)
    assert [row["epoch"] for row in log_of(tmp_path)] == [1, 2]


def test_an_epoch_whose_checkpoint_was_lost_is_logged_once(dataset, tmp_path):
    train(replace(TINY, epochs=2, train_pairs=8, validation_pairs=8), dataset, tmp_path)
    state = torch.load(tmp_path / CHECKPOINT, weights_only=True)
    torch.save({**state, "epochs": 1}, tmp_path / CHECKPOINT)  # as if killed between log and checkpoint
    train(replace(TINY, epochs=2, train_pairs=8, validation_pairs=8), dataset, tmp_path)
    assert [row["epoch"] for row in log_of(tmp_path)] == [1, 2]


def test_half_a_row_and_a_first_epoch_without_a_checkpoint_are_forgotten(dataset, tmp_path):
    quick = replace(TINY, epochs=2, train_pairs=8, validation_pairs=8)
    train(replace(quick, epochs=1), dataset, tmp_path)
    (tmp_path / CHECKPOINT).unlink()  # as if killed before it was written
    with (tmp_path / LOG).open("a") as file:
        file.write("1,0.5,")
    train(quick, dataset, tmp_path)
    assert [row["epoch"] for row in log_of(tmp_path)] == [1, 2]


def test_a_checkpoint_from_before_a_setting_was_there_is_taken_up(dataset, tmp_path):
    quick = replace(TINY, epochs=1, train_pairs=8, validation_pairs=8)
    train(quick, dataset, tmp_path)
    state = torch.load(tmp_path / CHECKPOINT, weights_only=True)
    del state["settings"]["initialize_head"], state["settings"]["pairs"]["matched_pairs"]
    torch.save(state, tmp_path / CHECKPOINT)
    assert train(quick, dataset, tmp_path).name == BEST
    with pytest.raises(ValueError, match="other settings"):
        train(replace(quick, initialize_head=False), dataset, tmp_path)


def test_a_checkpoint_of_release_0_1_is_taken_up_under_the_settings_names_of_today(dataset, tmp_path):
    quick = replace(TINY, epochs=1, train_pairs=8, validation_pairs=8)
    train(quick, dataset, tmp_path)
    state = torch.load(tmp_path / CHECKPOINT, weights_only=True)
    settings, pairs = state["settings"], state["settings"]["pairs"]
    settings["settle_head"], pairs["twins"] = settings.pop("initialize_head"), pairs.pop("matched_pairs")
    del settings["detector"]
    torch.save(state, tmp_path / CHECKPOINT)
    assert train(quick, dataset, tmp_path).name == BEST
    assert len(log_of(tmp_path)) == 1


def test_the_head_begins_by_pairs_of_one_place_alone(dataset, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(
        PairHead, "initialize_from_data", lambda _, *inputs: seen.append([len(each) for each in inputs])
    )
    train(replace(TINY, epochs=1, train_pairs=8, validation_pairs=8), dataset, tmp_path)
    different = round(0.15 * INITIALIZATION_PAIRS)
    assert seen == [[INITIALIZATION_PAIRS - different] * 3]


def test_every_epoch_is_announced_once_its_files_are_there(dataset, tmp_path):
    seen = []

    def announced(folder):
        seen.append((len(log_of(folder)), torch.load(folder / CHECKPOINT, weights_only=True)["epochs"]))

    train(replace(TINY, train_pairs=8, validation_pairs=8), dataset, tmp_path, on_epoch=announced)
    assert seen == [(1, 1), (2, 2)]


def test_the_papers_preset_is_section_3_8():
    assert (PAPER.epochs, PAPER.patience, PAPER.batch) == (1000, 100, 16)
    assert (PAPER.train_pairs, PAPER.validation_pairs, PAPER.held_out, PAPER.seed) == (2000, 500, 0.1, 42)
    assert (PAPER.learning_rate, PAPER.final_learning_rate, PAPER.weight_decay) == (1e-3, 1e-5, 1e-4)
    assert (PAPER.initialize_head, PAPER.pairs.matched_pairs) == (False, False)


def test_other_settings_do_not_take_up_a_checkpoint(dataset, tmp_path):
    quick = replace(TINY, epochs=1, train_pairs=8, validation_pairs=8)
    train(quick, dataset, tmp_path)
    assert (tmp_path / CHECKPOINT).exists()
    with pytest.raises(ValueError, match="other settings"):
        train(replace(quick, seed=1), dataset, tmp_path)


def test_a_training_may_start_from_another_ones_network(trained, dataset, tmp_path):
    still = replace(
        TINY,
        epochs=1,
        train_pairs=8,
        validation_pairs=8,
        learning_rate=0.0,
        final_learning_rate=0.0,
        start_from=str(trained),
    )
    before = torch.load(trained, weights_only=True)["network"]
    after = torch.load(train(still, dataset, tmp_path / "path"), weights_only=True)["network"]
    assert torch.equal(after["head.classifier.0.weight"], before["head.classifier.0.weight"])
    named = replace(still, start_from="a model")
    given = torch.load(train(named, dataset, tmp_path / "given", start=before), weights_only=True)["network"]
    assert torch.equal(given["head.classifier.0.weight"], before["head.classifier.0.weight"])


def test_a_run_without_progress_in_accuracy_ends_early(dataset, tmp_path):
    frozen = replace(
        TINY,
        epochs=50,
        patience=2,
        train_pairs=8,
        validation_pairs=8,
        learning_rate=0.0,
        final_learning_rate=0.0,
    )
    train(frozen, dataset, tmp_path)
    assert len(log_of(tmp_path)) < 20


def test_the_rate_follows_whichever_of_epochs_and_minutes_is_nearer_its_end():
    schedule = Schedule(epochs=100, minutes=10)
    assert schedule.done(10, 300) == 0.5  # half the minutes
    assert schedule.done(80, 60) == 0.8  # four fifths of the epochs
    assert schedule.done(3, 6000) == 1.0
    assert schedule.rate(0) == pytest.approx(1e-3)
    assert schedule.rate(0.5) == pytest.approx((1e-3 + 1e-5) / 2)
    assert schedule.rate(1) == pytest.approx(1e-5)


def test_prefetching_keeps_the_order_and_raises_where_the_maker_failed():
    assert list(prefetched(range(20), ahead=2)) == list(range(20))

    def failing():
        yield 1
        raise KeyError("gone")

    with pytest.raises(KeyError, match="gone"):
        list(prefetched(failing()))


def test_leaving_a_prefetched_loop_ends_its_thread():
    before = threading.active_count()
    for item in prefetched(iter(int, 1), ahead=2):  # endless zeros
        assert item == 0
        break
    assert threading.active_count() == before
