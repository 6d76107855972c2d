"""A download that ended early is gone on with by a later call, and never with bytes of another file."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.cli import main, terminal
from service.client import AsyncClient, Client, RequestRefused, Retries, Unreachable

CLOUD = bytes(range(256)) * 400
ONCE = Retries(attempts=1)

both = pytest.mark.parametrize("kind", [Client, AsyncClient])


class Broken(httpx.SyncByteStream, httpx.AsyncByteStream):
    """The first part of a body, and then no connection any more."""

    def __init__(self, content: bytes) -> None:
        self._content = content

    def __iter__(self) -> Iterator[bytes]:
        yield self._content
        raise httpx.ReadError("the link is gone")

    async def __aiter__(self) -> AsyncIterator[bytes]:
        yield self._content
        raise httpx.ReadError("the link is gone")


class Files:
    """Answers with a file, with ranges of it where `If-Range` is its tag; breaks off after `most` bytes."""

    def __init__(self) -> None:
        self.content, self.tag, self.most = CLOUD, '"one"', 30_000
        self.asked: list[str | None] = []
        self.gone = False

    def __call__(self, request: httpx.Request) -> httpx.Response:
        asked = request.headers.get("range")
        self.asked.append(asked)
        if self.gone:
            return httpx.Response(404, json={"title": "no", "detail": "no survey"})
        of_it = asked is not None and request.headers.get("if-range") == self.tag
        start = int((asked or "").removeprefix("bytes=").rstrip("-")) if of_it else 0
        if of_it and start >= len(self.content):
            return httpx.Response(416, json={"title": "no such part"})
        rest = self.content[start:]
        headers = {"ETag": self.tag, "Content-Length": str(len(rest))}
        stream = Broken(rest[: self.most]) if len(rest) > self.most else httpx.ByteStream(rest)
        return httpx.Response(206 if of_it else 200, headers=headers, stream=stream)


@pytest.fixture
def files() -> Files:
    return Files()


def fetch(kind: type[Any], files: Files, to: Path, *, resume: bool = True) -> None:
    """Download once, with a client of its own, as a run of the command does."""

    async def scenario() -> None:
        client = kind("http://there", transport=httpx.MockTransport(files), retries=ONCE)
        call = client.download("/surveys/one/cloud.ply", to, resume=resume)
        await call if inspect.isawaitable(call) else call

    asyncio.run(scenario())


@both
def test_a_later_call_goes_on_where_an_earlier_one_was_broken_off(
    kind: type[Any], files: Files, tmp_path: Path
) -> None:
    to = tmp_path / "cloud.ply"
    for received in (30_000, 60_000, 90_000):
        with pytest.raises(Unreachable):
            fetch(kind, files, to)
        assert (tmp_path / "cloud.ply.part").stat().st_size == received
        assert not to.exists()
    fetch(kind, files, to)
    assert files.asked == [None, "bytes=30000-", "bytes=60000-", "bytes=90000-"]
    assert to.read_bytes() == CLOUD
    assert [path.name for path in tmp_path.iterdir()] == ["cloud.ply"]


@both
def test_without_resume_nothing_is_left(kind: type[Any], files: Files, tmp_path: Path) -> None:
    with pytest.raises(Unreachable):
        fetch(kind, files, tmp_path / "cloud.ply", resume=False)
    assert list(tmp_path.iterdir()) == []


@both
@pytest.mark.parametrize("change", ["another file", "as long as the part", "no tag", "a note that is none"])
def test_a_part_of_another_file_is_begun_anew(
    kind: type[Any], files: Files, tmp_path: Path, change: str
) -> None:
    to, note = tmp_path / "cloud.ply", tmp_path / "cloud.ply.part.tag"
    with pytest.raises(Unreachable):
        fetch(kind, files, to)
    if change == "another file":
        files.content, files.tag = CLOUD[::-1], '"two"'
    elif change == "as long as the part":
        files.content = CLOUD[:30_000]
    elif change == "no tag":
        note.unlink()
    else:
        note.write_bytes(b"one\r\n\xff")
    files.most = len(CLOUD)
    fetch(kind, files, to)
    assert to.read_bytes() == files.content
    assert [path.name for path in tmp_path.iterdir()] == ["cloud.ply"]


@both
def test_of_what_is_gone_no_part_stays(kind: type[Any], files: Files, tmp_path: Path) -> None:
    with pytest.raises(Unreachable):
        fetch(kind, files, tmp_path / "cloud.ply")
    files.gone = True
    with pytest.raises(RequestRefused, match="no survey"):
        fetch(kind, files, tmp_path / "cloud.ply")
    assert list(tmp_path.iterdir()) == []


def test_the_same_command_goes_on_with_the_download_of_a_survey(
    files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    survey = {"survey_id": "survey-1", "status": "ready", "placement": None, "objects": None}

    def service(request: httpx.Request) -> httpx.Response:
        if request.url.path.endswith(".ply"):
            return files(request)
        if request.url.path.endswith(".png"):
            return httpx.Response(200, content=b"png")
        return httpx.Response(200, json={**survey, "features": [], "links": []})

    transport = httpx.MockTransport(service)
    monkeypatch.setattr(terminal, "Client", lambda url: Client(url, transport=transport, retries=ONCE))
    words = ["surveys", "download", "survey-1", "--to", str(tmp_path / "tuesday")]
    for status in (1, 1, 1, 0):
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code == status
    assert files.asked[-1] == "bytes=90000-"
    assert (tmp_path / "tuesday" / "cloud.ply").read_bytes() == CLOUD
