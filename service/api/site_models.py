"""The models of the release and of the site together: what surveys and trainings may name."""

from __future__ import annotations

from service.api.cards import Card
from service.api.services import Services
from service.errors import BadRequest, NotFound, NotReady


def all_cards(services: Services) -> list[Card]:
    """The cards of the model store, then those of the site's own models."""
    return [*services.cards.all(), *_own(services)]


def card_of(services: Services, name: str, version: str | None = None) -> Card:
    """One card, by default of the newest version. Raises NotFound, and NotReady for a model in training."""
    try:
        return services.cards.of(name, version)
    except NotFound:
        number = None if version is None else _number(version)
        found = None if number == 0 else services.catalog.models.find(name, number)
        if found is None:
            raise
    if found.status == "ready" and found.card is not None:
        return found.card
    word = "is still in training" if found.status == "training" else "was not made"
    raise NotReady(f"model {found.model!r} {word}; look at job {found.job_id}")


def check(services: Services, model: str) -> str:
    """`model` (`name/version`) when it can be used. Raises NotReady, and BadRequest naming those there are."""
    name, version = model.split("/", 1)
    try:
        card_of(services, name, version)
    except NotFound:
        there = ", ".join(f"{card.get('name')}/{card.get('version')}" for card in all_cards(services))
        raise BadRequest(f"no model {model!r}; there is {there or 'none'}") from None
    return model


def _own(services: Services) -> list[Card]:
    return [found.card for found in services.catalog.models.ready() if found.card is not None]


def _number(version: str) -> int:
    """0, which no model has, for what is no number of ours."""
    return int(version) if version.isascii() and version.isdigit() and len(version) < 10 else 0
