"""Which precision a network is run with, and that a block of it computes so."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from worker.detectors import precision
from worker.detectors.precision import autocast, chosen_precision, has_bfloat16
from worker.errors import DetectorUnavailable

CPU = torch.device("cpu")


@pytest.mark.parametrize(
    ("asked", "holds", "has", "chosen"),
    [
        ("auto", True, True, "bfloat16"),
        ("auto", True, False, "float32"),
        ("auto", False, True, "float32"),
        ("float32", True, True, "float32"),
        ("bfloat16", False, True, "bfloat16"),
    ],
)
def test_bfloat16_is_chosen_where_the_scores_hold_and_the_device_has_it(
    monkeypatch, asked, holds, has, chosen
):
    monkeypatch.setattr(precision, "has_bfloat16", lambda device: has)
    assert chosen_precision(asked, CPU, holds=holds) == chosen


def test_bfloat16_of_a_device_without_it_is_an_error(monkeypatch):
    monkeypatch.setattr(precision, "has_bfloat16", lambda device: False)
    with pytest.raises(DetectorUnavailable, match="device cpu does not have it"):
        chosen_precision("bfloat16", CPU, holds=True)


@pytest.mark.parametrize(
    ("avx", "amx", "has"), [(True, False, True), (False, True, True), (False, False, False)]
)
def test_a_processor_has_bfloat16_by_either_of_its_instruction_sets(monkeypatch, avx, amx, has):
    looks = SimpleNamespace(_is_avx512_bf16_supported=lambda: avx, _is_amx_tile_supported=lambda: amx)
    monkeypatch.setattr(torch, "cpu", looks)
    assert has_bfloat16(CPU) is has


def test_a_gpu_that_emulates_bfloat16_has_it_not(monkeypatch):
    def supported(*, including_emulation: bool) -> bool:
        return including_emulation

    monkeypatch.setattr(torch.cuda, "is_bf16_supported", supported)
    assert not has_bfloat16(torch.device("cuda"))


def test_a_block_of_bfloat16_multiplies_so_and_one_of_float32_changes_nothing():
    a = torch.rand(8, 8)
    with autocast(CPU, "bfloat16"):
        assert (a @ a).dtype == torch.bfloat16
    with autocast(CPU, "float32"):
        assert (a @ a).dtype == torch.float32
