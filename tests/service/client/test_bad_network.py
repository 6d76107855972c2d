"""Both clients against a service that drops every third connection and is busy now and then: each thing happens once."""

from __future__ import annotations

import asyncio
import hashlib
import inspect
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest

from service.client import AsyncClient, Client, RequestRefused, Retries
from tests.support.flaky import CLOUD, EVENTS, FEATURES, Flaky, flaky_service

QUICK = Retries(attempts=20, first_pause_s=0.001, longest_pause_s=0.01)

both = pytest.mark.parametrize("kind", [Client, AsyncClient])


async def done(call: Any) -> Any:
    """Await what the asynchronous client returns, and take what the other one returns."""
    return await call if inspect.isawaitable(call) else call


async def each(items: Any) -> AsyncIterator[Any]:
    """Go through what either client yields."""
    if hasattr(items, "__aiter__"):
        async for item in items:
            yield item
    else:
        for item in items:
            yield item


@pytest.fixture
def flaky() -> Flaky:
    return Flaky()


@pytest.fixture
def url(flaky: Flaky) -> Iterator[str]:
    with flaky_service(flaky) as address:
        yield address


@both
def test_every_scan_map_and_survey_is_made_exactly_once(
    kind: type[Any], flaky: Flaky, url: str, tmp_path: Path
) -> None:
    contents = [bytes([number]) * 1_500_000 for number in range(8)]
    paths = [tmp_path / f"{number}.ply" for number in range(8)]
    for path, content in zip(paths, contents, strict=True):
        path.write_bytes(content)

    async def scenario() -> None:
        client = kind(url, retries=QUICK)
        scans = [(await done(client.upload_scan(path)))["scan_id"] for path in paths]
        assert scans == [f"scan-{number}" for number in range(1, 9)]
        for scan_id in scans:
            await done(client.create_map([scan_id]))
            await done(client.submit_survey("lobby", [scan_id]))

    asyncio.run(scenario())
    made = [said for one, said in flaky.made if one == "scan"]
    assert made == [hashlib.sha256(content).hexdigest() for content in contents]
    for one in ("map", "survey"):
        asked = [said["scan_ids"] for kind_, said in flaky.made if kind_ == one]
        assert asked == [[f"scan-{number}"] for number in range(1, 9)]
    assert flaky.requests > 24  # what was lost was sent again


@both
def test_two_calls_of_the_same_content_are_two_things(kind: type[Any], flaky: Flaky, url: str) -> None:
    async def scenario() -> None:
        client = kind(url, retries=QUICK)
        for _ in range(5):
            await done(client.create_map(["scan-1"]))

    asyncio.run(scenario())
    assert len(flaky.made) == 5


@both
def test_a_deletion_whose_answer_was_lost_is_no_error_and_one_of_nothing_is(
    kind: type[Any], flaky: Flaky, url: str
) -> None:
    flaky.deleted = ["gone"]

    async def scenario() -> None:
        client = kind(url, retries=QUICK)
        for number in range(12):
            await done(client.delete_scan(f"scan-{number}"))
        flaky.requests = 0  # the next one goes through but for a 429
        with pytest.raises(RequestRefused) as refused:
            await done(client.delete_scan("gone"))
        assert refused.value.status == 404

    asyncio.run(scenario())
    assert flaky.deleted == ["gone", *(f"scan-{number}" for number in range(12))]


@both
def test_a_download_is_taken_up_where_it_broke_and_is_whole(
    kind: type[Any], flaky: Flaky, url: str, tmp_path: Path
) -> None:
    seen: list[tuple[int, int | None]] = []

    async def scenario() -> None:
        client = kind(url, retries=QUICK)
        for number in range(6):
            to = tmp_path / f"{number}.ply"
            await done(client.download("/surveys/one/cloud.ply", to, lambda *progress: seen.append(progress)))
            assert to.read_bytes() == CLOUD

    asyncio.run(scenario())
    assert len(list(tmp_path.iterdir())) == 6
    assert {total for _, total in seen} == {len(CLOUD)}


@both
def test_changes_are_followed_without_a_lost_or_doubled_one(kind: type[Any], flaky: Flaky, url: str) -> None:
    async def follow(after: str | None, most: int) -> tuple[list[str], str]:
        ids: list[str] = []
        async for page in each(kind(url, retries=QUICK).follow_changes("lobby", after=after, every_s=0.001)):
            ids += [feature["id"] for feature in page.features]
            if len(ids) >= most:
                return ids, page.after
        raise AssertionError("it ends never")

    async def scenario() -> None:
        first, after = await follow(None, 9)
        rest, _ = await follow(after, len(FEATURES) - len(first))
        assert first + rest == [feature["id"] for feature in FEATURES]

    asyncio.run(scenario())


@both
def test_events_are_followed_over_broken_connections_each_once(
    kind: type[Any], flaky: Flaky, url: str
) -> None:
    async def scenario() -> None:
        ids = []
        async for event in each(kind(url, retries=QUICK).events(types=["survey.ready"])):
            ids.append(event["id"])
            if len(ids) == len(EVENTS):
                break
        assert ids == [event["id"] for event in EVENTS]

    asyncio.run(scenario())
