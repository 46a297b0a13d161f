"""The work for a connection does not grow with the number of connections: counted, in lines of Python, not timed."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from fmu_mesh.config.findings import Findings
from fmu_mesh.config.mesh import ConnectionConfig
from fmu_mesh.pictures.plan_page import plan_page
from fmu_mesh.system.connections import Variables, resolve_connections
from fmu_mesh.system.layout import Layout
from fmu_mesh.system.plan import make_plan
from fmu_mesh.system.point_loops import warn_of_point_loops
from fmu_mesh.system.system import build
from fmu_mesh.variables.model_description import ModelDescription, Variable
from tests.planning import parse

FILE = Path("/models/mesh.yaml")
FEW, MANY = 50, 400
GROWTH = MANY / FEW


def lines_run(call: Callable[[], object]) -> int:
    """How many lines of Python a call runs; each turn of a loop counts, also of one within a line."""
    count = 0

    def count_line(_frame: FrameType, event: str, _argument: object) -> Any:  # noqa: ANN401 as `sys.settrace` has it
        nonlocal count
        count += event == "line"
        return count_line

    before = sys.gettrace()
    sys.settrace(count_line)
    try:
        call()
    finally:
        sys.settrace(before)
    return count


def description(width: int) -> ModelDescription:
    """An FMU with so many inputs and outputs; each output depends on the input of its number."""
    variables = chain.from_iterable(
        (
            Variable(f"u{n}", n, "Float64", "input", "continuous", start=0.0),
            Variable(
                f"y{n}",
                n,
                "Float64",
                "output",
                "continuous",
                "calculated",
                dependencies=(f"u{n}",),
                feedthrough=(f"u{n}",),
            ),
        )
        for n in range(width)
    )
    return ModelDescription("wide", "wide", "2.0", "co_simulation", "{1}", tuple(variables))


def ends(width: int, system: str) -> Iterator[tuple[str, str]]:
    """Source and target of all connections."""
    back = ("b", "c") if system == "a chain" else ("b", "a")
    pairs = (("a", "b"), back)
    return ((f"{source}.y{n}", f"{target}.u{n}") for source, target in pairs for n in range(width))


@pytest.mark.parametrize("system", ["a chain", "two cycles of each variable"])
def test_a_plan_takes_as_many_times_the_work_as_there_are_connections(system: str) -> None:
    def planning(width: int) -> Callable[[], object]:
        connections = "".join(f"  - {source} -> {target}\n" for source, target in ends(width, system))
        loaded = parse(
            "mesh: wide\nsimulation: {stop_time: 1, step_size: 0.1}\n"
            f"instances: {{a: {{fmu: w.fmu}}, b: {{fmu: w.fmu}}, c: {{fmu: w.fmu}}}}\nconnections:\n{connections}",
            FILE,
        )
        descriptions = dict.fromkeys("abc", description(width))

        def plan_and_warn() -> None:
            plan = make_plan(build(loaded, descriptions))
            warn_of_point_loops(plan, loaded.findings())
            plan_page(plan)

        return plan_and_warn

    few, many = lines_run(planning(FEW)), lines_run(planning(MANY))

    assert few > FEW
    assert many <= GROWTH * few  # less, because a part of the work is for all of them


def test_a_place_in_a_row_is_found_without_looking_at_all_columns() -> None:
    def finding(count: int) -> Callable[[], object]:
        layout = Layout.of((f"v{number}", "Float64") for number in range(count))
        return lambda: [(layout.place(name), layout.column(name), name in layout) for name in layout.names]

    few, many = lines_run(finding(FEW)), lines_run(finding(MANY))

    assert few > FEW
    assert many <= GROWTH * few


class Counted(dict[str, Variable]):
    """Variables by name that count how often all of them are looked through."""

    listed = 0

    def values(self) -> Any:  # noqa: ANN401 a view of a dict
        Counted.listed += 1
        return super().values()


def test_no_connection_that_is_right_looks_through_all_variables() -> None:
    variables = Variables(dict.fromkeys("abc", description(FEW)), "abc")
    variables |= {name: Counted((v.name, v) for v in description(FEW).variables) for name in "abc"}
    configs = [ConnectionConfig(source=source, target=target) for source, target in ends(FEW, "a chain")]
    findings = Findings(str(FILE))
    Counted.listed = 0

    connections = resolve_connections(configs, variables, findings)

    assert len(connections) == 2 * FEW
    assert list(findings) == []
    assert Counted.listed == 0
