"""`spicd-worker`: the pipeline on files, training, and the demo; no service is needed but for the demo's own."""

from worker.cli.main import main

__all__ = ["main"]
