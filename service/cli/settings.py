"""Settings of the commands that run on the service's own machine."""

from __future__ import annotations

from typing import Any

from pydantic import ValidationError

from service.settings import Settings
from service.up.embedded_redis import LaunchFailed


def read_settings(**given: Any) -> Settings:
    """Return the settings, with what was given in place of what SPICD_* says. Raises `LaunchFailed`."""
    try:
        return Settings(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        first = error.errors()[0]
        name = "SPICD_" + "_".join(str(part) for part in first["loc"]).upper().removeprefix("SPICD_")
        raise LaunchFailed(f"{name}: {first['msg']} (it is {first['input']!r})") from error
