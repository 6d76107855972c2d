"""The API alone in a process of its own, that a test may kill and start again on the same folder and port.

python -m tests.support.api_process FOLDER PORT
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from pathlib import Path

import httpx

from tests.support.processes import until
from tests.support.servers import free_port

ROOT = Path(__file__).parents[2]


class ApiProcess:
    """`create_app` under uvicorn with the limits of connections, and no jobs: a queue that only remembers."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.port = folder, free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self.log = folder / "api.log"
        self.start()

    def start(self) -> None:
        command = [sys.executable, "-m", "tests.support.api_process", str(self.folder), str(self.port)]
        environment = {key: value for key, value in os.environ.items() if not key.startswith("SPICD_")}
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=log, stderr=log)
        until(self._answers, 60)

    def kill(self) -> None:
        """As the system kills: nothing is told, and nothing written any more."""
        self.process.kill()
        self.process.wait()

    def uploads(self) -> list[Path]:
        """The folders of uploads."""
        folder = self.folder / "data" / "uploads"
        return sorted(folder.iterdir()) if folder.is_dir() else []

    def received(self) -> int:
        """Bytes of uploads that are written, on the disk or not."""
        sizes = []
        for folder in self.uploads():
            with contextlib.suppress(FileNotFoundError):
                sizes.append((folder / "data").stat().st_size)
        return sum(sizes)

    def _answers(self) -> bool:
        assert self.process.poll() is None, self.log.read_text()
        with contextlib.suppress(httpx.TransportError):
            return httpx.get(f"{self.url}/health/live").status_code == 200
        return False


def _serve(folder: Path, port: int) -> None:
    import uvicorn

    from service.api.app import create_app
    from service.logs import set_up_logging
    from service.settings import Settings
    from service.up.connections import Limits, limited_protocol
    from tests.support.samples import RememberingQueue

    set_up_logging("info", "text")
    settings = Settings(data_dir=folder / "data", model_store=folder / "models", min_free_bytes=0)
    app = create_app(settings, queue=RememberingQueue())
    http = limited_protocol(Limits())
    uvicorn.run(app, host="127.0.0.1", port=port, http=http, log_config=None, timeout_graceful_shutdown=2)


if __name__ == "__main__":
    _serve(Path(sys.argv[1]), int(sys.argv[2]))
