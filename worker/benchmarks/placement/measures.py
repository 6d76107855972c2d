"""The figures: each row of the table with its rates and intervals, what was named, and how far confidence is right."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np

from worker.benchmarks.documents import Document, spread
from worker.benchmarks.placement.answers import ScanAnswer, TrialAnswer, Verdict
from worker.benchmarks.placement.plan import EXPECTED, KINDS, Kind, Trial
from worker.cloud.types import Floats

VERDICTS: tuple[Verdict, ...] = get_args(Verdict)
Z = 1.959964  #: standard deviations on either side that hold 95% of a normal distribution
BINS = 10  #: of the reliability curve
TARGET_OVERLAP, TARGET_SHARE = 0.3, 0.25  #: what the target for right scans is stated for


@dataclass(frozen=True, kw_only=True, slots=True)
class Answered:
    """A trial with what was said of it."""

    trial: Trial
    answer: TrialAnswer


def wilson(hits: int, total: int) -> tuple[float, float]:
    """Return the 95% interval of a rate (Wilson 1927); 0 to 1 where nothing was tried."""
    if total == 0:
        return 0.0, 1.0
    rate, z2 = hits / total, Z * Z
    middle = (rate + z2 / (2 * total)) / (1 + z2 / total)
    half = Z / (1 + z2 / total) * float(np.sqrt(rate * (1 - rate) / total + z2 / (4 * total**2)))
    return max(0.0, middle - half), min(1.0, middle + half)


def document(answered: Sequence[Answered]) -> Document:
    """Return all figures, JSON-ready."""
    rows = dict.fromkeys(one.trial.row for one in sorted(answered, key=_order))
    return {
        "rows": [
            {"name": name, **figures([one for one in answered if one.trial.row == name])} for name in rows
        ],
        "targets": targets(answered),
        "reliability": reliability(answered),
        "error_curve": error_curve(answered),
    }


def figures(answered: Sequence[Answered]) -> Document:
    """Count what was said of the scans of some trials."""
    scans = [scan for one in answered for scan in one.answer.scans]
    verdicts = Counter(scan.verdict for scan in scans)
    near = [scan for scan in scans if scan.near]
    return {
        "surveys": len(answered),
        "scans": len(scans),
        "here": sum(scan.here for scan in scans),
        **{verdict.replace(" ", "_"): verdicts[verdict] for verdict in VERDICTS},
        "wrong_rate": _rate(verdicts["wrong"], len(scans)),
        "right_rate": _rate(verdicts["right"], sum(scan.here for scan in scans)),
        "good": sum(scan.good for scan in near),
        "centimetres": spread([100 * (scan.metres or 0.0) for scan in near], "median", "95%", "worst"),
        "degrees": spread([scan.degrees or 0.0 for scan in near], "median", "95%", "worst"),
        "reasons": dict(Counter(name for scan in scans for name in scan.named).most_common()),
        "named": sum(_named(one) for one in answered),
        "seconds": spread([one.answer.seconds for one in answered], "median", "95%"),
    }


def targets(answered: Sequence[Answered]) -> Document:
    """Count what the targets speak of: impostors believed, mirrored and scaled ones believed, right ones lost."""
    impostors = [one for one in answered if one.trial.impostor]
    others = [one for one in impostors if not one.trial.same_plan]
    spoilt = [scan for one in answered for scan in _spoilt(one)]
    wrong = sum(scan.verdict == "wrong" for scan in spoilt)
    fair = [scan for one in answered if _fair(one.trial) for scan in one.answer.scans]
    lost = sum(scan.verdict != "right" for scan in fair)
    good = [scan for scan in fair if scan.verdict == "right"]
    return {
        "impostors_believed": _believed(impostors),
        "believed_of_other_plans": _believed(others),
        "mirrored_or_scaled_believed": {"of": len(spoilt), "count": wrong, **_rate(wrong, len(spoilt))},
        "right_lost": {"of": len(fair), "count": lost, **_rate(lost, len(fair))},
        "right_within_3_cm": {"of": len(good), "count": sum(scan.good for scan in good)},
    }


def _believed(impostors: Sequence[Answered]) -> Document:
    """Count the surveys of which a scan is believed."""
    count = sum(any(scan.verdict == "wrong" for scan in one.answer.scans) for one in impostors)
    return {"of": len(impostors), "count": count, **_rate(count, len(impostors))}


def reliability(answered: Sequence[Answered]) -> list[Document]:
    """Return, bin by bin of the confidence of a survey's placement, how often all its accepted scans were right."""
    stated = [
        (one.answer.confidence, all(scan.near for scan in one.answer.scans if scan.accepted))
        for one in answered
        if one.answer.confidence is not None and any(scan.accepted for scan in one.answer.scans)
    ]
    rows = []
    for number in range(BINS):
        low, high = number / BINS, (number + 1) / BINS
        inside = [
            (confidence, right)
            for confidence, right in stated
            if low <= confidence < high or confidence == high == 1
        ]
        if inside:
            right = sum(right for _, right in inside)
            rows.append(
                {
                    "surveys": len(inside),
                    "confidence": float(np.mean([confidence for confidence, _ in inside])),
                    "right": right,
                    **_rate(right, len(inside)),
                }
            )
    return rows


def error_curve(answered: Sequence[Answered], *, steps: int = 101) -> Document:
    """Return over the bar on a survey's confidence: impostors believed, and right scans lost by changed share.

    Right surveys have one scan and lie on maps that look nowhere the same again. A survey without a confidence
    counts as 1 where a scan was accepted and is not in doubt, else as 0.
    """
    bars = np.linspace(0.0, 1.0, steps)
    impostors = np.array([_score(one.answer) for one in answered if one.trial.impostor])
    groups: dict[str, list[float]] = {}
    for one in answered:
        if one.trial.kind == "right" and not one.trial.site.repeats and one.trial.scans == 1:
            right = any(scan.near for scan in one.answer.scans)
            groups.setdefault(f"{one.trial.amount:.0%}", []).append(_score(one.answer) if right else 0.0)
    return {
        "bars": bars.tolist(),
        "believed": _at_least(impostors, bars).tolist(),
        "lost": {name: (1 - _at_least(np.array(scores), bars)).tolist() for name, scores in groups.items()},
    }


def _score(answer: TrialAnswer) -> float:
    if not any(scan.accepted for scan in answer.scans):
        return 0.0
    return float(not answer.in_doubt) if answer.confidence is None else answer.confidence


def _at_least(scores: Floats, bars: Floats) -> Floats:
    """Return the share of the scores (N,) at or over each bar (B,), none of those that are 0."""
    if not len(scores):
        return np.zeros(len(bars))
    share: Floats = ((scores[:, None] >= bars) & (scores[:, None] > 0)).mean(axis=0)
    return share


def _spoilt(one: Answered) -> list[ScanAnswer]:
    """Return the scans that are mirrored, or off in scale by 2% and more."""
    return [s for s in one.answer.scans if one.trial.kind in ("mirrored", "scaled") and not s.here]


def _named(one: Answered) -> int:
    """Count the scans of which the reason was told that the kind is about."""
    expected = EXPECTED.get(one.trial.kind, ())
    return sum(any(reason in expected for reason in scan.named) for scan in one.answer.scans)


def _fair(trial: Trial) -> bool:
    """Whether the target for right scans speaks of it."""
    kinds: tuple[Kind, ...] = ("right", "low-overlap")
    return trial.kind in kinds and not trial.site.repeats and trial.amount <= TARGET_SHARE


def _rate(hits: int, total: int) -> Document:
    low, high = wilson(hits, total)
    return {"rate": hits / total if total else None, "low": low, "high": high}


def _order(one: Answered) -> tuple[int, bool, float]:
    return KINDS.index(one.trial.kind), one.trial.prior, one.trial.amount
