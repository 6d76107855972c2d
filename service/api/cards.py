"""The cards of the models in the model store, passed on as they are; the workers are who reads them closely."""

from __future__ import annotations

import json
import logging
import re
from pathlib import Path
from typing import Any

from service.errors import BadRequest, NotFound

log = logging.getLogger(__name__)

Card = dict[str, Any]


class Cards:
    """`<folder>/<name>/<version>/card.json`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def all(self) -> list[Card]:
        """Every card that can be read, by name, newest version first."""
        return [
            card for path in sorted(self._folder.glob("*/*/card.json"), key=_order) if (card := _read(path))
        ]

    def of(self, name: str, version: str | None = None) -> Card:
        """The card of a model, by default of its newest version. Raises NotFound."""
        for card in self.all():
            if card.get("name") == name and version in (None, str(card.get("version"))):
                return card
        wanted = name if version is None else f"{name}/{version}"
        raise NotFound(f"no model {wanted!r}; GET /models lists those there are")

    def check(self, model: str) -> str:
        """`model` (`name/version`) when there is such a card. Raises BadRequest naming those there are."""
        known = [f"{card.get('name')}/{card.get('version')}" for card in self.all()]
        if model not in known:
            there = ", ".join(known) or "none"
            raise BadRequest(f"no model {model!r} in the model store; there is {there}")
        return model


def _order(path: Path) -> tuple[str, list[int]]:
    version = [-int(number) for number in re.findall(r"\d+", path.parent.name)]
    return path.parent.parent.name, version


def _read(path: Path) -> Card | None:
    try:
        card = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        log.warning("the card %s cannot be read: %s", path, error)
        return None
    return card if isinstance(card, dict) else None
