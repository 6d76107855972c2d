"""The pages that repeat what the code says stay in step with it."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from pydantic_core import PydanticUndefined
from rq.timeouts import JobTimeoutException

from service.api.http.answering.problems import PROBLEMS
from service.catalog.jobs import WORKER_DIED
from service.errors import ServiceError
from service.settings import Settings
from worker.endings import ending_of
from worker.errors import Cancelled, PipelineError
from worker.pipeline.registration.diagnosis import MEANING
from worker.rq_jobs import FunctionRefused

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
ROW = re.compile(r"^\| `(\w+)` \| ([^|]+) \|", re.MULTILINE)


def settings_table() -> str:
    """What README.md says of the settings, row by row."""
    rows = ["| variable | default | what it is |", "| --- | --- | --- |"]
    for name, field in Settings.model_fields.items():
        default = "" if field.default in (None, PydanticUndefined) else f"`{field.default}`"
        rows.append(f"| `SPICD_{name.upper()}` | {default} | {field.description} |")
    return "\n".join(rows)


def test_the_readme_lists_every_setting_with_its_default() -> None:
    assert settings_table() in (ROOT / "README.md").read_text()


def test_every_problem_code_is_explained() -> None:
    documented = dict(ROW.findall((ROOT / "docs/problems.md").read_text()))
    assert set(documented) == {*PROBLEMS, *codes(ServiceError), *codes(PipelineError), *codes_of_ends()} - {
        ServiceError.code,  # of the base alone; what carries it is `internal`
        Cancelled.code,  # never recorded
    }


def test_every_reason_of_a_scan_is_explained_in_the_words_of_the_code() -> None:
    page = (ROOT / "docs/reasons.md").read_text()
    _, _, reasons = page.partition("## Reasons")
    assert dict(ROW.findall(reasons.partition("## The placement")[0])) == MEANING


@pytest.mark.parametrize("code", PROBLEMS)
def test_the_status_of_each_problem_is_the_one_that_is_sent(code: str) -> None:
    documented = dict(ROW.findall((ROOT / "docs/problems.md").read_text()))[code]
    status, _ = PROBLEMS[code]
    in_jobs = code in codes(PipelineError) | codes_of_ends() | {"dismissed"}
    assert documented == " or ".join([*([str(status)] if status else []), *(["job"] if in_jobs else [])])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_to_a_file_leads_somewhere(page: Path) -> None:
    links = re.findall(r"\]\((?!https?://|#)([^)#\s]+)", page.read_text())
    assert [link for link in links if not (page.parent / link).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_file_of_ours_that_a_page_names_exists(page: Path) -> None:
    named = re.findall(r"`((?:service|worker|tests|docker|docs|openapi)/[\w./-]*\w)/?`", page.read_text())
    assert [name for name in named if not (ROOT / name).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_no_line_of_prose_is_wider_than_120_characters(page: Path) -> None:
    prose = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    wide = [line for line in prose.splitlines() if len(line) > 120 and not line.startswith("|")]
    assert wide == []


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_python_on_a_page_runs(page: Path) -> None:
    for code in re.findall(r"^```python\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL):
        exec(code, {})


def test_every_page_is_reached_from_the_readme_by_links() -> None:
    reached: set[Path] = set()
    waiting = [ROOT / "README.md"]
    while waiting:
        page = waiting.pop()
        if page not in reached:
            reached.add(page)
            waiting += linked_pages(page)
    assert set(PAGES) - reached == set()


def linked_pages(page: Path) -> Iterator[Path]:
    """Yield the pages that a page links to; a link to a folder leads to all of its pages."""
    for link in re.findall(r"\]\((?!https?://|#)([^)#\s]+)", page.read_text()):
        target = (page.parent / link).resolve()
        yield from target.glob("*.md") if target.is_dir() else [target] * (target.suffix == ".md")


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md"])
def test_a_page_names_targets_that_make_has(page: str) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert set(re.findall(r"(?:^|`)make ([a-z-]+)", (ROOT / page).read_text(), re.MULTILINE)) <= targets


def test_the_real_scans_are_those_of_the_page(shared_data: Path) -> None:
    page = (ROOT / "docs/test-data.md").read_text()
    listed = dict(re.findall(r"^\| `([^`]+)` \| `([0-9a-f]{64})` \|$", page, re.MULTILINE))
    present = {
        path.relative_to(shared_data).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in shared_data.rglob("*")
        if path.is_file() and path.parent != shared_data
    }
    assert present.items() <= listed.items()


def codes(kind: type[Exception]) -> set[str]:
    """The codes of an error and of everything below it."""
    return {kind.code}.union(*(codes(below) for below in kind.__subclasses__()))  # type: ignore[attr-defined]


def codes_of_ends() -> set[str]:
    """What is recorded of a step that could not speak for itself."""
    ends = (FunctionRefused(), JobTimeoutException(), KeyError())
    step = SimpleNamespace(id="job-1-register", timeout=1)
    return {WORKER_DIED, *(ending_of(end, step).code for end in ends)}  # type: ignore[arg-type]
