"""Marks of every test, and the folder of real scans."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from worker.threads import one_thread, wait_passively

wait_passively()  # before any test imports torch
if "PYTEST_XDIST_WORKER" in os.environ:
    one_thread()  # the other workers have the other cores

TESTS = Path(__file__).resolve().parent
#: Folders and files whose tests are all slow; a slow test elsewhere is marked where it stands.
SLOW = (
    "acceptance",
    "browser",
    "integration",
    "test_breaking.py",
    "service/api/http/reading/test_uploads.py",
    "service/api/test_disk_full.py",
    "service/api/test_outages.py",
    "service/catalog/test_migrations.py",
    "service/up/test_connections.py",
    "service/up/test_embedded_redis.py",
    "worker/benchmarks/paper/test_benchmark.py",
    "worker/benchmarks/paper/test_report.py",
    "worker/benchmarks/placement/test_answers.py",
    "worker/benchmarks/placement/test_pictures.py",
    "worker/benchmarks/placement/test_placement_benchmark.py",
    "worker/benchmarks/placement/test_surveys.py",
    "worker/benchmarks/registration/test_benchmark.py",
    "worker/benchmarks/registration/test_baseline.py",
    "worker/benchmarks/revisit/test_benchmark.py",
    "worker/benchmarks/revisit/test_visits.py",
    "worker/benchmarks/test_methods.py",
    "worker/benchmarks/test_speed.py",
    "worker/demo/test_demo.py",
    "worker/pipeline/mapping/test_map_registration.py",
    "worker/pipeline/mapping/test_multiview_refinement.py",
    "worker/pipeline/mapping/test_pair_registration.py",
    "worker/pipeline/mapping/test_relocalization.py",
    "worker/pipeline/mapping/test_survey_registration.py",
    "worker/pipeline/placement/test_explanations.py",
    "worker/pipeline/registration/test_ambiguity.py",
    "worker/pipeline/registration/test_fpfh_ransac.py",
    "worker/pipeline/registration/test_preprocessing.py",
    "worker/pipeline/registration/test_scan_to_map.py",
    "worker/pipeline/registration/test_scan_to_scan.py",
    "worker/pipeline/results/test_picture.py",
    "worker/pipeline/test_flow.py",
    "worker/pipeline/test_map_update.py",
    "worker/simulation/test_training_set.py",
    "worker/test_memory.py",
    "worker/training/test_head.py",
    "worker/training/test_publish.py",
    "worker/training/test_trainer.py",
)
SLOW_PATHS = frozenset(TESTS / name for name in SLOW)
NO_REAL_SCANS = "real scans are missing"  #: how the reason of each such skip begins


def real_scans() -> Path:
    """Return the folder of real scans: `SPICD_TEST_DATA`, or `../shared/data` beside the checkout."""
    named = os.environ.get("SPICD_TEST_DATA")
    return Path(named).resolve() if named else TESTS.parents[1] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real scans (docs/test-data.md); a test that asks for it is skipped where it is absent."""
    folder = real_scans()
    if not folder.is_dir():
        pytest.skip(f"{NO_REAL_SCANS}: no folder {folder}")
    return folder


def is_slow(path: Path) -> bool:
    """Whether a folder or file is named in SLOW, or lies in a folder that is."""
    return not {path, *path.parents}.isdisjoint(SLOW_PATHS)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Import no slow file where only fast tests are asked for: that takes seconds in each process."""
    return True if config.getoption("markexpr") == "fast" and is_slow(collection_path) else None


@pytest.hookimpl(tryfirst=True)  # before -m selects
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark each test `fast` that is not `slow`, and `real_data` each that asks for real scans."""
    for item in items:
        if is_slow(item.path):
            item.add_marker("slow")
        if item.get_closest_marker("slow") is None:
            item.add_marker("fast")
        if "shared_data" in getattr(item, "fixturenames", ()):
            item.add_marker("real_data")


@contextmanager
def skipped_without_its_file() -> Iterator[None]:
    """Skip a test that misses one file of the folder, so that a folder that holds a part of them is of use."""
    try:
        yield
    except FileNotFoundError as error:
        missing = Path(str(error.filename))
        if not missing.is_relative_to(real_scans()):
            raise
        pytest.skip(f"{NO_REAL_SCANS}: no file {missing}")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup() -> Iterator[None]:
    with skipped_without_its_file():
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Iterator[None]:
    with skipped_without_its_file():
        return (yield)


@pytest.hookimpl(wrapper=True, tryfirst=True)  # after pytest's own summary
def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> Iterator[None]:
    """Say in one line how many tests were skipped for want of real scans."""
    yield
    skipped = [str(report.longrepr) for report in terminalreporter.stats.get("skipped", ())]
    wanting = sum(NO_REAL_SCANS in reason for reason in skipped)
    if wanting:
        tests = "1 test was" if wanting == 1 else f"{wanting} tests were"
        terminalreporter.write_line(
            f"{tests} skipped for want of real scans; docs/test-data.md says where to get them"
        )
