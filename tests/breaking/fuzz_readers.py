"""Reads mutated PLY and PCD files, with `--packed` E57, LAS and LAZ: `python -m tests.breaking.fuzz_readers`.

A file may be refused (ScanError) or read; read, it has as many points as it declares, all finite. Files go to a forked
process in batches, under a limit of memory; one that dies or hangs costs its batch's rest no more than a new process.
Exit status 1 for a crash, another exception, over 2 s or over 1 GB for a file, or a wrong count. `--only` runs one case.
The decoders of packed files are other people's, and run in a process of their own, which they may crash: that alone is
an outcome and no finding.
"""

from __future__ import annotations

import argparse
import mmap
import os
import pickle
import random
import re
import resource
import signal
import struct
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from tests.breaking.packed_mutations import PackedSample, packed_samples
from tests.breaking.scan_mutations import Sample, mutated, samples
from tests.support.clouds import without_checksums
from tests.support.findings import Deadline, Findings, add_common, show
from worker.cloud.formats.scan import Scan, read_scan
from worker.errors import ScanError

HANG_S = 2.0  #: for one small file
MEMORY = 1024**3  #: bytes that reading a small file may allocate
_BATCH = 5_000  # files of one process
_STUCK_S = 10 * HANG_S  # without a step forward the process itself is ended


class Hang(BaseException):
    """A file took longer than it may."""


@dataclass(frozen=True)
class Fuzz:
    """The cases of a run: case `i` is the same whatever was run before it."""

    samples: Sequence[Sample | PackedSample]
    seed: int

    def content(self, i: int) -> bytes:
        """Return the file of a case."""
        rng = random.Random((self.seed << 40) + i)
        sample = rng.choice(self.samples)
        return sample.mutated(rng) if isinstance(sample, PackedSample) else mutated(sample, rng)


def main(arguments: list[str] | None = None) -> int:
    """Run as told; returns the exit status."""
    options = _parse(arguments)
    fuzz = Fuzz(packed_samples() if options.packed else samples(), options.seed)
    if options.only is not None:
        return _run_one(fuzz, options.only)
    deadline, found = Deadline(options.minutes), Findings()
    for start in range(0, options.files, _BATCH):
        if deadline.over():
            break
        found.merge(run_batch(fuzz, start, min(start + _BATCH, options.files)))
        print(f"{found.cases:,} files, {sum(found.counts.values())} findings", file=sys.stderr)
    seconds = deadline.passed_s()
    rows: dict[str, object] = {
        "files": f"{found.cases:,} in {seconds:.0f} s ({found.cases / max(seconds, 1e-9):,.0f} a second)",
        **{f"  {kind}": f"{count:,}" for kind, count in found.outcomes.most_common()},
        **{kind: found.counts[kind] for kind in ("crash", "exception", "hang", "memory", "wrong")},
        "slowest file": f"{1000 * found.slowest_s:.0f} ms",
    }
    show(rows, found.document(seconds=round(seconds, 1), seed=options.seed), options.json)
    for kind, words in found.kept.items():
        print("\n".join(f"{kind}: {line}" for line in words))
    return 1 if found.counts else 0


def run_batch(fuzz: Fuzz, start: int, stop: int) -> Findings:
    """Run the cases [start, stop) in forked processes, a new one behind each case that ends one."""
    found = Findings()
    while start < stop:
        part, start = _forked(fuzz, start, stop)
        found.merge(part)
    return found


def _forked(fuzz: Fuzz, start: int, stop: int) -> tuple[Findings, int]:
    """Run cases in one process; return what it found, and the case to go on with."""
    at = mmap.mmap(-1, 8)  # shared: the case that the process is at
    at[:] = start.to_bytes(8, "little")
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        with os.fdopen(writing, "wb") as pipe:
            _end_with(fuzz, start, stop, at, pipe)
    os.close(writing)
    status, stuck = _awaited(child, at)
    with os.fdopen(reading, "rb") as pipe:
        answer = pipe.read()
    if status == 0 and answer:
        return pickle.loads(answer), stop  # noqa: S301 - from our own fork, by a pipe
    case = int.from_bytes(at[:], "little")
    lost = Findings(cases=case + 1 - start)  # what it counted before went with it
    if not stuck and is_packed(fuzz.content(case)) and os.WIFSIGNALED(status):
        lost.outcomes[f"decoder ended by signal {os.WTERMSIG(status)}"] += 1
    else:
        lost.add("hang" if stuck else "crash", f"case {case}: wait status {status}")
    return lost, case + 1


def _end_with(fuzz: Fuzz, start: int, stop: int, at: mmap.mmap, pipe: BinaryIO) -> None:
    """Run cases, write what was found to a pipe, and end this process."""
    try:
        pickle.dump(_run(fuzz, start, stop, at), pipe)
        pipe.flush()
    except BaseException:
        traceback.print_exc()
        os._exit(1)
    os._exit(0)


def _awaited(child: int, at: mmap.mmap) -> tuple[int, bool]:
    """Wait for a process; return its wait status, and whether it stood still and was killed."""
    last, since = b"", time.monotonic()
    while True:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return status, False
        if at[:] != last:
            last, since = at[:], time.monotonic()
        elif time.monotonic() - since > _STUCK_S:
            os.kill(child, signal.SIGKILL)
            return os.waitpid(child, 0)[1], True
        time.sleep(0.02)


def _run(fuzz: Fuzz, start: int, stop: int, at: mmap.mmap) -> Findings:
    """Run cases in this process, under a limit of memory."""
    resource.setrlimit(resource.RLIMIT_DATA, (_data_bytes() + MEMORY, resource.RLIM_INFINITY))
    signal.signal(signal.SIGALRM, _hang)
    found = Findings()
    for i in range(start, stop):
        at[:] = i.to_bytes(8, "little")
        content = fuzz.content(i)
        begun = time.perf_counter()
        try:
            with _alarm():
                found.outcomes[_outcome(content)] += 1
        except Hang:
            found.add("hang", f"case {i}: over {HANG_S:g} s")
        except Finding as finding:
            found.add(finding.kind, f"case {i}: {finding}")
        found.cases += 1
        found.slowest_s = max(found.slowest_s, time.perf_counter() - begun)
    return found


class Finding(Exception):
    """What must not happen."""

    def __init__(self, kind: str, words: str) -> None:
        super().__init__(words)
        self.kind = kind


def _outcome(content: bytes) -> str:
    """Read a file; return what became of it. Raises Finding."""
    try:
        with memory_file(content) as path:
            scan = read_scan(path, name="scan", apart=False)
    except ScanError as error:
        if "do not fit in memory" in str(error):
            raise Finding("memory", f"{len(content)} bytes asked for over {MEMORY}") from None
        return f"refused: {error.code}"
    except BaseException as error:
        if type(error).__name__ == "PanicException":  # of Rust
            return "decoder panicked"
        if not isinstance(error, Exception):
            raise
        raise Finding("exception", f"{type(error).__name__}: {str(error)[:200]}") from error
    wrong = what_is_wrong(scan, content)
    if wrong:
        raise Finding("wrong", wrong)
    return "read"


def what_is_wrong(scan: Scan, content: bytes) -> str | None:
    """Hold a scan against what its file declares, by another way than the reader's."""
    declared = declared_points(content)
    if declared is None and content.startswith(b"ASTM-E57"):
        declared = len(scan.points) + scan.n_dropped + scan.n_far  # its XML does not say it plainly
    if len(scan.points) + scan.n_dropped + scan.n_far != declared:
        left_out = scan.n_dropped + scan.n_far
        return f"{len(scan.points)} points and {left_out} dropped of {declared} declared"
    if not len(scan.points) or not np.isfinite(scan.points).all():
        return "no point, or one that is not finite"
    if scan.colors is not None and scan.colors.shape != scan.points.shape:
        return f"{scan.colors.shape} colours for {scan.points.shape} points"
    return None


def declared_points(content: bytes) -> int | None:
    """Return the points that a header declares; None where that is not plain."""
    if content.startswith(b"LASF"):
        wide = content[25] == 4
        return int(struct.unpack_from("<Q" if wide else "<I", content, 247 if wide else 107)[0])
    if content.startswith(b"ASTM-E57"):
        counts = re.findall(rb'recordCount="(\d+)"', without_checksums(content))
        return int(counts[0]) if len(counts) == 1 else None
    if content.startswith(b"ply"):
        head = re.split(rb"(?m)^[ \t]*end_header", content)[0]
        counts = re.findall(rb"(?m)^\s*element\s+vertex\s+(\d+)", head)
        return int(counts[0]) if len(counts) == 1 else None
    head = re.split(rb"(?m)^\s*DATA\b", content)[0]
    lines = {
        key: re.findall(rb"(?m)^\s*" + key + rb"\s+(\d+)", head) for key in (b"WIDTH", b"HEIGHT", b"POINTS")
    }
    values = {key: int(found[0]) for key, found in lines.items() if found}
    if b"POINTS" in values:
        return values[b"POINTS"]
    return values[b"WIDTH"] * values.get(b"HEIGHT", 1) if b"WIDTH" in values else None


def is_packed(content: bytes) -> bool:
    """Tell whether a file is decoded by other people's code."""
    return content.startswith((b"LASF", b"ASTM-E57"))


@contextmanager
def memory_file(content: bytes) -> Iterator[Path]:
    """Give a file that lies in memory alone."""
    handle = os.memfd_create("scan")
    try:
        os.write(handle, content)
        yield Path(f"/proc/self/fd/{handle}")
    finally:
        os.close(handle)


@contextmanager
def _alarm() -> Iterator[None]:
    signal.setitimer(signal.ITIMER_REAL, HANG_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def _hang(*_: object) -> None:
    raise Hang


def _data_bytes() -> int:
    """Return what this process has allocated by now, as the limit counts it."""
    line = re.search(r"VmData:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return 1024 * int(line.group(1)) if line else 0


def _run_one(fuzz: Fuzz, case: int) -> int:
    """Run one case in this process, and print its header."""
    content = fuzz.content(case)
    print(content[:600])
    print(_outcome(content))
    return 0


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.breaking.fuzz_readers", description=__doc__)
    parser.add_argument("--files", type=int, default=1_000_000, help="mutated files")
    parser.add_argument("--only", type=int, metavar="CASE", help="run one case, and show it")
    parser.add_argument("--packed", action="store_true", help="E57, LAS and LAZ instead of PLY and PCD")
    add_common(parser, minutes=15)
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
