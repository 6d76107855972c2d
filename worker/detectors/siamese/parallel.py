"""Work on many small clouds, shared among threads by clouds and not by products."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from threading import Barrier
from typing import TypeVar

import torch

T = TypeVar("T")
R = TypeVar("R")


def in_groups(function: Callable[[Sequence[T]], R], items: Sequence[T]) -> list[R]:
    """Call a function with a share of the items in as many threads as torch has here; the answers in their order.

    Within it torch computes with one thread. With one thread, or one item, it is called here, with all of them.
    """
    threads = min(torch.get_num_threads(), len(items))
    if threads <= 1:
        return [function(items)]
    bounds = [len(items) * number // threads for number in range(threads + 1)]
    groups = [items[start:end] for start, end in pairwise(bounds)]
    return list(_threads(os.getpid(), threads).map(function, groups))


@cache
def _threads(process: int, count: int) -> ThreadPoolExecutor:  # noqa: ARG001 (a forked process has none of its parent's)
    """Start threads that stay, each with one of torch's own.

    Threads that are started anew for each call wait for their first turn where all cores are busy: encoding took five
    times as long.
    """
    here, all_there = torch.get_num_threads(), Barrier(count)

    def settle(_: int) -> None:
        torch.get_num_threads()  # a thread takes over the process's number when it is first asked, once
        torch.set_num_threads(1)
        all_there.wait()

    pool = ThreadPoolExecutor(count, thread_name_prefix="clouds")
    list(pool.map(settle, range(count)))
    torch.set_num_threads(here)  # for what a thread sets is also what new ones of the process begin with
    return pool
