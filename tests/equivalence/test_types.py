"""Values of every type, and arrays, over the wire and in one process: the same in every bit, and what they must be."""

from __future__ import annotations

import base64
import csv
import io
import json
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from fmu_mesh.cli.main import main
from fmu_mesh.run.options import PlanOptions
from tests.fmus.helpers import NO_COMPILER, build_test_fmu
from tests.helpers import Place
from tests.plain_run import PlainRun
from tests.planning import prepare

pytestmark = pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))

POINTS = 7
GEAR = {-(2**63): "reverse", 1: "low", 2**63 - 1: "high"}
BYTES = [b"", b"\0", b"\xff\xfe", b"ab", bytes(300), b"z"]
FIRST: dict[str, list[Any]] = {
    "float64": [0.1, -0.0, 5e-324, 1.7976931348623157e308, -1e-7, 3.0],
    "float32": [0.10000000149011612, -0.0, 1.401298464324817e-45, 3.4028234663852886e38, -2.0, 3.0],
    "int8": [-128, 127, 0, 1, 2, 3],
    "uint8": [255, 0, 1, 2, 3, 4],
    "int16": [-(2**15), 2**15 - 1, 0, 1, 2, 3],
    "uint16": [2**16 - 1, 0, 1, 2, 3, 4],
    "int32": [-(2**31), 2**31 - 1, 0, 1, 2, 3],
    "uint32": [2**32 - 1, 0, 1, 2, 3, 4],
    "int64": [-(2**63), 2**63 - 1, 0, 1, 2, 3],
    "uint64": [2**64 - 1, 0, 1, 2, 3, 4],
    "boolean": [True, False, False, True, True, True],
    "enumeration": [1, -(2**63), 1, 2**63 - 1, 1, 1],
    "string": ["", 'a "quoted", text', "two\nlines", "ü\N{GRINNING FACE}", "[]", "x" * 50],
    "binary": BYTES,
}
"""The elements of each array of instance `a`; those of `b` have moved on by one place."""

INDICES = ["1,1", "1,2", "1,3", "2,1", "2,2", "2,3"]


def plain(name: str, values: list[Any]) -> list[Any]:
    """An array as a configuration has it."""
    match name:
        case "binary":
            values = [base64.b64encode(value).decode() for value in values]
        case "enumeration":
            values = [GEAR[value] for value in values]
    return [values[:3], values[3:]]


def written(folder: Path) -> Path:
    """Two FMUs of FMI 3.0, between which elements move on by one place, one of FMI 2.0 and one of FMI 1.0 behind.

    They are no cycle: at the start there would be no values that agree with those that have moved on.
    """
    fmus = {name: str(build_test_fmu(name, folder)) for name in ("AllTypes3", "AllTypes", "AllTypes1")}
    connections: list[str | dict[str, Any]] = []
    for name in FIRST:
        pairs = zip(INDICES, INDICES[1:] + INDICES[:1], strict=True)
        connections += [f"a.{name}_array_out[{i}] -> b.{name}_array_in[{j}]" for i, j in pairs]
        connections += [f"b.{name}_array_out[2,3] -> c.{name}_in"]
    connections += ["c.float64_out -> old.real_in", "c.int32_out -> old.integer_in", "c.boolean_out -> old.boolean_in"]
    connections += ["c.string_out -> old.string_in", "c.int16_out -> older.integer_in"]
    connections += [{"from": "c.float32_out", "to": "older.real_in", "factor": 0.5, "offset": 0.25}]
    connections += ["c.boolean_out -> c.uint16_array_in[2,1]", "old.string_out -> older.string_in"]
    connections += ["c.uint32_out -> c.float64_array_in[1,2]", "old.boolean_out -> older.boolean_in"]
    starts: dict[str, Any] = {f"{name}_array_in": plain(name, values) for name, values in FIRST.items()}
    recorded = [f"{i}.{name}_array_out" for i in "ab" for name in FIRST]
    recorded += ["c.float64_array_out", "c.uint16_array_out", "older.real_out", "older.string_out", "older.integer_out"]
    recorded += ["older.boolean_out", "older.boolean_opposite", "older.integer_opposite"]
    content = {
        "mesh": "types",
        "simulation": {"stop_time": POINTS * 0.1, "step_size": 0.1},
        "instances": {
            "a": {"fmu": fmus["AllTypes3"], "start_values": starts},
            "b": {"fmu": fmus["AllTypes3"]},
            "c": {"fmu": fmus["AllTypes3"], "start_values": {"columns": 2, "uint16_array_in": [[1, 2], [3, 4]]}},
            "old": {"fmu": fmus["AllTypes"]},
            "older": {"fmu": fmus["AllTypes1"]},
        },
        "connections": connections,
        "record": {"file": "result.csv", "variables": recorded},
    }
    path = folder / "mesh.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False, allow_unicode=True), encoding="utf-8")
    return path


@pytest.fixture
def looked_at(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Iterator[Callable[..., Any]]:
    """A function that runs a command on a mesh of one FMU of FMI 3.0, and returns its lines of JSON or its error."""
    with Place() as place:
        fmu = build_test_fmu("AllTypes3", place.folder)
        config = place.folder / "mesh.yaml"
        config.write_text(
            "mesh: types\nsimulation: {stop_time: 600, step_size: 0.01, real_time_factor: 1}\n"
            f"instances: {{it: {{fmu: {fmu}, start_values: {{columns: 1}}, not_finite: record}}}}\n"
            "record: {file: null}\n"
        )
        launched = place.start("launch", config, "--no-progress")
        place.note()
        monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(place.folder / "run"))

        def call(*arguments: str) -> Any:  # noqa: ANN401 JSON, or text
            code = main(arguments)
            captured = capsys.readouterr()
            return [json.loads(line) for line in captured.out.splitlines()] if code == 0 else captured.err

        yield call
        launched.signal(signal.SIGTERM)
        launched.wait()


def test_every_type_can_be_asked_for_set_and_watched(looked_at: Callable[..., Any]) -> None:
    given = {
        "uint64_in": "18446744073709551615",
        "int64_array_in": "[[-9223372036854775808], [9223372036854775807]]",
        "float32_parameter": "0.1",
        "float64_array_in": '[["-INF"], [-0.0]]',
        "boolean_array_in": "[[true], [false]]",
        "string_in": "5",
        "string_array_in": '[["a\\nb"], [""]]',
        "binary_in": "1234",
        "enumeration_in": "high",
    }
    for name, text in given.items():
        (answer,) = looked_at("set", f"it.{name}", text, "--json")
        assert answer["point"] >= 0, answer

    read = {r["variable"]: r["value"] for r in looked_at("get", *(f"it.{name}" for name in given), "--json")}
    watched = {
        name: looked_at("watch", f"it.{name}", "--count", "1", "--json")[0]["value"]
        for name in ("string_array_out", "uint64_out", "binary_out")
    }

    assert repr(read) == repr(
        {
            "uint64_in": 2**64 - 1,
            "int64_array_in": [[-(2**63)], [2**63 - 1]],
            "float32_parameter": 0.10000000149011612,
            "float64_array_in": [["-INF"], [-0.0]],
            "boolean_array_in": [[True], [False]],
            "string_in": "5",
            "string_array_in": [["a\nb"], [""]],
            "binary_in": "1234",
            "enumeration_in": 2**63 - 1,
        }
    )
    assert watched == {"string_array_out": [["a\nb"], [""]], "uint64_out": 2**64 - 1, "binary_out": "1234"}
    views = {view["name"]: view for view in looked_at("info", "it", "--json")[0]["variables"]}
    assert (views["int8_array_in"]["type"], views["int8_array_in"]["shape"]) == ("Int8", [2, 1])
    assert views["int8_array_in"]["start"] == [[0], [0]]
    assert "it.int8_in': 128 is no Int8 value for it; expected a whole number from -128 to 127" in looked_at(
        "set", "it.int8_in", "128"
    )
    assert "expected a list of 2 x 1 values" in looked_at("set", "it.int8_array_in", "[1, 2]")


def cell(value: Any) -> str:  # noqa: ANN401 of any type
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    return value if isinstance(value, str) else json.dumps(value).replace("e-0", "e-").replace("e+", "e")


def test_every_type_is_same_over_wire_and_in_one_process_and_right() -> None:
    with Place() as place:
        config = written(place.folder)
        local = place.folder / "local.csv"
        PlainRun(prepare(config, PlanOptions(output=local))).run()
        process = place.run("launch", config, "--no-progress")
        assert process.wait() == 0, process.errors
        content = (place.folder / "result.csv").read_bytes()

        assert content == local.read_bytes()

    rows = list(csv.DictReader(io.StringIO(content.decode(), newline="")))
    assert len(rows) == POINTS + 1
    for point, row in enumerate(rows):
        for name, first in FIRST.items():
            for instance, moved in (("a", first), ("b", first[-1:] + first[:-1])):
                # An exponent may have a sign.
                got = [row[f"{instance}.{name}_array_out[{index}]"].replace("e+", "e") for index in INDICES]
                assert got == [cell(value) for value in moved], (instance, name, point)
        last = [first[4] for first in FIRST.values()]
        values = dict(zip(FIRST, last, strict=True))
        assert row["older.real_out"] == cell(values["float32"] * 0.5 + 0.25)
        assert row["older.integer_out"] == cell(values["int16"])
        assert row["older.integer_opposite"] == cell(-values["int16"])
        assert row["older.boolean_out"] == cell(values["boolean"])
        assert row["older.boolean_opposite"] == cell(not values["boolean"])
        assert row["older.string_out"] == values["string"]
        assert [row[f"c.uint16_array_out[{i}]"] for i in ("1,1", "1,2", "2,1", "2,2")][:2] == ["1", "2"]
        assert row["c.uint16_array_out[2,2]"] == "4"
