"""A step: what its job is told where it cannot go on."""

from __future__ import annotations

from pathlib import Path

import pytest

from service.catalog.catalog import open_catalog
from tests.support.samples import add_map, settings_in
from worker.errors import OutOfMemory
from worker.jobs.step import Context, step


def test_a_step_that_runs_out_of_memory_fails_its_job_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = settings_in(tmp_path)
    monkeypatch.setenv("SPICD_DATA_DIR", str(settings.data_dir))
    monkeypatch.setenv("SPICD_DATABASE_URL", settings.resolved_database_url())
    catalog = open_catalog(settings)
    job_id = add_map(catalog, ready=False)

    @step
    def register_map(context: Context) -> None:
        raise MemoryError

    with pytest.raises(OutOfMemory):
        register_map(job_id)
    job = catalog.jobs.get(job_id)
    catalog.close()
    assert job.status == "failed"
    assert job.problem is not None
    assert job.problem.code == "out_of_memory"
    assert "raise SPICD_STEP_MEMORY_BYTES" in job.problem.detail
