"""`spicd up` and `python -m worker` as commands: without what they need they say so and leave."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from service.settings import Settings
from service.up import requirements
from service.up.embedded_redis import LaunchFailed
from service.up.requirements import require_model, require_queue

ROOT = Path(__file__).parents[3]
WITHIN_S = 120


def ended(folder: Path, *command: str, **settings: str) -> tuple[int, str]:
    """Run a command until it ends; its status and everything it said."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("SPICD_")}
    environment |= {f"SPICD_{name.upper()}": value for name, value in settings.items()}
    environment |= {"SPICD_DATA_DIR": str(folder / "data"), "COLUMNS": "1000"}
    asked = subprocess.run(
        [sys.executable, "-m", *command],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=WITHIN_S,
        check=False,
    )
    return asked.returncode, " ".join((asked.stdout + asked.stderr).split())


@pytest.fixture(scope="module")
def dead_url() -> str:
    """A Redis that is not there: the port was free a moment ago."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        return f"redis://127.0.0.1:{taken.getsockname()[1]}"


no_gpu = pytest.mark.skipif(Path("/dev/nvidia0").exists(), reason="this machine has a GPU")
UP = ("service", "up", "--port", "0", "--geometry-workers", "0")


@pytest.mark.slow
def test_up_with_a_dead_redis_says_so_and_leaves(tmp_path: Path, dead_url: str) -> None:
    status, said = ended(tmp_path, *UP, "--inference-workers", "0", redis_url=dead_url)
    assert status == 1
    assert "SPICD_REDIS_URL names no Redis that can be used" in said
    assert "is up" not in said


@pytest.mark.slow
def test_up_with_a_url_of_something_else_says_so_at_once(tmp_path: Path) -> None:
    status, said = ended(tmp_path, *UP, "--inference-workers", "0", redis_url="localhost:6379")
    assert status == 1
    assert "SPICD_REDIS_URL" in said
    assert "is up" not in said


@pytest.mark.slow
def test_up_with_an_unknown_model_names_those_there_are(tmp_path: Path) -> None:
    status, said = ended(tmp_path, *UP, "--inference-workers", "0", model="voxel-nett/1")
    assert status == 1
    assert "SPICD_MODEL is 'voxel-nett/1', and there is no such model" in said
    assert "voxel-net/1" in said
    assert "is up" not in said


@pytest.mark.slow
@no_gpu
def test_up_with_cuda_and_no_gpu_says_so_and_leaves(tmp_path: Path) -> None:
    status, said = ended(tmp_path, *UP, "--inference-workers", "1", device="cuda")
    assert status == 1
    assert "SPICD_DEVICE is cuda, but torch finds no CUDA GPU" in said
    assert "is up" not in said


@pytest.mark.slow
def test_a_worker_alone_with_a_dead_redis_says_so_and_leaves(tmp_path: Path, dead_url: str) -> None:
    status, said = ended(tmp_path, "worker", "geometry", redis_url=dead_url)
    assert status == 2
    assert "SPICD_REDIS_URL names no Redis that can be used" in said


@pytest.mark.slow
@no_gpu
def test_the_device_of_a_worker_can_be_checked_by_itself(tmp_path: Path) -> None:
    assert ended(tmp_path, "worker", "check", "geometry", device="cuda") == (0, "")
    status, said = ended(tmp_path, "worker", "check", "inference", device="cuda")
    assert status == 2
    assert said.startswith("SPICD_DEVICE is cuda, but torch finds no CUDA GPU; set it to auto or cpu")


def test_a_redis_that_starts_a_moment_later_is_waited_for(
    monkeypatch: pytest.MonkeyPatch, dead_url: str
) -> None:
    answers = iter([ConnectionError("not yet"), ConnectionError("not yet"), None])
    monkeypatch.setattr(requirements, "_queue_error", lambda url: next(answers))
    monkeypatch.setattr(requirements, "_AGAIN_S", 0.0)
    require_queue(Settings(redis_url=dead_url))
    assert next(answers, "asked thrice") == "asked thrice"


def test_a_model_without_its_weights_is_told(tmp_path: Path) -> None:
    folder = tmp_path / "voxel-net" / "1"
    folder.mkdir(parents=True)
    settings = Settings(model_store=tmp_path, data_dir=tmp_path)
    (folder / "card.json").write_text('{"weights": "weights.safetensors"}')
    with pytest.raises(LaunchFailed, match=r"its weights .*weights.safetensors are not there"):
        require_model(settings)
    (folder / "weights.safetensors").touch()
    require_model(settings)
