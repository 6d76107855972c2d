"""`python -m worker.training TILES FOLDER`: train where there is torch and numpy and nothing else.

The command line of the project (`spicd-worker train`) does the same and more; this one runs on a bare GPU machine.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from worker.training.settings import PAPER, TrainSettings
from worker.training.trainer import train

#: Options by the settings that they are fields of.
RUN = (
    "epochs",
    "minutes",
    "train_pairs",
    "validation_pairs",
    "batch",
    "start_from",
    "fresh_head",
    "learning_rate",
    "head_epochs",
)
PAIRS = ("revisit_share", "edited_share", "rebuilt_share", "density")


def main() -> None:
    """Train, or go on with a training that was stopped."""
    parser = argparse.ArgumentParser(prog="python -m worker.training", description=__doc__.splitlines()[0])
    parser.add_argument("tiles", type=Path, help="training set (.npz)")
    parser.add_argument("folder", type=Path, help="where checkpoints and the log are kept")
    parser.add_argument("--paper", action="store_true", help="the paper's own settings, not ours")
    parser.add_argument("--epochs", type=int)
    parser.add_argument("--minutes", type=float, help="wall clock of the whole run; the rate follows it")
    parser.add_argument("--train-pairs", type=int)
    parser.add_argument("--validation-pairs", type=int)
    parser.add_argument("--batch", type=int)
    parser.add_argument("--revisit-share", type=float)
    parser.add_argument("--edited-share", type=float)
    parser.add_argument("--rebuilt-share", type=float)
    parser.add_argument("--density", type=float, nargs=2, metavar=("LOW", "HIGH"))
    parser.add_argument("--start-from", help="checkpoint whose network is trained on")
    parser.add_argument(
        "--fresh-head",
        action="store_const",
        const=True,
        help="take its encoder alone, and start the head anew",
    )
    parser.add_argument("--head-epochs", type=int, help="of the head alone, after the rest")
    parser.add_argument("--learning-rate", type=float, help="to begin with")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--threads", type=int, help="of the CPU")
    given = parser.parse_args()
    if given.threads:
        torch.set_num_threads(given.threads)
    default = PAPER if given.paper else TrainSettings()
    run, pairs = _of(given, RUN), _of(given, PAIRS)
    if "density" in pairs:
        pairs["density"] = tuple(pairs["density"])
    settings = replace(
        default,
        device=given.device,
        coarse_search=given.device == "cpu",
        pairs=replace(default.pairs, **pairs),
        **run,
    )
    best = train(settings, given.tiles, given.folder, _line)
    sys.stdout.write(f"{best}\n")


def _of(given: argparse.Namespace, names: tuple[str, ...]) -> dict[str, Any]:
    """What was given of these."""
    return {name: value for name in names if (value := getattr(given, name)) is not None}


def _line(stage: str, share: float) -> None:
    if sys.stderr.isatty():
        sys.stderr.write(f"\r{stage} {100 * share:5.1f}%")


if __name__ == "__main__":
    main()
