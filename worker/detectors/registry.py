"""The detectors that there are: one entry each. Naming a detector imports nothing.

So the table serves both those who detect and a GPU machine that only trains, where torch and NumPy are all there is.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class Entry:
    """Where the classes of one detector are, as `module:Class`; they are imported when one is asked for."""

    detector: str  #: `worker.detectors.store.DetectorClass`, which opens its models
    network: str | None = None  #: `worker.detectors.trainable.NetworkClass`; None: nothing of it is trained


#: By the key that a card has as `detector`. A new detector is one folder and one entry here.
DETECTORS: dict[str, Entry] = {
    "c2c": Entry(detector="worker.detectors.c2c.detector:CloudToCloud"),
    "kpconv": Entry(
        detector="worker.detectors.kpconv.detector:KPConv",
        network="worker.detectors.kpconv.training:KPConvTraining",
    ),
    "pointnet2": Entry(
        detector="worker.detectors.pointnet2.detector:PointNet2",
        network="worker.detectors.pointnet2.training:PointNet2Training",
    ),
    "spicd-net": Entry(
        detector="worker.detectors.spicd_net.detector:SpicdNet",
        network="worker.detectors.spicd_net.training:SpicdNetTraining",
    ),
    "voxel-net": Entry(detector="worker.detectors.voxel_net.detector:VoxelNet"),
    "voxel-rule": Entry(detector="worker.detectors.voxel_rule.detector:VoxelRule"),
}


def trainable_detectors() -> list[str]:
    """Return the keys of the detectors that have a network to train, sorted."""
    return sorted(key for key, entry in DETECTORS.items() if entry.network is not None)
