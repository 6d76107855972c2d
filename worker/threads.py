"""How many threads the numeric libraries use, and how these wait for each other."""

from __future__ import annotations

import os

_PAIR = 2  # a query of 30,000 points gains nothing from more
_threads = _PAIR


def wait_passively() -> None:
    """Let OpenMP's threads sleep while they wait; to be called before torch or Open3D is imported.

    By default they spin. Where something else wants a core, every small product then waits for a thread that
    does not run: 172 tiles took 15 to 54 s on two busy cores, and 4 s with threads that sleep. A value that the
    environment sets stands.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def one_thread() -> None:
    """Keep this process to one thread: others like it have the other cores. Before Open3D is imported."""
    global _threads  # noqa: PLW0603 - the state of a process, set once at its start
    _threads = 1
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"


def query_threads() -> int:
    """Return the number that SciPy's trees ask for at each query."""
    return _threads
