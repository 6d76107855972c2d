"""The API's description as a file: `python -m service.api.openapi` writes it; a test fails when it has drifted."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from service.api.app import create_app
from service.settings import Settings

FILE = Path("openapi/openapi.json")


def written() -> str:
    """Return the document as the file holds it."""
    document = create_app(Settings()).openapi()
    return json.dumps(document, indent=2, sort_keys=True, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    FILE.write_text(written(), encoding="utf-8")
    sys.stdout.write(f"{FILE}\n")
