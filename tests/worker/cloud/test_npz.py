"""Values that come back from a file as they were, and files that are refused."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from worker.cloud import npz
from worker.cloud.types import Colors, Points

POINTS = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)


@dataclass(frozen=True, kw_only=True, slots=True)
class Inner:
    shape: tuple[int, int]
    size: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Row:
    tile: int
    changed: bool
    points: Points


@dataclass(frozen=True, kw_only=True, slots=True)
class Outer:
    name: str
    points: Points
    colors: Colors | None
    parts: tuple[Points, ...]
    inner: Inner
    other: Inner | None
    rows: tuple[Row, ...]


def value(**others: Any) -> Outer:
    given = Outer(
        name="now",
        points=POINTS,
        colors=None,
        parts=(POINTS[:2], POINTS[:0], POINTS),
        inner=Inner(shape=(3, -2), size=0.05),
        other=None,
        rows=(Row(tile=4, changed=True, points=POINTS[:0]), Row(tile=0, changed=False, points=POINTS)),
    )
    return Outer(
        **{field.name: others.get(field.name, getattr(given, field.name)) for field in fields(given)}
    )


def assert_same(a: Any, b: Any) -> None:
    """Equal to the bit and in type, through values, tuples and arrays; NaN equals NaN."""
    assert type(a) is type(b)
    if is_dataclass(a):
        for field in fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for one, other in zip(a, b, strict=True):
            assert_same(one, other)
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    else:
        assert a == b


@pytest.mark.parametrize(
    "given",
    [
        value(),
        value(colors=np.full((7, 3), 9, np.uint8), other=Inner(shape=(1, 1), size=np.inf)),
        value(points=np.full((2, 3), np.nan, np.float32), parts=(), rows=()),
    ],
)
def test_a_value_comes_back_equal(tmp_path: Path, given: Outer) -> None:
    npz.save(tmp_path / "value.npz", given)
    assert_same(given, npz.load(tmp_path / "value.npz", Outer))


def test_the_same_values_give_the_same_bytes(tmp_path: Path) -> None:
    for name in "ab":
        npz.save(tmp_path / name, value())
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_field_that_an_older_file_lacks_has_the_default_that_is_given_and_no_other(tmp_path: Path) -> None:
    path = tmp_path / "old.npz"
    npz.save(path, Inner(shape=(1, 2), size=3.0))
    arrays = npz.load_arrays(path)
    npz.save_arrays(path, {"size": arrays["size"].reshape(1)})  # a number in an array of one
    assert npz.load(path, Inner, shape=(7, 8)) == Inner(shape=(7, 8), size=3.0)
    with pytest.raises(ValueError, match=r"old\.npz is no file of a Inner: it has no 'shape'"):
        npz.load(path, Inner)
    npz.save(path, Inner(shape=(1, 2), size=3.0))
    assert npz.load(path, Inner, shape=(7, 8)).shape == (1, 2)


def test_a_file_of_another_kind_is_refused_by_its_name(tmp_path: Path) -> None:
    npz.save(tmp_path / "inner.npz", Inner(shape=(1, 2), size=3.0))
    with pytest.raises(ValueError, match=r"inner\.npz is no file of a Outer: it has no 'name'"):
        npz.load(tmp_path / "inner.npz", Outer)
    npz.save_arrays(tmp_path / "more.npz", {"shape": np.ones(2), "size": np.ones(1), "more": np.ones(1)})
    with pytest.raises(ValueError, match=r"more\.npz is no file of a Inner: nothing is known of more"):
        npz.load(tmp_path / "more.npz", Inner)


def test_what_no_array_holds_is_not_kept(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"name is a .*Path"):
        npz.save(tmp_path / "value.npz", value(name=Path()))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("content", [b"", b"tiles, but not as arrays", b"PK half a file"])
def test_anything_else_than_an_archive_of_arrays_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "text.npz").write_bytes(content)
    with pytest.raises(ValueError, match=r"text\.npz is no archive of arrays"):
        npz.load_arrays(tmp_path / "text.npz")


def test_an_array_that_is_no_archive_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "one.npy", POINTS)
    with pytest.raises(ValueError, match="no archive of arrays"):
        npz.load_arrays(tmp_path / "one.npy")


def test_an_archive_with_a_pickle_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "p.npz", evil=np.array([{"run": "this"}], dtype=object))
    with pytest.raises(ValueError, match="allow_pickle"):
        npz.load_arrays(tmp_path / "p.npz")


def test_a_failed_write_leaves_the_earlier_file_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "s.npz"
    npz.save_arrays(path, {"a": POINTS})

    def disk_full(file: Any, **arrays: Any) -> None:
        file.write(b"PK half a file")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", disk_full)
    with pytest.raises(OSError, match="No space"):
        npz.save_arrays(path, {"a": POINTS * 2})
    with pytest.raises(OSError, match="No space"):
        npz.save_arrays(tmp_path / "new.npz", {"a": POINTS})
    assert_same(POINTS, npz.load_arrays(path)["a"])
    assert [found.name for found in tmp_path.iterdir()] == ["s.npz"]
