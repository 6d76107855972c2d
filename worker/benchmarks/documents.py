"""What the documents and tables of all benchmarks share: how values are spread, shown and written."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from rich.table import Table

from worker import files
from worker.cloud.types import Floats

Document = dict[str, Any]  #: JSON-ready
Name = TypeVar("Name", bound=str)

STATISTICS: Mapping[str, Callable[[Floats], Any]] = {
    "median": np.median,
    "95%": lambda values: np.percentile(values, 95),
    "least": np.min,
    "most": np.max,
    "worst": np.max,
}


def spread(values: ArrayLike, *names: str, digits: int | None = None) -> dict[str, float] | None:
    """Return the named STATISTICS of the values that are not NaN; None where there are none."""
    every = np.asarray(values, np.float64)
    known = every[~np.isnan(every)]
    if not len(known):
        return None
    statistics = {name: float(STATISTICS[name](known)) for name in names}
    return {name: value if digits is None else round(value, digits) for name, value in statistics.items()}


def pose_spread(errors: Sequence[tuple[float, float]], *names: str) -> Document:
    """Return the named STATISTICS of pose errors (metres, radians), in `centimetres` and `degrees`."""
    metres, radians = np.array(errors).reshape(-1, 2).T
    return {"centimetres": spread(100 * metres, *names), "degrees": spread(np.degrees(radians), *names)}


def write_json(path: Path, document: Document) -> None:
    """Write a document aside and rename it. Raises ValueError for NaN, OSError for the folder."""
    text = json.dumps(document, indent=2, allow_nan=False) + "\n"
    write_bytes(path, text.encode())


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file aside and rename it, its folder made where there is none. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write_bytes(path, content)


def titled_table(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[str]] = (), *, caption: str | None = None
) -> Table:
    """Make a table for a terminal, numbers to the right of the first column; no columns, no head."""
    table = Table(
        title=title, title_justify="left", title_style="bold", show_header=bool(columns), caption=caption
    )
    for number, column in enumerate(columns):
        table.add_column(column, justify="right" if number else "left")
    for row in rows:
        table.add_row(*row)
    return table


def names_among(words: str, known: Sequence[Name], what: str) -> tuple[Name, ...]:
    """Read a list of names with commas, in the order given. Raises ValueError for a name that is not known."""
    names = [word.strip() for word in words.split(",")]
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"no {what} {', '.join(unknown)}; there are {', '.join(known)}")
    return tuple(known[known.index(name)] for name in names)


def shown(value: float | None, form: str, *, unit: str = "", missing: str = "") -> str:
    """Write a figure in a format, as in `.2f`, and its unit; `missing` where there is none."""
    return missing if value is None else format(value, form) + unit
