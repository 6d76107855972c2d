"""One entry is all that a detector needs, and it names classes that are there."""

from __future__ import annotations

import pytest

from worker.detectors.registry import DETECTORS, trainable_detectors
from worker.detectors.store import detector_class
from worker.detectors.trainable import network_class


@pytest.mark.parametrize("key", sorted(DETECTORS))
def test_every_entry_names_a_class_that_opens_models(key: str) -> None:
    assert detector_class(key).settings_class.model_fields


@pytest.mark.parametrize(
    ("key", "title"),
    [("kpconv", "Siamese-KPConv"), ("pointnet2", "Siamese-PointNet++"), ("spicd-net", "SPICD-Net")],
)
def test_a_network_is_made_of_the_settings_of_its_detector(key: str, title: str) -> None:
    settings = {"patch_points": 256, "chamfer_points": None, "counts": True, "seed": 1}
    assert set(detector_class(key).settings_class.model_fields) == set(settings)
    assert network_class(key)(**settings).title == title


def test_three_detectors_have_a_network_to_train() -> None:
    assert trainable_detectors() == ["kpconv", "pointnet2", "spicd-net"]


def test_a_detector_without_weights_has_no_network() -> None:
    assert "c2c" not in trainable_detectors()
    with pytest.raises(KeyError, match="c2c"):
        network_class("c2c")
