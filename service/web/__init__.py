"""The viewer: `source/` is TypeScript, which `make web` builds into `built/`; `pages.py` serves that."""
