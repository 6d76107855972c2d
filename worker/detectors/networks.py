"""The networks that can be trained, by the key of their detector.

They stand apart from `worker.detectors.store`: a GPU machine that only trains has torch and NumPy and nothing else.
"""

from __future__ import annotations

from worker.detectors.spicd_net.training import SpicdNetTraining
from worker.detectors.trainable import NetworkClass

NETWORKS: dict[str, NetworkClass] = {"spicd-net": SpicdNetTraining}
