"""What became of a scan, and how sure a placement is, JSON-ready: the same names as in the API."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from worker.pipeline.registration.diagnosis import Diagnosis
    from worker.pipeline.registration.results import ScanResult, SurveyPlacement


def verdict(outcome: ScanResult) -> dict[str, Any]:
    """Return why a scan was left out, or how sure its pose is and what is odd about it."""
    diagnosis = outcome.diagnosis
    return {
        "accepted": outcome.registration is not None,
        "confidence": outcome.confidence,
        "reason": None if diagnosis is None else diagnosis.reason,
        "detail": None if diagnosis is None else diagnosis.detail,
        "numbers": None if diagnosis is None else _finite(diagnosis.numbers),
        "candidates": None if diagnosis is None else [pose.tolist() for pose in diagnosis.poses] or None,
        "warnings": [_warning(one) for one in outcome.warnings],
    }


def placement_document(placement: SurveyPlacement) -> dict[str, Any]:
    """Return how sure the placement of a survey is."""
    state = "in_doubt" if placement.in_doubt else "confirmed"
    return {"state": state, "confidence": placement.confidence}


def told_numbers(numbers: Mapping[str, float] | None) -> str:
    """Write numbers as `scale 1.012, shift 0.3`."""
    return ", ".join(f"{name.replace('_', ' ')} {value:.4g}" for name, value in (numbers or {}).items())


def told_warnings(warnings: list[dict[str, Any]]) -> str:
    """Write each warning on a line of its own."""
    return "\n".join(f"{one['reason'].replace('_', ' ')}: {one['detail']}" for one in warnings)


def _warning(diagnosis: Diagnosis) -> dict[str, Any]:
    return {
        "reason": diagnosis.reason,
        "detail": diagnosis.detail,
        "numbers": _finite(diagnosis.numbers),
    }


def _finite(numbers: Mapping[str, float]) -> dict[str, float]:
    """Return the numbers as JSON has them; one that could not be measured is not there."""
    return {name: float(value) for name, value in numbers.items() if math.isfinite(value)}
