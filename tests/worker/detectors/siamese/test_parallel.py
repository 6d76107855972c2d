"""Shares of the work in threads: the answers in their order, and torch's threads as they were."""

from __future__ import annotations

import multiprocessing
import threading
from collections.abc import Iterator, Sequence

import pytest
import torch

from worker.detectors.siamese.chamfer import chamfer_statistics
from worker.detectors.siamese.parallel import in_groups


@pytest.fixture(params=[1, 2, 3])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def asked(items: Sequence[int]) -> tuple[list[int], int, str]:
    return list(items), torch.get_num_threads(), threading.current_thread().name


def test_each_thread_takes_a_share_and_computes_with_one_thread(threads: int) -> None:
    answers = in_groups(asked, range(10))
    assert [item for items, _, _ in answers for item in items] == list(range(10))
    assert len(answers) == threads
    assert {count for _, count, _ in answers} == {1}
    assert torch.get_num_threads() == threads


def test_one_item_is_worked_on_where_it_is_asked_for() -> None:
    ((items, count, name),) = in_groups(asked, [7])
    assert (items, count) == ([7], torch.get_num_threads())
    assert name == threading.current_thread().name


def test_a_new_thread_of_the_process_begins_with_as_many_as_before(threads: int) -> None:
    in_groups(asked, range(10))
    begun: list[int] = []
    thread = threading.Thread(target=lambda: begun.append(torch.get_num_threads()))
    thread.start()
    thread.join()
    assert begun == [threads]


def test_what_goes_wrong_in_a_share_is_raised() -> None:
    def refuse(items: Sequence[int]) -> None:
        raise ValueError(f"not {items[-1]}")

    with pytest.raises(ValueError, match="not"):
        in_groups(refuse, range(4))


def test_a_forked_process_has_threads_of_its_own(threads: int) -> None:
    in_groups(asked, range(4))
    context = multiprocessing.get_context("fork")
    answers = context.SimpleQueue()
    child = context.Process(
        target=lambda: answers.put(sum(len(part[0]) for part in in_groups(asked, range(9))))
    )
    child.start()
    child.join(60)
    assert child.exitcode == 0
    assert answers.get() == 9


def test_chamfer_statistics_are_the_same_in_shares(threads: int) -> None:
    generator = torch.Generator().manual_seed(0)
    pairs = [torch.rand(2, 50 + n, 3, generator=generator) for n in range(5)]
    whole = chamfer_statistics([pair[0] for pair in pairs], [pair[1] for pair in pairs])
    alone = torch.cat([chamfer_statistics([pair[0]], [pair[1]]) for pair in pairs])
    assert torch.equal(whole, alone)
