"""How the numeric libraries' threads wait for each other."""

from __future__ import annotations

import os


def wait_passively() -> None:
    """Let OpenMP's threads sleep while they wait; to be called before torch or Open3D is imported.

    By default they spin. Where something else wants a core, every small product then waits for a thread that
    does not run: 172 tiles took 15 to 54 s on two busy cores, and 4 s with threads that sleep. A value that the
    environment sets stands.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
