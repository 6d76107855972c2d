"""Decoders in a process of their own: whatever ends that process is an error of one file."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest

from tests.support.clouds import write_las
from worker.cloud.formats import apart
from worker.cloud.formats.scan import read_scan
from worker.errors import ScanError, ScanTooLarge

POINTS = np.random.default_rng(0).uniform(-3, 3, (100, 3))


def standin(folder: Path, monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    """Have another program decode: one that does what a decoder in C++ may do."""
    package = folder / "worker/cloud/formats"
    package.mkdir(parents=True)
    for module in ("worker", "worker/cloud", "worker/cloud/formats"):
        (folder / module / "__init__.py").touch()
    (package / "apart.py").write_text(code)
    monkeypatch.setattr(apart, "_ROOT", folder)


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("import os; os.kill(os.getpid(), 11)", r"crashed \(SIGSEGV\)"),
        ("import os; os.abort()", r"crashed \(SIGABRT\)"),
        ("import os; os.kill(os.getpid(), 9)", "was killed"),
        ("raise SystemExit(3)", "ended with status 3"),
        ("print('not json')", "ended with status 0"),
    ],
)
def test_a_decoder_that_dies_is_an_error_of_its_file(tmp_path, monkeypatch, code, said):
    path = write_las(tmp_path / "room.laz", POINTS)
    standin(tmp_path, monkeypatch, code)
    with pytest.raises(ScanError, match=rf"^room.laz: its decoder {said}, so the file is damaged"):
        read_scan(path)


def test_a_decoder_that_hangs_is_ended(tmp_path, monkeypatch):
    path = write_las(tmp_path / "room.laz", POINTS)
    standin(tmp_path, monkeypatch, "import time; time.sleep(1000)")
    monkeypatch.setattr(apart, "_seconds", lambda *_: 0.5)
    with pytest.raises(ScanError, match="it was not decoded within"):
        read_scan(path)


def test_a_decoder_that_asks_for_too_much_memory_is_an_error_of_its_file(tmp_path, monkeypatch):
    path = write_las(tmp_path / "room.laz", POINTS)
    code = Path(apart.__file__).read_text()
    root = Path(apart.__file__).parents[3]
    ours = f"import sys; sys.path.insert(0, {str(root)!r})\nfor name in [*sys.modules]:\n"
    ours += "    if name.startswith('worker'):\n        del sys.modules[name]\n"
    standin(tmp_path, monkeypatch, ours + greedy(code))
    with pytest.raises(ScanTooLarge, match="do not fit in memory"):
        read_scan(path)


def greedy(code: str) -> str:
    """The decoder itself, under its own limits, but that it wants 2 GiB."""
    body = code.partition("from __future__ import annotations\n")[2]
    return body.replace("def _decoded(", "def _decoded(*_):\n    return bytes(2**31)\n\n\ndef _unused(")


def test_a_full_disk_is_told_as_such(tmp_path, monkeypatch):
    path = write_las(tmp_path / "room.laz", POINTS)
    standin(tmp_path, monkeypatch, "print('{\"disk\": true}')")
    with pytest.raises(OSError, match="full") as error:
        read_scan(path)
    assert error.value.errno == errno.ENOSPC


def test_the_decoder_knows_no_secret_of_the_worker(tmp_path, monkeypatch):
    path = write_las(tmp_path / "room.laz", POINTS)
    monkeypatch.setenv("SPICD_DATABASE_URL", "postgresql://name:secret@host/db")
    standin(
        tmp_path,
        monkeypatch,
        "import json, os; print(json.dumps({'error': ' '.join(os.environ), 'code': 'scan_unreadable'}))",
    )
    with pytest.raises(ScanError) as error:
        read_scan(path)
    assert "PYTHONPATH" in str(error.value)
    assert "SPICD" not in str(error.value)


def test_nothing_is_left_in_the_temporary_folder(tmp_path, monkeypatch):
    path = write_las(tmp_path / "room.laz", POINTS)
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(scratch))
    assert len(read_scan(path).points) == len(POINTS)
    assert not list(scratch.iterdir())
