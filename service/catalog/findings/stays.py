"""How long a change of a tile stays: from the first look that sees it changed to the last before it is as it was."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime


@dataclass(frozen=True, kw_only=True, slots=True)
class Look:
    """What one survey says of one tile, where it could say something."""

    survey_id: str
    captured_at: datetime
    map_version: int  #: that the survey was compared with
    score: float | None  #: probability of change where it is changed; None where it is not

    @property
    def changed(self) -> bool:
        """Whether the tile is changed."""
        return self.score is not None


@dataclass(frozen=True, kw_only=True, slots=True)
class Stay:
    """A change over the surveys that saw it."""

    told_by: str  #: the survey whose tile stands for it
    survey_ids: tuple[str, ...]  #: all that saw it, in order of time
    first_seen: datetime
    last_seen: datetime
    max_score: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Known:
    """A change of the same tile as it was told so far."""

    change_id: str
    told_by: str  #: the survey whose tile stood for it
    survey_ids: frozenset[str]  #: that saw it and are still there


def recognized(found: Sequence[Stay], known: Iterable[Known]) -> dict[int, Known]:
    """Return which of `found` goes on as which change of `known`, by its place; both are of one tile.

    The changes come oldest first. Each goes on as the stay of the visit that stood for it, and where that does not see
    it any more as the one that shares most visits with it, unless an older change goes on as that.
    """
    named: dict[int, Known] = {}
    for one in known:
        shares = {n: _shared(stay, one) for n, stay in enumerate(found) if n not in named}
        best = max(shares, key=lambda n: (shares[n], -n), default=None)
        if best is not None and shares[best] > (False, 0):
            named[best] = one
    return named


def heir(found: Sequence[Stay], lost: Known) -> int | None:
    """Return the place of the stay that a change went up in which is told no more; None where no visit sees it."""
    shares = {n: _shared(stay, lost) for n, stay in enumerate(found)}
    best = max(shares, key=lambda n: (shares[n], -n), default=None)
    return best if best is not None and shares[best] > (False, 0) else None


def _shared(stay: Stay, known: Known) -> tuple[bool, int]:
    """Return whether a stay has the visit that stood for a change, and how many of its visits."""
    return known.told_by in stay.survey_ids, len(known.survey_ids.intersection(stay.survey_ids))


def stays(
    looks: Iterable[Look], *, accepted_in: Collection[int] = (), told_by: Collection[str] = ()
) -> list[Stay]:
    """Return the stays of the changes of one tile, whose looks may come in any order.

    `accepted_in` are the versions that took the tile over from a survey: what changes against a later map is another
    change. `told_by` are surveys that stood for a change before; one of them goes on doing so, that a change which is
    known does not come up as a new one because an earlier visit was sent late.
    """
    by_epoch: dict[int, list[Look]] = {}
    for look in sorted(looks, key=lambda look: (look.captured_at, look.survey_id)):
        epoch = sum(version <= look.map_version for version in accepted_in)
        by_epoch.setdefault(epoch, []).append(look)
    return [_stay(run, told_by) for epoch in sorted(by_epoch) for run in _runs(by_epoch[epoch])]


def _runs(looks: Sequence[Look]) -> list[list[Look]]:
    """Return the looks that see the tile changed, parted where one between sees it as it was."""
    runs: list[list[Look]] = []
    changed = False
    for look in looks:
        if look.changed and changed:
            runs[-1].append(look)
        elif look.changed:
            runs.append([look])
        changed = look.changed
    return runs


def _stay(run: Sequence[Look], told_by: Collection[str]) -> Stay:
    told = next((look.survey_id for look in run if look.survey_id in told_by), run[0].survey_id)
    return Stay(
        told_by=told,
        survey_ids=tuple(look.survey_id for look in run),
        first_seen=run[0].captured_at,
        last_seen=run[-1].captured_at,
        max_score=max(look.score or 0.0 for look in run),
    )
