"""The settings of a training that its command lines offer: `spicd-worker train` and `python -m worker.training`.

Nothing heavy is imported here, so that a help text does not wait for torch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from worker.training.settings import TrainSettings


@dataclass(frozen=True, slots=True)
class Option:
    """A field of TrainSettings, or of its PairSettings."""

    name: str
    kind: type  #: of one value
    help: str
    least: float | None = None
    most: float | None = None
    count: int = 1  #: of values
    of_pairs: bool = False

    @property
    def flag(self) -> str:
        return "--" + self.name.replace("_", "-")


#: A test holds the default that a text names to that of the settings.
OPTIONS = (
    Option("detector", str, "Whose network is trained: spicd-net, pointnet2 or kpconv (default: spicd-net)."),
    Option("epochs", int, "Stop after so many epochs; 0: train the head alone (default: 1000).", 0),
    Option(
        "minutes",
        float,
        "Stop after this time by the clock; the learning rate follows it (default: no limit).",
        0,
    ),
    Option("train_pairs", int, "Pairs in each epoch (default: 2000).", 1),
    Option("validation_pairs", int, "Pairs to validate on after each epoch (default: 500).", 1),
    Option("batch", int, "Pairs in one step (default: 16).", 2),
    Option(
        "revisit_share",
        float,
        "Share of pairs that are two visits, not one tile sampled twice (default: 0.7).",
        0,
        1,
        of_pairs=True,
    ),
    Option(
        "edited_share",
        float,
        "Share of changed pairs in which whole things came, went or moved (default: 0.65).",
        0,
        1,
        of_pairs=True,
    ),
    Option(
        "rebuilt_share",
        float,
        "Share of changed pairs that are a map fused anew with some scans changed (default: 0.35).",
        0,
        1,
        of_pairs=True,
    ),
    Option(
        "noisy_share",
        float,
        "Share of still pairs that have noise on every point (default: 0.0).",
        0,
        1,
        of_pairs=True,
    ),
    Option(
        "thinning",
        float,
        "Half of the noisy pairs also lose up to this share of their points (default: 0.35).",
        0,
        1,
        of_pairs=True,
    ),
    Option(
        "counts",
        bool,
        "Give the head point counts beside the Chamfer statistics (default: no).",
        of_pairs=True,
    ),
    Option(
        "density",
        float,
        "Least and largest share of a tile's points that a synthetic change takes (default: 0.075 0.075).",
        count=2,
        of_pairs=True,
    ),
    Option("start_from", str, "Checkpoint whose network is trained further (default: none)."),
    Option(
        "fresh_head", bool, "Take only the encoder of that checkpoint, and start the head anew (default: no)."
    ),
    Option(
        "head_epochs", int, "Then train the head alone for so many epochs, of seconds each (default: 0).", 0
    ),
    Option("learning_rate", float, "Learning rate at the start (default: 0.001).", 0),
)


def with_options(settings: TrainSettings, given: Mapping[str, Any], *, device: str) -> TrainSettings:
    """Return the settings with what was given (None: nothing) in their place, for a device ("cpu" or "cuda")."""

    def values(of_pairs: bool) -> dict[str, Any]:
        chosen = [option for option in OPTIONS if option.of_pairs == of_pairs]
        there = {option: given[option.name] for option in chosen if given.get(option.name) is not None}
        return {option.name: tuple(value) if option.count > 1 else value for option, value in there.items()}

    pairs = replace(settings.pairs, **values(of_pairs=True))
    own = values(of_pairs=False)
    return replace(settings, device=device, coarse_search=device == "cpu", pairs=pairs, **own)
