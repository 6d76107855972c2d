"""The report has every picture that can be drawn, and a line for each that cannot."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.detectors import CountingDetector
from tests.worker.benchmarks.paper.test_experiments import ONE
from worker.benchmarks.paper.benchmark import MethodResult, PaperResult, PaperSettings
from worker.benchmarks.paper.experiments import trials
from worker.benchmarks.paper.figures import pictures
from worker.benchmarks.paper.report import document, write_report
from worker.benchmarks.paper.scores import MethodScores
from worker.benchmarks.paper.site import Site
from worker.progress import no_progress

EPOCHS = [
    {"epoch": 1.0, "train_loss": 0.2, "validation_loss": 0.3, "train_accuracy": 0.5, "accuracy": 0.4},
    {"epoch": 2.0, "train_loss": 0.1, "validation_loss": 0.2, "train_accuracy": 0.7, "accuracy": 0.6},
]


@pytest.fixture
def result(site: Site) -> PaperResult:
    """One experiment, whose change is missed, by a detector without descriptors; not disturbed."""
    given = tuple(trials(site, [replace(ONE, name="type_remove")], no_progress))
    scores = MethodScores(
        name="odd", scores=(np.linspace(0.1, 0.4, 4),), truths=(given[0].truth,), seconds=0.1
    )
    return PaperResult(
        settings=PaperSettings(),
        card=CountingDetector.card,
        site=site,
        validation=site,
        trials=given,
        detector=MethodResult(test=scores, validation=scores, threshold=0.5, test_threshold=0.1),
        baselines=(),
        left_out=(),
        robustness=(),
        embedding=None,
        training=EPOCHS,
        seconds=1.0,
        machine={},
    )


def test_a_training_that_kept_its_log_is_drawn_as_figure_8(result: PaperResult) -> None:
    (figure,) = (one.figure for one in pictures(result) if one.name == "figure-08")
    assert figure is not None
    loss, accuracy = figure.axes
    assert loss.lines[0].get_ydata() == pytest.approx([0.2, 0.1])
    assert accuracy.lines[1].get_ydata() == pytest.approx([40, 60])


def test_the_report_says_which_pictures_it_lacks_and_why(result: PaperResult, tmp_path: Path) -> None:
    bare = replace(result, training=None)
    page = write_report(bare, document(bare), tmp_path).read_text()
    for words in (
        "Left out: Figure 8; no log of the training lies beside the weights.",
        "Left out: Figure 10; none of its experiments was run.",
        "Left out: Figure 11; it was not asked for.",
        "Left out: Figure 12; the detector has no descriptors.",
    ):
        assert words in page
    assert page.count("Left out") == 4
    assert page.count("data:image/png;base64,") == len(list(tmp_path.glob("*.png"))) == 8


def test_drawing_a_report_changes_nothing_that_the_next_model_is_given(
    result: PaperResult, tmp_path: Path
) -> None:
    grid = result.site.tiles.grid
    before = grid.size.copy(), grid.origin.copy()
    write_report(result, document(result), tmp_path)
    assert np.array_equal(grid.size, before[0])
    assert np.array_equal(grid.origin, before[1])
