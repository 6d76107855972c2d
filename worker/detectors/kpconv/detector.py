"""Siamese-KPConv as a detector."""

from __future__ import annotations

from worker.detectors.kpconv.network import KPConvEncoder
from worker.detectors.siamese.prepared_detector import PreparedDetector


class KPConv(PreparedDetector):
    """Detector (worker.detectors.detector) with the encoder of KPConv."""

    encoder_class = KPConvEncoder
