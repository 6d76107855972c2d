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


OPTIONS = (
    Option("detector", str, "Whose network is trained: spicd-net, pointnet2 or kpconv."),
    Option("epochs", int, "At most so many.", 0),
    Option("minutes", float, "Wall clock of the training; the learning rate follows it.", 0),
    Option("train_pairs", int, "An epoch.", 1),
    Option("validation_pairs", int, "After each epoch.", 1),
    Option("batch", int, "Pairs.", 2),
    Option("revisit_share", float, "Of pairs of two visits, not one sampled twice.", 0, 1, of_pairs=True),
    Option("edited_share", float, "Of changed pairs, those of whole things.", 0, 1, of_pairs=True),
    Option(
        "rebuilt_share", float, "Of changed pairs, those of a map with changed scans.", 0, 1, of_pairs=True
    ),
    Option(
        "noisy_share",
        float,
        "Of still pairs, those with noise on every point.",
        0,
        1,
        of_pairs=True,
    ),
    Option("thinning", float, "Half of those lose points, up to this share.", 0, 1, of_pairs=True),
    Option("counts", bool, "Give the head point counts beside the Chamfer statistics.", of_pairs=True),
    Option("density", float, "Least and largest share of points that changes take.", count=2, of_pairs=True),
    Option("start_from", str, "Checkpoint whose network is trained on."),
    Option("fresh_head", bool, "Take its encoder alone, and start the head anew."),
    Option("head_epochs", int, "Of the head alone, after the rest: seconds each.", 0),
    Option("learning_rate", float, "To begin with.", 0),
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
