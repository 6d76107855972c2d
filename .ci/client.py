"""Write the parts of service/client that are made of others: `make client`. With `--check`: say what is not current.

documents.py     TypedDicts of openapi/openapi.json, by datamodel-code-generator (of `make tools`)
synchronous/     the twin of asynchronous/ without async and await, by unasync
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import unasync

ROOT = Path(__file__).resolve().parents[1]
CLIENT = ROOT / "service" / "client"
NAMES = {
    "AsyncBaseTransport": "BaseTransport",
    "AsyncBody": "Body",
    "AsyncClient": "Client",
    "AsyncConnection": "Connection",
    "AsyncFeeds": "Feeds",
    "AsyncRetrying": "Retrying",
    "aclose": "close",
    "aclosing": "closing",
    "aiter_bytes": "iter_bytes",
    "aiter_sse": "iter_sse",
    "anyio": "time",  # of which there is `sleep` alone
    "aread": "read",
    "asynchronous": "synchronous",
    "in_pieces_async": "in_pieces",
}
NOTE = "# Made of asynchronous/{name} by `make client`: change that one.\n"
GENERATOR = ROOT / "build" / "tools" / "bin" / "datamodel-codegen"
GENERATOR_OPTIONS = (
    "--input-file-type=openapi",
    "--output-model-type=typing.TypedDict",
    "--target-python-version=3.11",
    "--no-use-closed-typed-dict",
    "--use-schema-description",
    "--use-single-line-docstring",
    "--disable-timestamp",
    "--formatters=builtin",
)
TITLE = '"""What the API answers with and takes. Made of openapi/openapi.json by `make client`."""\n\n'


def twin(folder: Path) -> None:
    """Write the synchronous files into a folder."""
    sources = sorted((CLIENT / "asynchronous").glob("*.py"))
    rule = unasync.Rule(f"{CLIENT}/asynchronous/", f"{folder}/", additional_replacements=NAMES)
    unasync.unasync_files([str(path) for path in sources], [rule])
    for source in sources:
        made = folder / source.name
        made.write_text(NOTE.format(name=source.name) + made.read_text())
    _in_shape(folder)


def documents(path: Path) -> None:
    """Write the TypedDicts of the API's description into a file. Raises FileNotFoundError without the tools."""
    description = ROOT / "openapi" / "openapi.json"
    command = [str(GENERATOR), f"--input={description}", f"--output={path}", *GENERATOR_OPTIONS]
    subprocess.run(command, check=True)  # noqa: S603
    path.write_text(TITLE + path.read_text())
    _in_shape(path)


def outdated() -> list[str]:
    """Return the made files that differ from what would be made now; documents.py only where the tools are there."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        twin(folder)
        pairs = [(CLIENT / "synchronous" / made.name, made) for made in sorted(folder.glob("*.py"))]
        if GENERATOR.exists():
            (folder / "of_api").mkdir()
            documents(folder / "of_api" / "documents.py")
            pairs.append((CLIENT / "documents.py", folder / "of_api" / "documents.py"))
        return [
            str(kept.relative_to(ROOT))
            for kept, made in pairs
            if not kept.exists() or kept.read_text() != made.read_text()
        ]


def _in_shape(path: Path) -> None:
    ruff = str(Path(sys.executable).parent / "ruff")
    for words in (("check", "--quiet", "--fix", "--select=I,F401"), ("format", "--quiet")):
        subprocess.run([ruff, *words, "--config=pyproject.toml", str(path)], check=True, cwd=ROOT)  # noqa: S603


def main() -> None:
    """Write them, or with `--check` end with a sentence and status 1 where they are not current."""
    if "--check" in sys.argv[1:]:
        sys.exit(f"not current: {', '.join(old)}; `make client` makes them" if (old := outdated()) else 0)
    twin(CLIENT / "synchronous")
    if GENERATOR.exists():
        documents(CLIENT / "documents.py")


if __name__ == "__main__":
    main()
