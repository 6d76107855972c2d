"""Siamese-PointNet++ as a detector."""

from __future__ import annotations

from worker.detectors.pointnet2.network import PointNet2Encoder
from worker.detectors.siamese.prepared_detector import PreparedDetector


class PointNet2(PreparedDetector):
    """Detector (worker.detectors.detector) with the encoder of PointNet++."""

    encoder_class = PointNet2Encoder
