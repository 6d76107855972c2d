"""How Siamese-PointNet++ is trained: as SPICD-Net, with its own encoder."""

from __future__ import annotations

from typing import ClassVar

from worker.detectors.pointnet2.grouping import GroupedClouds
from worker.detectors.pointnet2.network import PointNet2Encoder
from worker.detectors.siamese.prepared import PreparedTraining


class PointNet2Training(PreparedTraining[GroupedClouds]):
    """TrainableNetwork (worker.detectors.trainable); the fields are those of SiameseSettings."""

    __slots__ = ()

    title: ClassVar[str] = "Siamese-PointNet++"
    encoder_class = PointNet2Encoder
