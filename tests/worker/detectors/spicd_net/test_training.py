"""The loss, by hand."""

from __future__ import annotations

import math

import pytest
import torch

from worker.detectors.siamese.training import focal_loss
from worker.detectors.spicd_net.training import orthogonality, total_loss


def test_focal_loss_of_even_logits_by_hand():
    loss = focal_loss(torch.zeros(3, 3), torch.tensor([0, 1, 2]))
    by_hand = (0.25 + 0.35 + 0.40) / 3 * (2 / 3) ** 2 * math.log(3)
    assert float(loss) == pytest.approx(by_hand, rel=1e-6)


def test_focal_loss_of_one_pair_by_hand():
    logits = torch.tensor([[0.2, 0.5, 0.3]]).log()  # so that the softmax is these shares
    loss = focal_loss(logits, torch.tensor([1]))
    assert float(loss) == pytest.approx(-0.35 * 0.5**2 * math.log(0.5), rel=1e-5)


def test_a_rotation_is_orthogonal_and_a_doubling_is_not():
    c, s = math.cos(0.4), math.sin(0.4)
    rotation = torch.tensor([[[c, -s, 0], [s, c, 0], [0, 0, 1.0]]])
    assert float(orthogonality((rotation,))) == pytest.approx(0, abs=1e-10)
    # |I - 4 I|^2 = 9 a dimension: 27 for k = 3, averaged with the rotation's 0.
    assert float(orthogonality((rotation, 2 * torch.eye(3)[None]))) == pytest.approx(13.5)


def test_the_total_adds_a_thousandth_of_the_orthogonality():
    logits, labels = torch.zeros(1, 3), torch.tensor([0])
    total = total_loss(logits, labels, (2 * torch.eye(3)[None],))
    assert float(total - focal_loss(logits, labels)) == pytest.approx(0.027, rel=1e-4)
