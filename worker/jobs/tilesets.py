"""Tilesets of clouds as blobs: the document, and all contents in one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict

from service.catalog.files.tilesets import address
from service.catalog.records import Tileset
from worker.cloud.tilesets.writer import Pieces, TilesetSettings, write_tileset
from worker.jobs.step import Context


def put_tileset(
    context: Context,
    pieces: Pieces,
    *,
    document: str,
    contents: str,
    progress: Callable[[float], None],
) -> Tileset:
    """Write the tileset of a cloud under the keys `document` and `contents`.

    A second run writes the same bytes. The contents come first: where the document is, they are.
    """
    folder = context.scratch / "tileset"
    folder.mkdir(exist_ok=True)
    index, binary = folder / "tileset.json", folder / "tileset.bin"
    summary = write_tileset(
        index,
        binary,
        pieces,
        scratch=folder,
        address=lambda at: address(at.sha256, at.offset, at.length),
        settings=TilesetSettings(memory_bytes=context.settings.map_memory_bytes),
        progress=progress,
    )
    context.catalog.blobs.put_file(contents, binary, move=True)
    context.catalog.blobs.put_file(document, index, move=True)
    return Tileset.model_validate(asdict(summary))
