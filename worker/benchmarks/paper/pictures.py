"""Which pictures the report has, in the paper's order, and what it says in place of one that it cannot have."""

from __future__ import annotations

from dataclasses import dataclass

from matplotlib.figure import Figure

from worker.benchmarks.paper import figures
from worker.benchmarks.paper.benchmark import PaperResult
from worker.benchmarks.paper.robustness import chosen_trials
from worker.benchmarks.paper.tile_figures import failure_case, tile_map
from worker.benchmarks.plots import curves


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Picture:
    """One of them."""

    name: str  #: of its file, without the ending
    caption: str  #: with the paper's number
    figure: Figure | None
    missing: str = ""  #: why there is no figure, where there is none

    @property
    def left_out(self) -> str:
        """A line for the report in the picture's place."""
        return f"{self.caption.partition(':')[0]}; {self.missing}."


def pictures(result: PaperResult) -> list[Picture]:
    """Figures 5 to 15, and a ROC."""
    return [*_of_scores(result), *_of_experiments(result), *_of_tiles(result)]


def _of_scores(result: PaperResult) -> list[Picture]:
    return [
        Picture(
            name="figure-05",
            caption="Figure 5: sensitivity to the threshold.",
            figure=figures.threshold_sensitivity(result),
        ),
        Picture(
            name="figure-06",
            caption="Figure 6: precision and recall.",
            figure=figures.precision_recall_curves(result),
        ),
        Picture(name="roc", caption="Section 4.3: ROC.", figure=figures.roc_curves(result)),
        Picture(
            name="figure-07",
            caption="Figure 7: sensitivity by kind of change.",
            figure=figures.sensitivity_by_kind(result),
        ),
        Picture(
            name="figure-08",
            caption="Figure 8: the training behind the weights.",
            figure=None if result.training is None else curves(result.training),
            missing="no log of the training lies beside the weights",
        ),
    ]


def _of_experiments(result: PaperResult) -> list[Picture]:
    types = ("type_add", "type_remove", "type_move")
    borders = ("baseline_no_change", "challenge_easy", "challenge_hard")
    missing = "none of its experiments was run"
    return [
        Picture(
            name="figure-09",
            caption="Figure 9: the type series.",
            figure=figures.confusion_matrices(result, types, "Type series"),
            missing=missing,
        ),
        Picture(
            name="figure-10",
            caption="Figure 10: baseline and challenges.",
            figure=figures.confusion_matrices(result, borders, "Baseline and challenges"),
            missing=missing,
        ),
        Picture(
            name="figure-11",
            caption=f"Figure 11: robustness, over {_named(result)}; a shifted map is not registered again. "
            "Diamonds: F1 as far as the paper's text tells it, on experiments that it does not name.",
            figure=figures.robustness(result) if result.robustness else None,
            missing="it was not asked for",
        ),
    ]


def _named(result: PaperResult) -> str:
    return ", ".join(trial.experiment.name for trial in chosen_trials(result.trials))


def _of_tiles(result: PaperResult) -> list[Picture]:
    return [
        Picture(
            name="figure-12",
            caption="Figure 12: fused embeddings; of the true negatives 15 an experiment.",
            figure=figures.embedding(result.embedding) if result.embedding else None,
            missing="the detector has no descriptors",
        ),
        Picture(
            name="figure-13",
            caption="Figure 13: tiles from above; green found, blue missed, red false alarms.",
            figure=tile_map(result),
        ),
        Picture(
            name="figure-14",
            caption="Figure 14: the missed change with the highest score.",
            figure=failure_case(result),
            missing="no change was missed",
        ),
        Picture(
            name="figure-15",
            caption="Figure 15: scores of changed and unchanged tiles.",
            figure=figures.score_distributions(result),
        ),
    ]
