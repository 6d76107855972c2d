"""The options of both command lines are fields of the settings."""

from __future__ import annotations

import sys
from dataclasses import asdict, fields
from pathlib import Path

import pytest

from worker.training import __main__ as command
from worker.training.options import OPTIONS, with_options
from worker.training.pairs import PairSettings
from worker.training.publish import training_command
from worker.training.settings import PAPER, TrainSettings


@pytest.mark.parametrize("option", OPTIONS, ids=lambda option: option.name)
def test_every_option_is_a_field(option):
    settings = PairSettings if option.of_pairs else TrainSettings
    assert option.name in {field.name for field in fields(settings)}


@pytest.mark.parametrize("option", OPTIONS, ids=lambda option: option.name)
def test_every_text_names_the_default(option):
    settings = TrainSettings()
    value = getattr(settings.pairs if option.of_pairs else settings, option.name)
    told = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
    told = {"False": "no", "None": "no limit" if option.kind is float else "none"}.get(told, told)
    assert option.help.endswith(f"(default: {told}).")


def test_what_is_given_takes_the_place_of_the_default_and_nothing_else_does():
    given = {"epochs": 3, "edited_share": 0.0, "density": [0.1, 0.2], "minutes": None, "folder": Path()}
    made = with_options(PAPER, given, device="cuda")
    assert (made.epochs, made.minutes, made.device, made.coarse_search) == (3, None, "cuda", False)
    assert (made.pairs.edited_share, made.pairs.density) == (0.0, (0.1, 0.2))
    assert made.pairs.matched_pairs is PAPER.pairs.matched_pairs


def test_the_bare_command_line_takes_them_all(monkeypatch, tmp_path, capsys):
    seen = []

    def train(settings, tiles, folder, progress):
        seen.append((settings, tiles, folder))
        return folder / "best.pt"

    words = [
        word
        for option in OPTIONS
        for word in (option.flag, *["1"] * option.count * (option.kind is not bool))
    ]
    monkeypatch.setattr(command, "train", train)
    monkeypatch.setattr(sys, "argv", ["train", "tiles.npz", str(tmp_path), "--device", "cpu", *words])
    command.main()
    ((settings, tiles, folder),) = seen
    assert (tiles, folder) == (Path("tiles.npz"), tmp_path)
    for option in OPTIONS:
        value = getattr(settings.pairs if option.of_pairs else settings, option.name)
        assert value == ((1.0, 1.0) if option.count == 2 else option.kind(1))
    assert capsys.readouterr().out == f"{tmp_path / 'best.pt'}\n"


@pytest.mark.parametrize("preset", [TrainSettings(), PAPER], ids=["ours", "paper"])
def test_the_command_of_a_checkpoint_gives_its_settings_again(preset):
    given = {"detector": "kpconv", "minutes": 2.5, "counts": True, "density": [0.1, 0.4], "head_epochs": 7}
    settings = with_options(preset, given, device="cpu")
    words = training_command(asdict(settings)).split()
    assert words[:3] == ["spicd-worker", "train", "FOLDER"]
    assert ("--paper" in words) is (preset is PAPER)
    told = {option.name: words[words.index(option.flag) + 1 :] for option in OPTIONS if option.flag in words}
    read = {
        option.name: True
        if option.kind is bool
        else [option.kind(word) for word in told[option.name][: option.count]]
        for option in OPTIONS
        if option.name in told
    }
    read = {
        name: value[0] if isinstance(value, list) and len(value) == 1 else value
        for name, value in read.items()
    }
    assert read == given
    assert with_options(preset, read, device="cpu") == settings


def test_the_command_names_what_it_started_from_but_not_where_that_lay():
    settings = {**asdict(TrainSettings()), "start_from": "/home/somebody/run/last.pt"}
    assert training_command(settings) == "spicd-worker train FOLDER --start-from run/last.pt"
