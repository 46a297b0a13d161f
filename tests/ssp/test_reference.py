"""The reference is right: what a person reads in small systems, and the rows of FMPy where it can run one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from fmpy.ssp.simulation import simulate_ssp

from tests.ssp.own_systems import SYSTEMS, make_folder, make_package
from tests.ssp.reference_run import run_system
from tests.ssp.reference_system import FlatSystem, name_of, read_system


def flat(name: str, folder: Path) -> FlatSystem:
    return read_system(make_folder(SYSTEMS[name](), folder / "package"), folder / "unpacked")


def flows(system: FlatSystem) -> list[str]:
    """The connections as `a.y -> b.u`, with what they do to a value."""
    texts = []
    for flow in system.flows:
        (source, output), (target, input_) = flow.source, flow.target
        text = f"{name_of(source)}.{output} -> {name_of(target)}.{input_}"
        if (flow.change.factor, flow.change.offset) != (1.0, 0.0):
            text += f" * {flow.change.factor:.12g} + {flow.change.offset:.12g}"
        texts.append(text + "".join(f" {dict(table)}" for table in flow.change.tables))
    return texts


def starts(system: FlatSystem) -> dict[str, Any]:
    return {name_of(path): fmu.start_values for path, fmu in system.fmus.items() if fmu.start_values}


def test_connections_of_nested_systems_are_followed_from_output_to_input(
    tmp_path: Path,
) -> None:
    system = flat("nested", tmp_path)

    level = "outer--51-rd-32-level"
    assert [name_of(path) for path in system.fmus] == [
        "DP-32-Controller",
        "outer-sum",
        f"{level}-gain-46-a",
        f"{level}--49--32-gain",
        "tank",
    ]
    assert flows(system) == [
        f"{level}-gain-46-a.y -> outer-sum.u1",
        f"{level}--49--32-gain.y -> outer-sum.u2",
        f"DP-32-Controller.a -> {level}-gain-46-a.u",
        f"DP-32-Controller.a -> {level}--49--32-gain.u",
        "outer-sum.y -> tank.u",
    ]


@pytest.mark.parametrize("last", ["a", "b", "c"])
def test_connections_have_the_order_of_the_document(last: str, tmp_path: Path) -> None:
    system = flat(f"cycle {last}", tmp_path)

    ends = {"a": "first.y -> second.u", "b": "second.y -> third.u", "c": "third.y -> first.u"}
    assert flows(system)[-1] == ends[last]


def test_the_connection_of_a_cycle_that_comes_last_is_the_delayed_one(tmp_path: Path) -> None:
    runs = [
        run_system(flat(f"cycle {last}", tmp_path / last), step_size=0.5, stop_time=0.5, algorithm="gauss_seidel")
        for last in ("a", "b", "c")
    ]

    # y' = k u: first k = -0.7, second 1.1, third 0.9; each one starts with the others at 1, 0.5 and -0.25.
    def end(first: float | None, second: float | None, third: float | None) -> tuple[float, float, float]:
        one, two, three = 1.0, 0.5, -0.25
        for _ in range(3):  # None: the value at the end of the step
            one_end = 1.0 + 0.5 * -0.7 * (three if third is None else third)
            two_end = 0.5 + 0.5 * 1.1 * (one if first is None else first)
            three_end = -0.25 + 0.5 * 0.9 * (two if second is None else second)
            one, two, three = one_end, two_end, three_end
        return one, two, three

    assert [rows[1][1:] for _, rows in runs] == [
        pytest.approx(end(1.0, None, None)),
        pytest.approx(end(None, 0.5, None)),
        pytest.approx(end(None, None, -0.25)),
    ]


def test_units_are_converted_on_each_part_of_chain_and_before_its_transformation(tmp_path: Path) -> None:
    system = flat("units", tmp_path)

    # 20 degC are (20 + 273.15 - 255.37) / 0.5555 degF; times 1.5; to K; times 2, plus 1.
    fahrenheit = 1.5 * (20.0 + 273.15 - 255.37) / 0.5555
    kelvin = fahrenheit * 0.5555 + 255.37
    _, rows = run_system(system, step_size=0.125, stop_time=0.125)
    assert rows[0][1:] == pytest.approx((20.0, 2.0 * kelvin + 1.0, 20.0, 24.0, 20.0, 293.15), rel=1e-14)
    assert flows(system)[1:] == [
        "source.y -> none.u",
        "source.y -> plain.u * 1 + 4",
        "source.y -> unknown.u",
        "source.y -> passed.u * 1 + 273.15",
    ]
    assert system.warnings == ["(('unknown',), 'u'): degC to furlong is not defined"]


def test_a_higher_binding_beats_a_lower_one_and_later_one_earlier_one(tmp_path: Path) -> None:
    assert starts(flat("parameters", tmp_path)) == {
        "inner-low": {"k": 4.0, "u": -1.5},
        "inner-twice": {"k": 3.0, "u": 0.25},
        "inner-higher": {"k": 10.0, "u": 7.0},
        "hot": {"k": 20.0, "u": (20.0 + 273.15) * 2.0 + 1.0},
        "raw": {"u": 41.0},
        "file": {"k": 0.5, "u": 8.0, "y": 5.0},
    }


def test_a_connected_parameter_takes_the_value_of_its_connection(tmp_path: Path) -> None:
    assert starts(flat("connected parameters", tmp_path)) == {
        "inner-a": {"k": 3.0, "u": 1.0},
        "inner-b": {"k": 30.5, "u": 1.0},
        "inner-c": {"k": 1.25, "u": 6.0},
        "d": {"k": 276.15, "u": 1.0},
    }


def test_values_of_all_types_are_mapped(tmp_path: Path) -> None:
    system = flat("types", tmp_path)

    outputs, rows = run_system(system, step_size=0.125, stop_time=0.25)
    last = {f"{name_of(path)}.{name}": value for (path, name), value in zip(outputs, rows[-1][1:], strict=True)}
    types = ("real", "integer", "boolean", "string", "enumeration")
    assert [last[f"same.{type_}_out"] for type_ in types] == [0.5, 3, True, "text", 3]
    assert [last[f"mapped.{type_}_out"] for type_ in types] == [0.0, 30, False, "", 1]
    assert [last[f"mixed.{type_}_out"] for type_ in types] == [3.0, 0, False, "", 3]


def test_an_archive_and_its_folder_are_the_same_system(tmp_path: Path) -> None:
    package = make_package(SYSTEMS["parameters"](), tmp_path)

    from_archive = read_system(package, tmp_path / "unpacked")
    from_folder = read_system(tmp_path / "own_unpacked", tmp_path / "not used")

    assert starts(from_archive) == starts(from_folder)


def test_where_all_inputs_start_at_zero_the_rows_are_those_of_fmpy(tmp_path: Path) -> None:
    """FMPy does not propagate before the first point; so the first output must be what it takes instead: zero."""
    package = make_package(SYSTEMS["chain"](), tmp_path)

    outputs, rows = run_system(read_system(package, tmp_path / "unpacked"), step_size=0.125, stop_time=2.0)
    fmpys = simulate_ssp(str(package), stop_time=2.0, step_size=0.125)

    assert any(value != 0.0 for value in rows[-1][1:])
    for number, (path, name) in enumerate(outputs, start=1):
        column = f"{'.'.join(path)}.{name}"
        if column in fmpys.dtype.names:
            assert [row[number] for row in rows[1:]] == fmpys[column].tolist(), column
    assert {"source.linearVelocity", "outer.gain.y", "sum.y", "tank.y"} <= set(fmpys.dtype.names)
