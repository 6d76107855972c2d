"""Steps in threads: so many at a time, and each can be left from outside, and only while it runs."""

from __future__ import annotations

import threading

import pytest

from worker.rq_threads import Door, StepThreads


class Stopped(BaseException):
    """What is raised from outside."""


def endless(began: threading.Event, pause: threading.Event) -> None:
    began.set()
    while not pause.wait(0.005):
        pass


def test_a_step_is_left_by_the_error_and_the_others_go_on():
    threads, go = StepThreads(2), threading.Event()
    ended: list[tuple[str, type[BaseException] | None]] = []
    doors: dict[str, Door] = {}

    def run(name: str):
        def call(door: Door) -> None:
            doors[name] = door
            try:
                with door:
                    endless(began[name], go)
                ended.append((name, None))
            except Stopped as error:
                ended.append((name, type(error)))

        return call

    began = {name: threading.Event() for name in "ab"}
    for name, event in began.items():
        threads.start(run(name), name)
        assert event.wait(60)
    doors["a"].leave(Stopped)
    threads.wait_for_room(lambda: False)
    assert ended == [("a", Stopped)]
    go.set()
    threads.wait_for_all()
    assert ended == [("a", Stopped), ("b", None)]
    assert threads.running == 0


def test_all_steps_are_left_at_once():
    threads, ended = StepThreads(3), []
    began = [threading.Event() for _ in range(3)]

    def run(event: threading.Event):
        def call(door: Door) -> None:
            try:
                with door:
                    endless(event, threading.Event())
            except Stopped:
                ended.append(event)

        return call

    for event in began:
        threads.start(run(event), "step")
        assert event.wait(60)
    threads.leave(Stopped)
    threads.wait_for_all()
    assert len(ended) == 3


def test_who_waits_for_room_hears_that_none_is_needed():
    threads, go = StepThreads(1), threading.Event()
    began = threading.Event()
    threads.start(lambda door: endless(began, go), "step")
    assert began.wait(60)
    asked = iter([False, False, True])
    threads.wait_for_room(lambda: next(asked))
    go.set()
    threads.wait_for_all()


def test_a_step_that_ended_hears_of_nothing():
    door = Door()
    with door:
        pass
    door.leave(Stopped)
    for _ in range(1000):  # it would be raised before one of these
        pass


def test_what_comes_at_the_last_moment_is_dropped_and_the_result_stands():
    for _ in range(200):
        door = Door()
        with door:
            other = threading.Thread(target=door.leave, args=(Stopped,))
            try:
                other.start()
                door.shut()
            except Stopped:
                pass  # while the block ran
        other.join()
        assert door._thread == 0


def test_an_error_of_the_step_itself_passes_through_the_door():
    with pytest.raises(KeyError), Door():
        raise KeyError


def test_a_step_that_raises_leaves_its_place():
    threads = StepThreads(1)

    def fails(door: Door) -> None:
        raise KeyError

    threads.start(fails, "step")
    threads.wait_for_all()
    assert threads.running == 0
