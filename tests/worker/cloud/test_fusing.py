from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from worker.cloud.fusing import FusedCloud, fused_cloud
from worker.cloud.voxels import Voxels, fused

TINY = 100_000  #: bytes: the sums of some 500 voxels


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def _scans(count: int = 7, *, colored: bool = True) -> Iterator[Voxels]:
    """Scans that overlap, with voxels on both sides of the frame's origin."""
    rng = np.random.default_rng(3)
    for number in range(count):
        points = rng.uniform([-2, -1, -1], [1, 1, 1], (3000, 3))
        points[:, 0] += 0.4 * number
        colors = rng.integers(0, 255, (3000, 3), np.uint8) if colored else None
        yield Voxels.of(points, size=0.1, origin=np.array([0.3, 0.2, 0.1]), colors=colors)


def _alike(one: FusedCloud, other: FusedCloud) -> None:
    assert (one.size, one.keys.tolist(), one.counts.tolist()) == (
        other.size,
        other.keys.tolist(),
        other.counts.tolist(),
    )
    assert one.points == pytest.approx(other.points, abs=1e-6)
    assert one.views == pytest.approx(other.views, abs=1e-6)
    if one.colors is None or other.colors is None:
        assert one.colors is other.colors
    else:
        assert np.abs(one.colors.astype(int) - other.colors).max() <= 1
        assert (one.colors == other.colors).mean() > 0.999
    assert [column.dtype for column in _columns(one)] == [column.dtype for column in _columns(other)]


def _columns(cloud: FusedCloud) -> list[np.ndarray]:
    values = (getattr(cloud, field.name) for field in dataclasses.fields(cloud))
    return [value for value in values if isinstance(value, np.ndarray)]


def test_what_fits_into_memory_is_bit_for_bit_what_merging_gives_and_touches_no_disk(scratch: Path) -> None:
    whole = fused(_scans())
    cloud = fused_cloud(_scans())
    assert whole is not None
    assert cloud is not None
    for mine, wanted in zip(_columns(cloud), _columns(FusedCloud.of(whole)), strict=True):
        assert (mine == wanted).all()
    assert list(scratch.iterdir()) == []


@pytest.mark.parametrize("colored", [False, True])
@pytest.mark.parametrize("memory_bytes", [1, TINY, 20 * TINY])
def test_what_goes_through_the_disk_is_what_memory_gives(
    scratch: Path, memory_bytes: int, colored: bool
) -> None:
    in_memory = fused_cloud(_scans(colored=colored))
    on_disk = fused_cloud(_scans(colored=colored), memory_bytes=memory_bytes)
    assert in_memory is not None
    assert on_disk is not None
    _alike(on_disk, in_memory)
    assert list(scratch.iterdir()) == []


def test_sums_beyond_the_bound_are_on_the_disk_while_scans_come(scratch: Path) -> None:
    written: list[int] = []

    def watched() -> Iterator[Voxels]:
        for voxels in _scans():
            yield voxels
            written.append(sum(path.stat().st_size for path in scratch.rglob("run-*")))

    fused_cloud(watched(), memory_bytes=TINY)
    assert written == sorted(written)
    assert written[-1] > 10 * TINY


def test_one_scan_without_colours_leaves_all_without_them_also_on_the_disk(scratch: Path) -> None:
    mixed = [*_scans(3), *_scans(2, colored=False)]
    cloud = fused_cloud(iter(mixed), memory_bytes=TINY)
    assert cloud is not None
    assert cloud.colors is None
    in_memory = fused_cloud(iter(mixed))
    assert in_memory is not None
    _alike(cloud, in_memory)


def test_of_no_part_there_is_no_cloud() -> None:
    assert fused_cloud([]) is None
