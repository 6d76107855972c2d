"""What a network has to offer so that `worker.training` can train it; torch and NumPy alone."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from worker.cloud.types import Points
from worker.detectors.registry import DETECTORS
from worker.progress import Progress

UNCHANGED, CHANGED, DIFFERENT = 0, 1, 2  #: the classes of a pair


@dataclass(frozen=True, slots=True)
class Pair:
    """One example."""

    reference: Points  #: (n, 3) float32, metres, tile-centre frame: a patch's distinct points
    current: Points  #: (m, 3)
    label: int  #: UNCHANGED, CHANGED or DIFFERENT


class Labelled(Protocol):
    """A batch of B pairs, in whatever form the network takes them."""

    labels: NDArray[np.int64]  #: (B,)


B = TypeVar("B", bound=Labelled)


class TrainableNetwork(Protocol[B]):
    """How the network of a detector is made, fed and judged; the weights lie in the module that `build` makes.

    Made of the detector's settings, which are those that a card of it has.
    """

    @property
    def title(self) -> str:
        """The network's name in sentences."""

    def build(self, *, coarse_search: bool = False) -> nn.Module:
        """Return the network before training. `coarse_search` may trade exactness of a training step for time."""

    def collate(self, pairs: Sequence[Pair], rng: np.random.Generator) -> B:
        """Make one batch; whatever is drawn comes from `rng`."""

    def answer(self, module: nn.Module, batch: B) -> tuple[Tensor, Tensor]:
        """Return logits (B, 3) and the loss, on the module's device."""

    def class_loss(self, logits: Tensor, labels: Tensor) -> Tensor:
        """Return the part of the loss that is of the answers (n, 3) alone."""

    def start_from(self, module: nn.Module, weights: Mapping[str, Tensor], *, fresh_head: bool) -> None:
        """Take over the weights of another training, or with `fresh_head` its encoder alone."""

    def initialize_from_data(self, module: nn.Module, batches: Iterable[B]) -> None:
        """Set the first weights of the head by the statistics of a few batches (data-dependent initialization)."""

    # A head can be trained by itself on an encoder that is frozen.

    def head(self, module: nn.Module) -> nn.Module:
        """Return the part that makes logits (n, 3) of descriptors (n, D), (n, D) and statistics (n, S)."""

    def begin_head(self, module: nn.Module, reference: Tensor, current: Tensor, statistics: Tensor) -> None:
        """Initialise the head from descriptors (n, D), (n, D) and statistics (n, S) of n pairs."""

    def encode(
        self, module: nn.Module, clouds: Sequence[Points], progress: Progress
    ) -> tuple[Tensor, list[Tensor]]:
        """Return the descriptors (n, D) of n clouds, and of each what the statistics are computed of."""

    def compare(self, references: Sequence[Tensor], currents: Sequence[Tensor]) -> NDArray[np.float32]:
        """Return the statistics (n, S) of n pairs of what `encode` returned."""

    def swapped(self, statistics: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the statistics (n, S) of the same pairs with reference and current exchanged."""


NetworkClass = Callable[..., TrainableNetwork[Any]]  #: called with the detector's settings, by keyword


def network_class(key: str) -> NetworkClass:
    """Return what trains the detector of this key. Raises KeyError where nothing of it is trained."""
    network = DETECTORS[key].network
    if network is None:
        raise KeyError(f"nothing of a detector {key!r} is trained")
    trains: NetworkClass = resolve_name(network)
    return trains
