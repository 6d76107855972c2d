"""What a program that breaks things found: counted by kind, a few of each kept, shown as a table and as JSON."""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

_KEPT = 5  # of each kind, to be looked at


@dataclass
class Findings:
    """Outcomes and findings of one run; a finding is what must not happen."""

    cases: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)  #: what became of the cases
    counts: Counter[str] = field(default_factory=Counter)  #: findings by kind
    kept: dict[str, list[str]] = field(default_factory=dict)  #: the first findings of each kind, in words
    slowest_s: float = 0.0

    def add(self, kind: str, words: str) -> None:
        """Count a finding."""
        self.counts[kind] += 1
        kept = self.kept.setdefault(kind, [])
        if len(kept) < _KEPT:
            kept.append(words)

    def merge(self, other: Findings) -> None:
        """Add what another part of the run found."""
        self.cases += other.cases
        self.outcomes += other.outcomes
        self.counts += other.counts
        self.slowest_s = max(self.slowest_s, other.slowest_s)
        for kind, words in other.kept.items():
            self.kept[kind] = [*self.kept.get(kind, []), *words][:_KEPT]

    def document(self, **more: Any) -> dict[str, Any]:
        """Return all of it as JSON has it."""
        return {
            "cases": self.cases,
            "outcomes": dict(self.outcomes),
            "findings": dict(self.counts),
            "kept": self.kept,
            "slowest_s": round(self.slowest_s, 3),
            **more,
        }


class Deadline:
    """A time after which nothing more is begun."""

    def __init__(self, minutes: float) -> None:
        self.begun = time.monotonic()
        self._end = self.begun + 60 * minutes

    def over(self) -> bool:
        """Tell whether the time has come."""
        return time.monotonic() > self._end

    def passed_s(self) -> float:
        """Return the seconds since the run began."""
        return time.monotonic() - self.begun


def add_common(parser: argparse.ArgumentParser, *, minutes: float) -> None:
    """Add the options that every such program has."""
    parser.add_argument("--minutes", type=float, default=minutes, help="after which no more is begun")
    parser.add_argument("--seed", type=int, default=1, help="the same seed gives the same cases")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there as well")


def show(rows: Mapping[str, object], document: Mapping[str, Any], file: Path | None) -> None:
    """Print a table of two columns, and write the document where it is asked for."""
    width = max(len(name) for name in rows)
    for name, value in rows.items():
        print(f"{name:<{width}}  {value}")
    if file is not None:
        file.write_text(json.dumps(document, indent=2) + "\n")
