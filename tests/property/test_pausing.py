"""All orders of events of a pause: a master takes the grant back while nodes claim points (docs/rings.md).

No node may be beyond the point that the master answers. A node that is sleeps for ever here, and the explorer finds it.
"""

from __future__ import annotations

from functools import partial

import pytest

from tests.explorer import FENCE, WORK, Explorer, Found, Machine, Order, Scenario, Steps, load, store, wait

LAST = 4
GRANT, ANSWER, CLAIMED, ENDED, BELL = 0, 1, (2, 3), (4, 5), 6
NAMES = ["grant", "answer", "claimed[0]", "claimed[1]", "ended[0]", "ended[1]", "bell"]
MEMORY = [LAST, LAST, 0, 0, 0, 0, 0]


def node(number: int, bursts: tuple[int, ...], without: str) -> Steps[None]:
    """`claim` and `allow` of `burst.c`: a step below the allowed point, which is looked up when it is reached."""
    point = allowed = claimed = 0
    lengths = iter(bursts)
    while point < LAST:
        if point >= allowed:
            if claimed <= point:
                claimed = point + next(lengths)
                yield store(CLAIMED[number], claimed, Order.RELAXED)
                if without != "the fence of claim":
                    yield FENCE
            allowed = min((yield load(GRANT, Order.RELAXED)), claimed)
            if without == "the limit of what is claimed":
                allowed = yield load(GRANT, Order.RELAXED)
            if allowed <= point:
                break
        yield WORK
        point += 1
    yield store(ENDED[number], point)
    yield FENCE
    if point > (yield load(ANSWER)):
        yield wait(BELL, 0, [])


def master(without: str) -> Steps[None]:
    """`grant_withdraw`, and the grant of the point that it returns."""
    yield store(GRANT, 0, Order.RELAXED)
    if without != "the fence of grant_withdraw":
        yield FENCE
    most = 0
    for place in CLAIMED:
        most = max(most, (yield load(place, Order.RELAXED)))
    yield store(GRANT, most, Order.RELAXED)
    yield store(ANSWER, most)
    yield FENCE
    for place in ENDED:
        if (yield load(place)) > most:
            yield wait(BELL, 0, [])


def explore(machine: Machine, without: str = "") -> Found:
    programs = [partial(node, 0, (1, 2, 4), without), partial(node, 1, (2, 4), without), partial(master, without)]
    return Explorer(Scenario(MEMORY, NAMES, programs), machine).explore()


@pytest.mark.parametrize("machine", Machine, ids=lambda machine: machine.name)
def test_no_node_is_beyond_the_point_of_a_pause(machine: Machine) -> None:
    found = explore(machine)

    assert not found.lost, found.lost


@pytest.mark.parametrize("part", ["the fence of claim", "the fence of grant_withdraw", "the limit of what is claimed"])
def test_without_one_of_its_parts_a_node_passes_point_of_a_pause(part: str) -> None:
    assert explore(Machine.WEAK, part).lost
