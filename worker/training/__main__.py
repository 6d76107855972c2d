"""`python -m worker.training TILES FOLDER`: train where there is torch and numpy and nothing else.

The command line of the project (`spicd-worker train`) does the same and more; this one runs on a bare GPU machine.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import torch

from worker.training.pairs import PairSettings
from worker.training.trainer import TrainSettings, train


def main() -> None:
    """Train, or go on with a training that was stopped."""
    default = TrainSettings()
    parser = argparse.ArgumentParser(prog="python -m worker.training", description=__doc__.splitlines()[0])
    parser.add_argument("tiles", type=Path, help="training set (.npz)")
    parser.add_argument("folder", type=Path, help="where checkpoints and the log are kept")
    parser.add_argument("--epochs", type=int, default=default.epochs)
    parser.add_argument("--minutes", type=float, help="wall clock of the whole run; the rate follows it")
    parser.add_argument("--train-pairs", type=int, default=default.train_pairs)
    parser.add_argument("--validation-pairs", type=int, default=default.validation_pairs)
    parser.add_argument("--batch", type=int, default=default.batch)
    parser.add_argument("--revisit-share", type=float, default=default.pairs.revisit_share)
    parser.add_argument(
        "--density", type=float, nargs=2, default=default.pairs.density, metavar=("LOW", "HIGH")
    )
    parser.add_argument("--start-from", help="checkpoint whose network is trained on")
    parser.add_argument("--learning-rate", type=float, default=default.learning_rate, help="to begin with")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--threads", type=int, help="of the CPU")
    given = parser.parse_args()
    if given.threads:
        torch.set_num_threads(given.threads)
    settings = replace(
        default,
        epochs=given.epochs,
        minutes=given.minutes,
        train_pairs=given.train_pairs,
        validation_pairs=given.validation_pairs,
        batch=given.batch,
        start_from=given.start_from,
        learning_rate=given.learning_rate,
        device=given.device,
        coarse_search=given.device == "cpu",
        pairs=PairSettings(revisit_share=given.revisit_share, density=(given.density[0], given.density[1])),
    )
    best = train(settings, given.tiles, given.folder, _line)
    sys.stdout.write(f"{best}\n")


def _line(stage: str, share: float) -> None:
    if sys.stderr.isatty():
        sys.stderr.write(f"\r{stage} {100 * share:5.1f}%")


if __name__ == "__main__":
    main()
