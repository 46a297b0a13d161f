"""The history of a variable keeps the smallest and the largest value of each interval, in bounded memory."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmu_mesh.dashboard.curve import BUCKETS, SPANS, BoundedCurve, CurveChange


def _points(change: CurveChange) -> set[tuple[float, float]]:
    return {*zip(change.t_low, change.low, strict=True), *zip(change.t_high, change.high, strict=True)}


def _apply(cells: dict[int, tuple[float, float, float, float]], change: CurveChange) -> None:
    """What the page does with a change."""
    if change.whole:
        cells.clear()
    columns = (change.t_low, change.low, change.t_high, change.high)
    cells |= {at: (a, b, c, d) for at, a, b, c, d in zip(change.at, *columns, strict=True)}


def test_a_short_history_has_every_value() -> None:
    curve = BoundedCurve(0.0, 0.1)
    times, values = np.arange(5, dtype=np.float64) * 0.1, np.array([1.0, 3.0, 2.0, -1.0, 0.0])

    curve.add(times, values)

    assert _points(curve.since(0)) == {*zip(times.tolist(), values.tolist(), strict=True)}


def test_a_long_history_has_the_smallest_and_the_largest_values_and_no_more_intervals() -> None:
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
    assert curve.size == BoundedCurve(0.0, 1.0).size < 150_000


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
