"""When the growth of a recorded value is told, and what is said about it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.results.growth import GrowthWatch, ReadColumn
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.plan import Plan
from fmu_mesh.variables.model_description import Variable
from tests.fmus.helpers import NO_COMPILER, build_test_fmu
from tests.fmus.packing import repacked

POINTS = 2000
DOUBLING = np.concatenate([np.ones(500), 2.0 ** np.arange(1, 1000), np.full(POINTS - 1499, 1e300)])


def watch_of(read: ReadColumn, last: int, kind: str = "Float64", **given: float) -> GrowthWatch:
    """What watches one variable; ``given`` are fields of its model description."""
    variable = Variable("y", 0, cast("Any", kind), "output", "continuous", **cast("Any", given))
    description = SimpleNamespace(variable_of=lambda _name: variable)
    plan = SimpleNamespace(
        grid=TimeGrid(0.0, 0.5, last),
        system=SimpleNamespace(instances={"a": SimpleNamespace(description=description)}),
        cycles=(("a", "b"),),
    )
    watch = GrowthWatch(cast("Plan", plan))
    watch.begin({("a", "y"): read})
    return watch


def warnings_of(
    values: np.ndarray[Any, Any], *, block: int = 512, last: int | None = None, step: int = 1, **given: float
) -> tuple[str, ...]:
    """What is told about a variable with these values; ``given`` are fields of its model description."""
    kind = "Float32" if values.dtype == np.float32 else "Float64"
    last = len(values) - 1 if last is None else last
    watch = watch_of(lambda first, end: values[first:end:step], last, kind, **given)
    for first in range(0, len(values), block):
        watch.look(first, min(first + block, len(values)))
    return watch.warnings


@pytest.mark.parametrize("block", [1, 7, 512, POINTS])
def test_a_doubling_value_is_told_once_whatever_the_blocks(block: int) -> None:
    (told,) = warnings_of(DOUBLING, block=block)

    assert told == (
        "a.y grows by a factor of 2 per point: it left its scale of 1 at point 500 (t = 250 s), and 1e6 times this "
        "scale at point 519 (t = 259.5 s). It belongs to the cycle a, b: a smaller step size may keep it stable."
    )


@pytest.mark.parametrize(
    ("values", "given"),
    [
        (np.linspace(0.0, 9.9e5, POINTS), {}),
        (np.linspace(2.0, 1.9e6, POINTS), {}),
        (np.linspace(0.0, 9e8, POINTS), {"nominal": 1e3}),
        (np.linspace(0.0, 9e8, POINTS), {"minimum": -1e3}),
        (np.linspace(0.0, 9e8, POINTS), {"maximum": 1e3}),
        (np.where(np.arange(POINTS) < 100, 1e300, 1e305), {}),
        (np.full(POINTS, np.nan), {}),
    ],
)
def test_a_value_within_a_million_times_its_scale_is_not_told(
    values: np.ndarray[Any, Any], given: dict[str, float]
) -> None:
    assert warnings_of(values, **cast("Any", given)) == ()


def test_a_small_nominal_value_is_the_scale() -> None:
    assert (
        "its scale of 1e-06 at point 100" in warnings_of(np.where(np.arange(POINTS) < 100, 0.0, 2.0), nominal=1e-6)[0]
    )


def test_a_jump_within_one_point_is_told() -> None:
    told = warnings_of(np.where(np.arange(POINTS) < 300, 1.0, 1e9).astype(np.float32))

    assert told[0].startswith(
        "a.y grows by a factor of 1e+09 per point: it left its scale of 1 at point 300 (t = 150 s)"
    )


def test_the_first_thousand_points_are_normal_in_a_run_without_an_end() -> None:
    values = np.where(np.arange(POINTS) < 999, 1.0, 1e9)

    assert warnings_of(values, last=2**62) == ()
    assert warnings_of(values)


def test_the_nominal_value_of_fmi_2_is_read(tmp_path: Path) -> None:
    fmu = repacked(tmp_path / "own.fmu", description=lambda xml: xml.replace("<Real ", '<Real nominal="1e5" '))

    assert {variable.nominal for variable in read_description(fmu).variables if variable.start is not None} == {1e5}


@pytest.mark.skipif(NO_COMPILER is not None, reason=NO_COMPILER or "")
def test_the_nominal_value_of_fmi_3_is_read(tmp_path: Path) -> None:
    source = build_test_fmu("AllTypes3", tmp_path)
    fmu = repacked(
        tmp_path / "own.fmu",
        source=source,
        description=lambda xml: xml.replace(' start="0"', ' nominal="1e5" start="0"'),
    )

    found = {variable.name: variable.nominal for variable in read_description(fmu).variables}
    assert (found["float64_in"], found["float32_in"], found["float64_out"]) == (1e5, 1e5, None)


@pytest.mark.parametrize(("start", "factor", "is_told"), [(1.0, 1.5, True), (1e300, 1.5, True), (1.0, 1.2, False)])
def test_one_look_at_the_whole_run_tells_what_many_tell(start: float, factor: float, is_told: bool) -> None:  # noqa: FBT001  a column of the table
    values = np.concatenate([np.full(200, start), start * factor ** np.arange(1, 41), np.full(POINTS - 240, 1.0)])

    told = warnings_of(values, block=POINTS)

    assert told == warnings_of(values, block=7)
    assert bool(told) == is_told


def test_a_watch_that_begins_again_knows_nothing_of_the_run_before() -> None:
    first, again = DOUBLING, np.full(POINTS, 2.0)
    watched = [first]
    watch = watch_of(lambda begin, end: watched[0][begin:end], len(first) - 1)
    watch.look(0, 500)
    watch.look(500, POINTS)
    before = watch.warnings

    watched[0] = again
    watch.begin_again()
    watch.look(0, 500)
    watch.look(500, POINTS)

    assert before
    assert watch.warnings == ()
