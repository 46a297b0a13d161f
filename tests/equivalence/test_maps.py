"""Connections with a map, integers for Enumerations and sources that are no outputs: as a plain loop over FMPy."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml

import fmu_mesh
from tests.equivalence.plain_loop import Wire, run_plainly
from tests.fmus.helpers import NO_COMPILER, build_test_fmu
from tests.fmus.packing import repacked
from tests.helpers import BY_STREAMS, BY_ZENOH, Place
from tests.plain_run import PlainRun
from tests.planning import prepare

pytestmark = pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))

POINTS = 12
STEP_SIZE = 0.1
LARGEST, LEAST = 2**63 - 1, -(2**63)

GEARS = ("low", "high", "middle", "high", "low", "low", "middle", "middle", "high", "low", "middle", "low", "high")
"""What each number of steps is mapped to, in FMI 2.0 (low 1, middle 2, high 3)."""
GEAR_NUMBERS = {"low": 1, "middle": 2, "high": 3}

MAPS: dict[str, dict[Any, Any]] = {
    "clock.steps -> x.int32_in": {"0": 100, "3": -7, "8": 5},
    "clock.steps -> y.enumeration_in": {str(number): gear for number, gear in enumerate(GEARS)},
    "clock.steps -> w.integer_in": {},
    "y.enumeration_out -> z.enumeration_in": {"low": "reverse", "middle": 1, "3": "high"},
    "z.enumeration_out -> x.int64_in": {"reverse": LARGEST, str(LARGEST): LEAST},
    "x.int32_out -> z.int64_in": {"-7": LEAST},
    "v.boolean_out -> w.boolean_in": {"true": False, "false": True},
    "w.boolean_out -> v.boolean_in": {},
    "v.boolean_out -> x.uint16_in": {"true": 65535},
    "x.uint64_out -> z.uint64_in": {str(2**64 - 1): 2**63, "0": 5},
    "z.uint64_out -> z.uint64_array_in[1,2]": {str(2**63): 2**64 - 1},
    "x.int8_array_out -> z.int8_array_in": {"3": -3},
}
"""The connections, each with its map."""

NUMBERS: dict[str, Mapping[Any, Any]] = {
    **MAPS,
    "clock.steps -> y.enumeration_in": {number: GEAR_NUMBERS[gear] for number, gear in enumerate(GEARS)},
    "y.enumeration_out -> z.enumeration_in": {1: LEAST, 2: 1, 3: LARGEST},
    "z.enumeration_out -> x.int64_in": {LEAST: LARGEST, LARGEST: LEAST},
    "v.boolean_out -> w.boolean_in": {True: False, False: True},
    "v.boolean_out -> x.uint16_in": {True: 65535, False: 0},
}
DELAYED = ("x.int32_out -> z.int64_in", "w.boolean_out -> v.boolean_in", "x.uint64_out -> z.uint64_in")
RECORDED = (
    "x.int32_out", "y.enumeration_out", "z.enumeration_out", "x.int64_out", "z.int64_out", "v.boolean_out",
    "w.boolean_out", "x.uint16_out", "z.uint64_out", "w.integer_out", "clock.steps",
)  # fmt: skip
STARTS: dict[str, dict[str, Any]] = {"x": {"uint64_in": 2**64 - 1}}
WAYS: list[tuple[tuple[str, ...], dict[str, Any]]] = [
    ((), {}),
    (("--window", "1"), {}),
    ((), {"zenoh": BY_STREAMS}),
    ((), {"zenoh": BY_ZENOH}),
    (("--window", "3"), {"group": "auto"}),
    ((), {"grouped": ("clock", "v", "w", "x", "y", "z")}),
]
"""Options of `launch`, and what else is in the file."""
EIGHTS = [[1, 2, 3], [3, -3, 0]]


def changed(mapping: Mapping[Any, Any], value: Any) -> Any:  # noqa: ANN401  of any type
    return mapping.get(value, value)


def fmus_in(folder: Path) -> dict[str, Path]:
    """One FMU for each instance; `v` and `w` declare that their outputs depend on nothing in Initialization Mode."""
    old, new = build_test_fmu("AllTypes", folder), build_test_fmu("AllTypes3", folder)

    def independent(text: str) -> str:
        head, tail = text.split("<InitialUnknowns>")
        for number in range(1, 6):
            tail = tail.replace(f'dependencies="{number}"', 'dependencies=""')
        return f"{head}<InitialUnknowns>{tail}"

    free = repacked(folder / "Free.fmu", source=old, description=independent)
    return {"clock": old, "v": free, "w": free, "y": old, "x": new, "z": new}


def written(folder: Path, fmus: Mapping[str, Path], grouped: tuple[str, ...] = (), **sections: Any) -> Path:  # noqa: ANN401  of a file
    instances = {
        name: {
            "fmu": str(path),
            "start_values": {**STARTS.get(name, {}), **({"int8_array_in": EIGHTS} if name == "x" else {})},
            **({"group": "together"} if name in grouped else {}),
        }
        for name, path in fmus.items()
    }
    connections = [
        {"from": source, "to": target, "map": mapping}
        for (source, target), mapping in ((ends.split(" -> "), mapping) for ends, mapping in MAPS.items())
    ]
    content = {
        "mesh": "maps",
        "simulation": {"stop_time": POINTS * STEP_SIZE, "step_size": STEP_SIZE},
        "instances": instances,
        "connections": connections,
        "record": {"file": "maps.csv", "variables": [*RECORDED, "z.uint64_array_out", "z.int8_array_out"]},
        **sections,
    }
    path = folder / "maps.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path


def plain_rows(fmus: Mapping[str, Path]) -> list[tuple[Any, ...]]:
    """The reference, for scalars; the two cycles are closed by the connections that are written last."""
    wires = []
    for ends, mapping in NUMBERS.items():
        source, target = ends.split(" -> ")
        numbers = {int(key) if isinstance(key, str) else key: value for key, value in mapping.items()}
        if "array" not in ends:
            wires.append(Wire(source, target, int(ends in DELAYED), partial(changed, numbers)))
    by_target = {wire.target: wire for wire in wires}
    last = [by_target["z.enumeration_in"], by_target["z.int64_in"]], [by_target["x.int64_in"]]
    first = [wire for wire in wires if wire not in (*last[0], *last[1])]
    return run_plainly(
        {name: (fmus[name], STARTS.get(name, {})) for name in ("clock", "v", "w", "y", "z", "x")},
        wires,
        [first, *last],
        points=POINTS,
        step_size=STEP_SIZE,
        recorded=RECORDED,
    )


def values_in(file: Path) -> list[tuple[Any, ...]]:
    """The rows of a result; a Boolean is a bool."""
    _, *rows = csv.reader(file.read_text(encoding="utf-8").splitlines())
    return [(float(time), *map(json.loads, row)) for time, *row in rows]


def test_values_are_mapped_as_in_a_plain_loop_in_all_processes() -> None:
    with Place() as place:
        fmus = fmus_in(place.folder)
        config = written(place.folder, fmus)
        result = place.folder / "maps.csv"
        PlainRun(prepare(config)).run()
        local = result.read_bytes()
        width = 1 + len(RECORDED)

        rows = values_in(result)
        assert [row[:width] for row in rows] == plain_rows(fmus)
        assert {row[width : width + 6] for row in rows[1:]} == {(0, 2**64 - 1, 0, 0, 0, 0)}
        assert {row[width + 6 :] for row in rows} == {(1, 2, -3, -3, -3, 0)}

        for options, sections in WAYS:
            written(place.folder, fmus, **sections)
            result.unlink()
            process = place.run("launch", config, "--no-progress", *options)
            assert process.wait() == 0, process.errors
            assert result.read_bytes() == local, (options, sections)


def test_without_the_library_of_c_a_map_gives_the_same() -> None:
    with Place() as place:
        config = written(place.folder, fmus_in(place.folder), grouped=("x", "z", "y"))
        result = place.folder / "maps.csv"
        PlainRun(prepare(config)).run()
        local = result.read_bytes()
        place.environment = {**place.environment, "FMU_MESH_LIBRARY": "none"}

        process = place.run("launch", config, "--no-progress")

        assert process.wait() == 0, process.errors
        assert result.read_bytes() == local


@pytest.mark.parametrize("library", ["", "none"])
@pytest.mark.parametrize("target", ["AllTypes", "AllTypes3"])
def test_a_value_that_is_no_item_ends_the_run_with_its_names(target: str, library: str) -> None:
    with Place() as place:
        fmus = {"clock": build_test_fmu("AllTypes", place.folder), "y": build_test_fmu(target, place.folder)}
        mapping = {"0": "low", "3": "high"} | ({"2": 1} if target == "AllTypes3" else {})
        config = place.folder / "mesh.yaml"
        content = {
            "mesh": "refused",
            "simulation": {"stop_time": 1.2, "step_size": 0.1},
            "instances": {name: {"fmu": str(path)} for name, path in fmus.items()},
            "connections": [{"from": "clock.steps", "to": "y.enumeration_in", "map": mapping}],
            "record": {"file": "result.csv"},
        }
        config.write_text(yaml.safe_dump(content, sort_keys=False))
        place.environment = {**place.environment, "FMU_MESH_LIBRARY": library} if library else place.environment
        items = (
            "low (1), middle (2), high (3)" if target == "AllTypes" else f"reverse ({LEAST}), low (1), high ({LARGEST})"
        )
        expected = f"'clock.steps' is 4, which is no item of its input: {items}"

        process = place.run("launch", config, "--no-progress")

        assert process.wait() == 3
        assert expected in process.message
        assert "instance y.enumeration_in" in process.message
        assert "point 3" in process.message
        with pytest.raises(fmu_mesh.StepFailed) as caught:
            PlainRun(prepare(config)).run()
        assert (caught.value.instance, caught.value.variable, caught.value.point) == ("y", "enumeration_in", 3)
        assert caught.value.message == expected
