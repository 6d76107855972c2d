"""A command as it was given, for results that say what made them."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import typer

#: Where results go and where models lie: of one machine, and no part of what was measured.
PLACES = ("out", "model_store", "as_json")


def command_line(context: typer.Context) -> str:
    """Return the command with every option that differs from its default, also one that the environment set."""
    words = [context.command_path]
    for option in context.command.params:
        value = context.params.get(str(option.name))
        if option.name in context.params and option.name not in PLACES and value != option.default:
            words += _spelled(option, value)
    return " ".join(words)


def _spelled(option: Any, value: Any) -> list[str]:
    if option.param_type_name == "argument":  # a folder of somebody's machine is told as its help calls it
        return [str(option.name).upper() if isinstance(value, Path) else shlex.quote(str(value))]
    if isinstance(value, bool):
        return [option.opts[0] if value else option.secondary_opts[0]]
    values = value if isinstance(value, list | tuple) else [value]
    return [word for item in values for word in (option.opts[0], shlex.quote(str(_from_here(item))))]


def _from_here(value: Any) -> Any:
    """Name a file below the working folder by its way from there."""
    here = Path.cwd()
    return value.relative_to(here) if isinstance(value, Path) and value.is_relative_to(here) else value
