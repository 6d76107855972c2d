"""`spicd up` with an API of one route, for tests of the launcher.

python -m tests.support.launch DATA_DIR READY_FILE WORKERS
"""

from __future__ import annotations

import sys
from pathlib import Path

from fastapi import FastAPI

from service.logs import set_up_logging
from service.settings import Settings
from service.up.launcher import up


def create_app(settings: Settings) -> FastAPI:
    app = FastAPI()

    @app.get("/settings")
    def shown() -> dict[str, str | None]:
        return {"redis_url": settings.redis_url, "data_dir": str(settings.data_dir)}

    return app


if __name__ == "__main__":
    data_dir, ready, workers = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    set_up_logging("info")
    up(
        Settings(data_dir=data_dir, port=0, geometry_workers=workers, inference_workers=workers),
        on_ready=lambda running: running.write(ready),
        create_app=create_app,
    )
