"""The memory of a step: past its limit an allocation fails in order."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from service.settings import Settings
from worker import memory
from worker.__main__ import limit_inference
from worker.errors import OutOfMemory

GIB = 1024**3


def in_a_process(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


class OfGpu:
    """A GPU's memory of which a process says how much it may take."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.shares: list[float] = []
        monkeypatch.setattr("torch.cuda.is_available", lambda: True)
        monkeypatch.setattr("torch.cuda.set_per_process_memory_fraction", self.shares.append)


@pytest.mark.parametrize(
    ("share", "workers", "asked"),
    [(None, 1, []), (None, 2, [0.45]), (None, 3, [0.3]), (0.25, 1, [0.25]), (0.5, 3, [0.5]), (1.0, 2, [])],
)
def test_workers_on_one_gpu_have_a_share_of_its_memory_each(
    monkeypatch: pytest.MonkeyPatch, share: float | None, workers: int, asked: list[float]
) -> None:
    gpu = OfGpu(monkeypatch)
    settings = Settings(inference_gpu_share=share, inference_workers=workers, step_memory_bytes=GIB)
    assert limit_inference(settings) == 0  # of the processor's memory: CUDA maps far more than it uses
    assert gpu.shares == pytest.approx(asked)


def test_a_worker_that_leaves_the_gpu_alone_takes_no_share_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    gpu = OfGpu(monkeypatch)
    monkeypatch.setattr("worker.__main__.limit_memory", lambda most: most)
    assert limit_inference(Settings(device="cpu", inference_gpu_share=0.5, step_memory_bytes=GIB)) == GIB
    assert gpu.shares == []


def test_an_allocation_past_the_limit_fails_and_one_within_it_does_not() -> None:
    code = """
import numpy as np
from worker.memory import limit_memory
print(limit_memory(1 << 30))
np.ones(50_000_000)
try:
    np.ones(200_000_000)
except MemoryError:
    print("refused")
"""
    assert in_a_process(code).split() == [str(GIB), "refused"]


def test_a_process_that_is_started_has_the_limit_as_well() -> None:
    code = """
import resource
from worker.memory import limit_memory
from worker.processes import open_processes
if __name__ == "__main__":
    limit_memory(3 << 30)
    with open_processes(2) as processes:
        print(list(processes.map_unordered(resource.getrlimit, [resource.RLIMIT_DATA]))[0][0])
"""
    assert in_a_process(code) == str(3 * GIB)


def test_a_scan_past_the_limit_is_too_large(tmp_path: Path) -> None:
    path = tmp_path / "scan.pcd"
    with path.open("wb") as file:
        head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 40000000\nHEIGHT 1\nDATA binary\n"
        file.write(head.encode())
        file.truncate(len(head) + 40_000_000 * 12)
    code = f"""
from pathlib import Path
from worker.cloud.formats.scan import read_scan
from worker.errors import ScanTooLarge
from worker.memory import limit_memory
limit_memory(400 << 20)
try:
    read_scan(Path({str(path)!r}))
except ScanTooLarge as error:
    print(error)
"""
    assert in_a_process(code) == "scan.pcd: its points do not fit in memory; split or thin the scan"


def test_none_is_a_share_of_the_machine_and_nought_is_no_limit() -> None:
    code = "from worker.memory import limit_memory; print(limit_memory(None), limit_memory(0))"
    first, second = in_a_process(code).split()
    assert int(first) == int(memory.SHARE * memory.available_memory())
    assert second == "0"


@pytest.mark.parametrize(("text", "expected"), [("1073741824\n", GIB), ("max\n", None)])
def test_a_container_s_limit_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, expected: int | None
) -> None:
    machine = memory.available_memory()
    limit = tmp_path / "memory.max"
    limit.write_text(text)
    monkeypatch.setattr(memory, "_LIMITS", (limit, tmp_path / "missing"))
    assert memory.available_memory() == expected or machine <= memory.available_memory()


@pytest.mark.parametrize(
    "error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory: 8 bytes")]
)
def test_an_allocation_that_failed_is_told_with_what_to_do(error: Exception) -> None:
    expected = pytest.raises(
        OutOfMemory, match=r"the registration needs more memory .* SPICD_STEP_MEMORY_BYTES"
    )
    with expected, memory.as_out_of_memory("the registration"):
        raise error


def test_another_error_stays_what_it_is() -> None:
    with pytest.raises(RuntimeError, match="shapes differ"), memory.as_out_of_memory("a step"):
        raise RuntimeError("shapes differ")


def test_an_inference_worker_is_limited_as_a_step_is() -> None:
    code = f"""
import numpy as np, torch
from service.settings import Settings
from worker.__main__ import limit_inference
from worker.errors import OutOfMemory
from worker.memory import as_out_of_memory
print(limit_inference(Settings(device="cpu", step_memory_bytes={2 * GIB})))
try:
    with as_out_of_memory("a step"):
        torch.ones(800_000_000)
except OutOfMemory:
    print("refused")
"""
    assert in_a_process(code).split() == [str(2 * GIB), "refused"]


def test_an_inference_worker_with_a_gpu_is_not_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    limited: list[object] = []
    monkeypatch.setattr("worker.__main__.limit_memory", limited.append)
    monkeypatch.setattr("worker.jobs.models.finds_gpu", lambda: True)
    assert limit_inference(Settings(device="auto", step_memory_bytes=GIB)) == 0
    assert not limited
