"""The cards of models, of the release and of the site, passed on as they are; the workers read them closely."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

from service.catalog.models import Models
from service.errors import BadRequest, Failed, NotFound, NotReady

log = logging.getLogger(__name__)

Card = dict[str, Any]


class Cards:
    """The models of the release, `<folder>/<name>/<version>/card.json`, and those that the site trained."""

    def __init__(self, folder: Path, models: Models) -> None:
        self._folder = folder
        self._models = models

    def released(self) -> list[Card]:
        """Return every card of the model store that can be read, by name, newest version first."""
        return [
            card for path in sorted(self._folder.glob("*/*/card.json"), key=_order) if (card := _read(path))
        ]

    def all(self, maps: Collection[str] | None = None) -> list[Card]:
        """Return the cards of the model store, then those that the site trained, on these `maps` or on any."""
        trained = (model for model in self._models.ready() if maps is None or model.map_id in maps)
        return [*self.released(), *(model.card for model in trained if model.card is not None)]

    def of(self, name: str, version: str | None = None, maps: Collection[str] | None = None) -> Card:
        """Return one card, by default of the newest version. Raises NotFound, and NotReady for a model in training.

        With `maps` a model that was trained on another one is not found.
        """
        for card in self.released():
            if card.get("name") == name and version in (None, str(card.get("version"))):
                return card
        number = None if version is None else _number(version)
        model = None if number == 0 else self._models.find(name, number, maps)
        if model is None:
            wanted = name if version is None else f"{name}/{version}"
            raise NotFound(f"no model {wanted!r}; GET /models lists those there are")
        if model.status == "ready" and model.card is not None:
            return model.card
        if model.status == "training":
            raise NotReady(f"model {model.model!r} is still in training; follow job {model.job_id}")
        raise Failed(f"model {model.model!r} was not made; job {model.job_id} says why")

    def check(self, model: str, maps: Collection[str] | None = None) -> str:
        """Return `model` (`name/version`) if it can be used. Raises NotReady, and BadRequest naming those there are."""
        name, version = model.split("/", 1)
        try:
            self.of(name, version, maps)
        except NotFound:
            raise BadRequest(f"no model {model!r}; there is {_listed(self.all(maps))}") from None
        return model

    def check_released(self, model: str) -> str:
        """Return `model` when the model store has its card. Raises BadRequest naming those there are."""
        cards = self.released()
        if model not in map(_name, cards):
            raise BadRequest(f"no model {model!r} in the model store; there is {_listed(cards)}")
        return model


def _name(card: Card) -> str:
    return f"{card.get('name')}/{card.get('version')}"


def _listed(cards: list[Card]) -> str:
    return ", ".join(map(_name, cards)) or "none"


def _number(version: str) -> int:
    """Return 0, which no model has, for what is no number of ours."""
    return int(version) if version.isascii() and version.isdigit() and len(version) < 10 else 0


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
