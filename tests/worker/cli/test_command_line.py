"""A result says which command made it: what was chosen, and nothing of the machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import pytest
import typer

from worker.cli.command_line import command_line


def told(*words: str) -> str:
    """What a command with a few options says of itself."""
    found = []

    def taste(
        context: typer.Context,
        model: Annotated[str, typer.Option(envvar="TASTE_MODEL")] = "plain/1",
        weights: Annotated[list[Path] | None, typer.Option()] = None,
        salt: Annotated[bool, typer.Option()] = True,
        quick: Annotated[bool, typer.Option("--quick")] = False,
        out: Annotated[Path | None, typer.Option()] = None,
    ) -> None:
        found.append(command_line(context))

    app = typer.Typer()
    app.command("taste")(taste)
    app.command("other")(lambda: None)
    app(args=["taste", *words], prog_name="cook", standalone_mode=False)
    return found[0]


def test_defaults_and_places_are_not_told() -> None:
    assert told("--out", "somewhere", "--model", "plain/1") == "cook taste"


def test_options_are_told_as_one_would_type_them() -> None:
    words = told("--weights", "a b.pt", "--weights", "c.pt", "--no-salt", "--quick")
    assert words == "cook taste --weights 'a b.pt' --weights c.pt --no-salt --quick"


def test_an_argument_is_told_without_a_flag_and_a_folder_without_its_place() -> None:
    found = []

    def taste(context: typer.Context, folder: Path, times: int) -> None:
        found.append(command_line(context))

    app = typer.Typer()
    app.command("taste")(taste)
    app.command("other")(lambda: None)
    app(args=["taste", "/home/somebody", "3"], prog_name="cook", standalone_mode=False)
    assert found == ["cook taste FOLDER 3"]


def test_what_the_environment_chose_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TASTE_MODEL", "rich/2")
    assert told() == "cook taste --model rich/2"


def test_a_file_below_the_working_folder_is_told_by_its_way_from_there(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    assert told("--weights", str(tmp_path / "run" / "best.pt")) == "cook taste --weights run/best.pt"
