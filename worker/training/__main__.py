"""`python -m worker.training TILES FOLDER`: train where there is torch and numpy and nothing else.

The command line of the project (`spicd-worker train`) does the same and more; this one runs on a bare GPU machine.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch

from worker.training.options import OPTIONS, with_options
from worker.training.settings import PAPER, TrainSettings
from worker.training.trainer import train


def main() -> None:
    """Train, or go on with a training that was stopped."""
    parser = argparse.ArgumentParser(prog="python -m worker.training", description=__doc__.splitlines()[0])
    parser.add_argument("tiles", type=Path, help="training set (.npz)")
    parser.add_argument("folder", type=Path, help="where checkpoints and the log are kept")
    parser.add_argument("--paper", action="store_true", help="the paper's own settings, not ours")
    for option in OPTIONS:
        if option.kind is bool:
            parser.add_argument(option.flag, action="store_const", const=True, help=option.help)
        else:
            nargs = option.count if option.count > 1 else None
            parser.add_argument(option.flag, type=option.kind, nargs=nargs, help=option.help)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--threads", type=int, help="of the CPU")
    given = parser.parse_args()
    if given.threads:
        torch.set_num_threads(given.threads)
    default = PAPER if given.paper else TrainSettings()
    best = train(with_options(default, vars(given), device=given.device), given.tiles, given.folder, _line)
    sys.stdout.write(f"{best}\n")


def _line(stage: str, share: float) -> None:
    if sys.stderr.isatty():
        sys.stderr.write(f"\r{stage} {100 * share:5.1f}%")


if __name__ == "__main__":
    main()
