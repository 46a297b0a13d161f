"""The explorer knows which results a processor may give, by the small programs that are called litmus tests."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.explorer import FENCE, Explorer, Machine, Op, Order, Scenario, Steps, load, ring, store, swap, wait

X, Y, LEFT, RIGHT, BELL = range(5)
NAMES = ["x", "y", "left", "right", "bell"]
RELAXED, SEQ_CST = Order.RELAXED, Order.SEQ_CST
TSO, WEAK = Machine.TSO, Machine.WEAK

Program = Callable[[], Steps[None]]


def writes_and_reads(writes: Op, between: Op | None, reads: Op, result: int) -> Program:
    """Sets ``result`` if it does not see what the other thread has written."""

    def run() -> Steps[None]:
        yield writes
        if between is not None:
            yield between
        if (yield reads) == 0:
            yield store(result, 1)

    return run


def watches() -> Steps[None]:
    """Sleeps for ever if both results are set."""
    left = yield load(LEFT)
    right = yield load(RIGHT)
    if left and right:
        yield wait(BELL, 0, [])


def is_possible(*programs: Program, machine: Machine) -> bool:
    return bool(Explorer(Scenario([0] * len(NAMES), NAMES, [*programs, watches]), machine).explore().lost)


@pytest.mark.parametrize(
    ("machine", "written", "between", "read", "possible"),
    [
        (TSO, RELAXED, None, RELAXED, True),
        (TSO, RELAXED, FENCE, RELAXED, False),
        (TSO, SEQ_CST, None, RELAXED, False),
        (WEAK, SEQ_CST, None, RELAXED, True),
        (WEAK, SEQ_CST, FENCE, RELAXED, False),
        (WEAK, SEQ_CST, None, SEQ_CST, False),
        (WEAK, RELAXED, None, SEQ_CST, True),
    ],
)
def test_two_threads_that_write_then_read_need_an_order_to_meet(
    machine: Machine, written: Order, between: Op | None, read: Order, *, possible: bool
) -> None:
    left = writes_and_reads(store(X, 1, written), between, load(Y, read), LEFT)
    right = writes_and_reads(store(Y, 1, written), between, load(X, read), RIGHT)

    assert is_possible(left, right, machine=machine) is possible


@pytest.mark.parametrize(("machine", "possible"), [(TSO, False), (WEAK, True)])
def test_a_compare_and_swap_is_a_fence_on_x86_only(machine: Machine, *, possible: bool) -> None:
    left = writes_and_reads(swap(X, 0, 1), None, load(Y, RELAXED), LEFT)
    right = writes_and_reads(swap(Y, 0, 1), None, load(X, RELAXED), RIGHT)

    assert is_possible(left, right, machine=machine) is possible


@pytest.mark.parametrize("machine", Machine)
def test_of_two_threads_that_swap_the_same_place_one_succeeds(machine: Machine) -> None:
    def swaps(result: int) -> Program:
        def run() -> Steps[None]:
            if (yield swap(X, 0, 1)) == 0:
                yield store(result, 1)

        return run

    assert not is_possible(swaps(LEFT), swaps(RIGHT), machine=machine)


@pytest.mark.parametrize("machine", Machine)
def test_stores_are_seen_in_their_order(machine: Machine) -> None:
    def writes() -> Steps[None]:
        yield store(X, 1, RELAXED)
        yield store(Y, 1, RELAXED)
        yield store(LEFT, 1)

    def reads() -> Steps[None]:
        second = yield load(Y)
        first = yield load(X)
        if second > first:
            yield store(RIGHT, 1)

    assert not is_possible(writes, reads, machine=machine)


def test_a_ring_wakes_who_sleeps_and_nobody_later() -> None:
    def sleeps() -> Steps[None]:
        yield wait(BELL, 0, [])

    def rings() -> Steps[None]:
        yield ring(BELL)

    found = Explorer(Scenario([0] * len(NAMES), NAMES, [sleeps, rings]), TSO).explore()

    assert found.lost.splitlines() == ["thread 1: rings: ring bell", "thread 0: sleeps"]
