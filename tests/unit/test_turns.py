"""The recorder takes its time from all processors in turn where the nodes need them all."""

from __future__ import annotations

import os

import pytest

from fmu_mesh.recorder.recorder import _Turns as Turns


class Scheduler:
    """Notes where a thread is moved to, on a machine with these processors."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, processors: set[int]) -> None:
        self.allowed = set(processors)
        self.left = set(processors)
        self.moves: list[set[int]] = []
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(self.allowed), raising=False)
        monkeypatch.setattr(os, "sched_setaffinity", self._set, raising=False)
        monkeypatch.setattr("fmu_mesh.recorder.recorder._CAN_CHOOSE", True)

    def _set(self, thread: int, processors: set[int]) -> None:
        assert thread == 0  # the calling one
        if not self.left.intersection(processors):
            raise OSError(22, "Invalid argument")
        self.allowed = set(processors)
        self.moves.append(set(processors))


@pytest.mark.parametrize("busy", [2, 3, 8])
def test_it_goes_round_all_processors_and_is_bound_to_none(monkeypatch: pytest.MonkeyPatch, busy: int) -> None:
    scheduler = Scheduler(monkeypatch, {1, 4})
    turns = Turns(busy)

    for _ in range(3):
        turns.next()
        assert scheduler.allowed == {1, 4}

    assert [move for move in scheduler.moves if len(move) == 1] == [{4}, {1}, {4}]


@pytest.mark.parametrize(("processors", "busy"), [({0}, 1), ({0}, 4), ({0, 1}, 1), ({0, 1, 2, 3}, 3), ({0, 1}, 0)])
def test_with_one_processor_or_with_one_to_spare_it_is_left_alone(
    monkeypatch: pytest.MonkeyPatch, processors: set[int], busy: int
) -> None:
    scheduler = Scheduler(monkeypatch, processors)

    Turns(busy).next()

    assert scheduler.moves == []


def test_a_processor_that_is_taken_away_at_this_moment_is_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    scheduler = Scheduler(monkeypatch, {0, 1})
    scheduler.left = {0}
    turns = Turns(2)

    turns.next()
    assert scheduler.moves == []
    turns.next()
    assert scheduler.moves == [{0}, {0, 1}]


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="only Linux lets a thread choose")
def test_the_system_lets_it() -> None:
    before = os.sched_getaffinity(0)

    for _ in range(3):
        Turns(len(before)).next()

    assert os.sched_getaffinity(0) == before
