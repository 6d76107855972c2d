"""How Siamese-KPConv is trained: as SPICD-Net, with its own encoder."""

from __future__ import annotations

from typing import ClassVar

from worker.detectors.kpconv.network import KPConvEncoder
from worker.detectors.kpconv.pyramid import Pyramid
from worker.detectors.siamese.prepared import PreparedTraining


class KPConvTraining(PreparedTraining[Pyramid]):
    """TrainableNetwork (worker.detectors.trainable); the fields are those of SiameseSettings."""

    __slots__ = ()

    title: ClassVar[str] = "Siamese-KPConv"
    encoder_class = KPConvEncoder
