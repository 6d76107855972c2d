"""Programs that break the service on purpose; each runs as `python -m tests.breaking.NAME`."""
