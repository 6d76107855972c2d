"""Frozen dataclasses as `.npz` files: arrays only, no pickle, seen whole or not at all.

The type of a field says how it is kept:

| field | in the file |
| --- | --- |
| array, number, string, tuple of numbers | one array of the field's name |
| tuple of arrays of different lengths | `name_points`, all end to end, and `name_ends`, where each ends |
| dataclass | its own fields, as `name.field` |
| tuple of dataclasses | each of their fields as a tuple, as `name.field` |
| None | nothing |
"""

from __future__ import annotations

import zipfile
from collections.abc import Collection, Iterator
from dataclasses import fields, is_dataclass
from itertools import pairwise
from pathlib import Path
from types import GenericAlias, NoneType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from worker.cloud.types import Arrays
from worker.files import write_atomically

T = TypeVar("T")


def save(path: Path, value: Any) -> None:
    """Keep a dataclass. Raises OSError, and TypeError for a field that the table above does not name."""
    save_arrays(path, dict(_arrays(type(value), value, "")))


def load(path: Path, kind: type[T], **defaults: Any) -> T:
    """Read what `save` kept of a value of this class; `defaults` are for fields that an older file lacks.

    Raises OSError, and ValueError, which names the file, where it holds anything else.
    """
    arrays = load_arrays(path)
    try:
        wanted = _fields(kind)
        given = {name: value for name, value in defaults.items() if not _kept(name, arrays)}
        value = kind(
            **{name: _value(wanted[name], arrays, name) for name in wanted if name not in given}, **given
        )
        if arrays:
            raise ValueError(f"nothing is known of {', '.join(sorted(arrays))}")
    except KeyError as missing:
        raise ValueError(f"{path} is no file of a {kind.__name__}: it has no {missing}") from missing
    except (TypeError, ValueError) as unsound:
        raise ValueError(f"{path} is no file of a {kind.__name__}: {unsound}") from unsound
    return value


def save_arrays(path: Path, arrays: Arrays) -> None:
    """Keep named arrays. Raises OSError."""

    def write(aside: Path) -> None:
        with aside.open("wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]

    write_atomically(path, write)


def load_arrays(path: Path, names: Collection[str] | None = None) -> Arrays:
    """Read what `save_arrays` kept, or of it the arrays of these names.

    Raises OSError, and ValueError, which names the file, for any other file.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive if names is None or name in names}
    except (ValueError, TypeError, EOFError, zipfile.BadZipFile) as unsound:
        raise ValueError(f"{path} is no archive of arrays: {unsound}") from unsound


def _arrays(kind: Any, value: Any, name: str) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the arrays, by name, that a value of this type is kept as."""
    kind = _without_none(kind)
    item = _item(kind)
    if value is None:
        return
    if _is_dataclass(kind):
        for field, its_kind in _fields(kind).items():
            yield from _arrays(its_kind, getattr(value, field), _inner(name, field))
    elif _is_dataclass(item):
        for field, its_kind in _fields(item).items():
            column = tuple(getattr(row, field) for row in value)
            yield from _arrays(_column(its_kind), column, _inner(name, field))
    elif _is_array(item):
        yield f"{name}_points", np.concatenate(value) if value else np.empty((0, 3), np.float32)
        yield f"{name}_ends", np.cumsum([len(part) for part in value], dtype=np.int64)
    elif (array := np.asarray(value)).dtype == object:
        raise TypeError(f"{name} is a {type(value).__name__}, which no array holds")
    else:
        yield name, array


def _value(kind: Any, arrays: Arrays, name: str) -> Any:
    """Take the value of this type out of the arrays. Raises KeyError where a part of it is not there."""
    if _without_none(kind) is not kind and not _kept(name, arrays):
        return None
    kind = _without_none(kind)
    item = _item(kind)
    if _is_dataclass(kind):
        return kind(
            **{field: _value(its, arrays, _inner(name, field)) for field, its in _fields(kind).items()}
        )
    if _is_dataclass(item):
        columns = {
            field: _value(_column(its), arrays, _inner(name, field)) for field, its in _fields(item).items()
        }
        rows = zip(*columns.values(), strict=True)
        return tuple(item(**dict(zip(columns, row, strict=True))) for row in rows)
    if _is_array(item):
        points, ends = arrays.pop(f"{name}_points"), arrays.pop(f"{name}_ends").tolist()
        return tuple(points[start:end] for start, end in pairwise([0, *ends]))
    array = arrays.pop(name)
    if _is_array(kind):
        return array
    return kind(array.item()) if item is None else tuple(array.tolist())


def _fields(kind: Any) -> dict[str, Any]:
    """Return the types of a dataclass's fields."""
    hints = get_type_hints(kind)
    return {field.name: hints[field.name] for field in fields(kind)}


def _without_none(kind: Any) -> Any:
    """Return X of `X | None`; any other type as it is."""
    others = [part for part in get_args(kind) if part is not NoneType]
    return others[0] if NoneType in get_args(kind) else kind


def _item(kind: Any) -> Any:
    """Return the type of a tuple's items; None for any other type."""
    return get_args(kind)[0] if get_origin(kind) is tuple else None


def _column(kind: Any) -> Any:
    """Return the type of a tuple of items of this type."""
    return GenericAlias(tuple, (kind, ...))


def _is_dataclass(kind: Any) -> bool:
    return is_dataclass(kind)


def _is_array(kind: Any) -> bool:
    return get_origin(kind) is np.ndarray


def _inner(name: str, field: str) -> str:
    return f"{name}.{field}" if name else field


def _kept(name: str, arrays: Arrays) -> bool:
    """Tell whether any array belongs to the value of this name."""
    own = (name, f"{name}_points")
    return any(kept in own or kept.startswith(f"{name}.") for kept in arrays)
