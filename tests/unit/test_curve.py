"""The history of a variable keeps the smallest and the largest value of each interval, in bounded memory."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from fmu_mesh.dashboard.curve import BUCKETS, SPANS, BoundedCurve, CurveChange, Looks


def _points(change: CurveChange) -> set[tuple[float, float]]:
    return {*zip(change.t_low, change.low, strict=True), *zip(change.t_high, change.high, strict=True)}


def _apply(cells: dict[int, tuple[float, float, float, float]], change: CurveChange) -> None:
    """What the page does with a change."""
    if change.whole:
        cells.clear()
    columns = (change.t_low, change.low, change.t_high, change.high)
    cells |= {at: (a, b, c, d) for at, a, b, c, d in zip(change.at, *columns, strict=True)}


def _memory_of(curve: BoundedCurve) -> int:
    """Of its arrays, in bytes."""
    parts = (curve._whole, *curve._recent.values())
    return sum(array.nbytes for part in parts for array in vars(part).values() if isinstance(array, np.ndarray))


def test_a_short_history_has_every_value() -> None:
    curve = BoundedCurve(0.0, 0.1)
    times, values = np.arange(5, dtype=np.float64) * 0.1, np.array([1.0, 3.0, 2.0, -1.0, 0.0])

    curve.add(times, values)

    assert _points(curve.since(0)) == {*zip(times.tolist(), values.tolist(), strict=True)}


def test_a_long_history_has_smallest_and_largest_values_and_no_more_intervals() -> None:
    curve = BoundedCurve(0.0, 1e-3)
    times = np.arange(1_000_000, dtype=np.float64) * 1e-3
    values = np.sin(times)
    values[123_456], values[654_321] = 7.0, -9.0

    for part in np.array_split(np.arange(len(times)), 100):
        curve.add(times[part], values[part])

    change = curve.since(0)
    assert BUCKETS // 2 <= len(change.at) <= BUCKETS
    assert (times[123_456], 7.0) in _points(change)
    assert (times[654_321], -9.0) in _points(change)
    assert _memory_of(curve) == _memory_of(BoundedCurve(0.0, 1.0)) < 150_000


@given(
    st.lists(st.tuples(st.integers(0, 20_000), st.floats(-1e3, 1e3)), min_size=1, max_size=60),
    st.randoms(use_true_random=False),
    st.integers(1, 7),
)
def test_a_page_that_takes_changes_has_what_a_new_page_gets(
    points: list[tuple[int, float]], random: object, parts: int
) -> None:
    order = list(points)
    random.shuffle(order)  # type: ignore[attr-defined]  # a random.Random
    curve, cells, version = BoundedCurve(0.0, 1.0), dict[int, tuple[float, float, float, float]](), 0

    for part in range(parts):
        some = order[part::parts]
        curve.add(np.array([float(at) for at, _ in some]), np.array([value for _, value in some]))
        change = curve.since(version)
        _apply(cells, change)
        version = change.version

    fresh = dict[int, tuple[float, float, float, float]]()
    _apply(fresh, curve.since(0))
    assert cells == fresh
    values = [value for _, value in points]
    assert min(low for _, low, _, _ in fresh.values()) == min(values)
    assert max(high for _, _, _, high in fresh.values()) == max(values)


def test_values_that_are_not_finite_are_left_out() -> None:
    curve = BoundedCurve(0.0, 1.0)

    curve.add(np.array([0.0, 1.0, 2.0]), np.array([np.nan, np.inf, 5.0]))

    assert _points(curve.since(0)) == {(2.0, 5.0)}


def test_nothing_is_sent_twice() -> None:
    curve = BoundedCurve(0.0, 1.0)
    curve.add(np.array([0.0]), np.array([1.0]))

    change = curve.since(curve.since(0).version)

    assert not change.whole
    assert change.at == []


def test_a_page_with_a_version_of_another_curve_gets_all() -> None:
    curve = BoundedCurve(0.0, 1.0)
    curve.add(np.array([0.0]), np.array([1.0]))
    other = BoundedCurve(0.0, 1.0)

    assert curve.since(99).whole
    assert other.since(curve.since(0).version).whole


@pytest.mark.parametrize("span", SPANS)
def test_the_last_seconds_are_kept_in_finer_intervals(span: int) -> None:
    curve, cells, version = BoundedCurve(0.0, 1e-3), dict[int, tuple[float, float, float, float]](), 0
    times = np.arange(700_000, dtype=np.float64) * 1e-3
    values = np.sin(7.0 * times)

    for part in np.array_split(np.arange(len(times)), 50)[::-1]:  # new ones first
        curve.add(times[part], values[part])
        change = curve.since(version, span)
        _apply(cells, change)
        version = change.version

    newest = times[-1] - span * 0.99
    kept = {(t, v) for a, b, c, d in cells.values() for t, v in ((a, b), (c, d)) if t >= newest}
    assert min(t for t, _ in kept) < newest + 2.0 * span / 512
    assert max(t for t, _ in kept) > times[-1] - 2.0 * span / 512
    assert kept <= {*zip(times.tolist(), values.tolist(), strict=True)}
    assert max(v for _, v in kept) == values[times >= newest].max()
    fresh = dict[int, tuple[float, float, float, float]]()
    _apply(fresh, curve.since(0, span))
    assert {at: cells[at] for at in fresh} == fresh


def _segments(change: CurveChange) -> list[tuple[float, float]]:
    """The first and the last time of each line that the page draws."""
    order = sorted(range(len(change.at)), key=change.at.__getitem__)
    found: list[tuple[float, float]] = []
    is_cut = True
    for n in order:
        first, last = sorted((change.t_low[n], change.t_high[n]))
        found = [*found, (first, last)] if is_cut else [*found[:-1], (found[-1][0], last)]
        is_cut = change.at[n] in change.gaps
    return found


def _times(first: int, last: int) -> NDArray[np.float64]:
    return np.arange(first, last + 1, dtype=np.float64)


@pytest.mark.parametrize("span", [0, 600])
def test_no_line_leads_over_values_that_nobody_looked_at(span: int) -> None:
    curve = BoundedCurve(0.0, 1.0)

    for first, last in ((0, 9), (40, 40), (60, 69)):
        after = None
        for time in _times(first, last):
            curve.add(np.array([time]), np.array([time]), after)
            after = time

    assert _segments(curve.since(0, span)) == [(0.0, 9.0), (40.0, 40.0), (60.0, 69.0)]


def test_a_gap_stays_where_intervals_become_wider() -> None:
    curve = BoundedCurve(0.0, 1e-3)

    curve.add(times := _times(0, 3000) * 1e-3, times)
    curve.add(times := _times(9000, 30_000) * 1e-3, times)

    assert _segments(curve.since(0)) == [(0.0, 3.0), (9.0, 30.0)]


def test_rows_that_are_not_finite_or_not_there_are_gaps() -> None:
    curve = BoundedCurve(0.0, 1.0)
    times = np.concatenate([_times(0, 30), _times(35, 60)])
    values = np.where((times > 10) & (times < 14), np.nan, times)
    values[times == 50.0] = np.inf

    curve.add(times, values)

    assert _segments(curve.since(0)) == [(0.0, 10.0), (14.0, 30.0), (35.0, 49.0), (51.0, 60.0)]


@pytest.mark.parametrize("stride", [1, 7, 50])
def test_values_that_come_seldom_or_are_held_are_one_line(stride: int) -> None:
    curve = BoundedCurve(0.0, 1.0)
    times = _times(0, 100) * stride

    after = None
    for part in np.array_split(times, 9):
        curve.add(part, np.where(part < 40.0, 1.0, 2.0), after)
        after = float(part[-1])

    assert _segments(curve.since(0)) == [(0.0, times[-1])]


def test_the_values_of_a_gap_that_come_later_close_it() -> None:
    curve = BoundedCurve(0.0, 1.0)
    curve.add(new := _times(50, 60), new)
    page = curve.since(0)

    curve.add(old := _times(0, 55), old)

    assert _segments(page) == [(50.0, 60.0)]
    assert 49 in curve.since(page.version).at
    assert _segments(curve.since(0)) == [(0.0, 60.0)]


def test_a_page_that_takes_changes_knows_which_gaps_are_closed() -> None:
    curve = BoundedCurve(0.0, 1.0)
    curve.add(np.array([1.0]), np.array([1.0]))
    before = curve.since(0)

    curve.add(np.array([5.0]), np.array([1.0]), 1.0)

    assert before.gaps == [1]
    assert (change := curve.since(before.version)).at == [1, 5]
    assert change.gaps == [5]


def _continued(looks: Looks, times: Mapping[float, float], step: float) -> list[bool]:
    """Whether the value of each look, by wall-clock and simulation time, follows the one before."""
    found = []
    for now, time in times.items():
        looks.begin(now)
        found.append(looks.after("a.x", now, time, step) is not None)
    return found


def test_a_value_that_was_not_looked_at_once_begins_a_line() -> None:
    looks = Looks(0.05)

    before = _continued(looks, {0.0: 1.0, 0.05: 1.5, 0.1: 2.0}, 0.01)
    looks.begin(0.15)  # nobody wants it

    assert before == [False, True, True]
    assert _continued(looks, {0.2: 3.0, 0.25: 3.5}, 0.01) == [False, True]


def test_a_late_look_begins_a_line_and_slow_looks_do_not() -> None:
    late = _continued(Looks(0.05), {0.0: 1.0, 0.05: 1.5, 3.0: 4.0, 3.05: 4.5}, 0.01)
    slow = _continued(Looks(0.05), {float(look): 2.0 * look for look in range(100)}, 0.01)

    assert late == [False, True, False, True]
    assert slow[-50:] == [True] * 50


def test_a_value_for_which_an_answer_took_long_begins_a_line() -> None:
    looks = Looks(0.05)
    _continued(looks, {0.0: 1.0, 0.05: 1.5}, 0.01)

    looks.begin(0.1)  # and now the process sleeps, with the answer on its way
    old = looks.after("a.x", 3.0, 2.0, 0.01)
    looks.begin(3.05)

    assert old is None
    assert looks.after("a.x", 3.05, 4.5, 0.01) is None


def test_nothing_is_missing_between_two_points_of_a_slow_instance() -> None:
    times = {0.0: 1.0, 20.0: 1.0, 60.0: 2.0, 100.0: 4.0}

    assert _continued(Looks(0.05), times, 1.0) == [False, True, True, False]
    assert _continued(Looks(0.05), times, np.inf) == [False, True, True, True]
