"""All orders of events of the flag `sending` of a stream: who finds it taken leaves its news to the thread that has it.

`take_flag_or_ask` and `send_and_release` of `streams.c`. News that nobody sends keep a thread asleep
for ever here, and the explorer finds it.
"""

from __future__ import annotations

from functools import partial

import pytest

from tests.explorer import FENCE, Explorer, Found, Machine, Order, Scenario, Steps, add, load, store, swap, wait

VALUE, SENDING, SENT, ENDED, BELL = range(5)
NAMES = ["value", "sending", "sent", "ended", "bell"]


def write(without: str) -> Steps[None]:
    """Send what is new, or ask the thread that has the flag."""
    while True:
        seen = yield load(SENDING, Order.RELAXED)  # a compare and swap that fails is no more than this
        if seen == 0 and (yield swap(SENDING, 0, 1)) == 0:
            break
        if seen == 2 and without == "who finds a question asks, too":
            return
        if seen != 0 and (yield swap(SENDING, seen, 2)) == seen:
            return
    while True:
        while (found := (yield swap(SENDING, seen, 1))) != seen:  # the exchange
            seen = found
        del found
        value = yield load(VALUE, Order.RELAXED)
        yield store(SENT, value, Order.RELAXED)
        if (yield swap(SENDING, 1, 0)) == 1 or without == "the look at the flag when it is given back":
            return


def raising(values: tuple[int, ...], threads: int, without: str) -> Steps[None]:
    """Raise the counter to some values, and write after each; without values, only write."""
    for value in values or (0,):
        if values:
            yield store(VALUE, value, Order.RELAXED)
        yield from write(without)
    yield FENCE
    if (yield add(ENDED)) == threads - 1:
        sent = yield load(SENT)
        value = yield load(VALUE)
        if sent != value:
            yield wait(BELL, 0, [])


def explore(machine: Machine, without: str = "") -> Found:
    threads: list[tuple[int, ...]] = [(1, 2), (), ()]
    programs = [partial(raising, values, len(threads), without) for values in threads]
    return Explorer(Scenario([0] * len(NAMES), NAMES, programs), machine).explore()


@pytest.mark.parametrize("machine", Machine, ids=lambda machine: machine.name)
def test_what_is_new_is_sent_by_somebody(machine: Machine) -> None:
    found = explore(machine)

    assert not found.lost, found.lost


@pytest.mark.parametrize("part", ["who finds a question asks, too", "the look at the flag when it is given back"])
def test_without_one_of_its_parts_news_are_not_sent(part: str) -> None:
    assert explore(Machine.WEAK, part).lost
