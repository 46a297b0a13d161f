"""Meshes with FMUs for Windows: every float is that of a C loop over their DLLs under the same Wine."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml

import fmu_mesh
from fmu_mesh.instances.fmi.wine import wine_version
from tests.equivalence.reference import Pipe, Reference, Table, Unit
from tests.fmus.event_fmus import Version, build_event_fmu
from tests.fmus.helpers import FMUS, build_test_fmu, session_folder
from tests.helpers import BY_STREAMS, Place, rows_of, write_config
from tests.wine.windows import NEEDS_WINE, run_dlls, windows_event_fmu, windows_fmu

pytestmark = NEEDS_WINE

STEP = 0.002
POINTS = 1000
NAMES = {"pendulum": "DampedPendulum", "delay": "TransportDelay", "sum": "Integrator", "gain": "Gain"}
START_VALUES: dict[str, dict[str, float]] = {
    "pendulum": {"a": 1.3, "d": 0.1},
    "delay": {"d": 0.3},
    "sum": {},
    "gain": {"k": -2.5},
}
POINTS_EACH = {"delay": 2}
PIPES = [
    Pipe("pendulum", "a", "delay", "x", 0),
    Pipe("delay", "y", "sum", "u", 0),
    Pipe("sum", "y", "gain", "u", 0),
]
RECORDED = [("pendulum", "a"), ("pendulum", "der(a)"), ("delay", "y"), ("sum", "y"), ("gain", "y")]


def mesh_of(
    place: Place, windows: Sequence[str], together: Sequence[str] = (), zenoh: Mapping[str, bool] | None = None
) -> Path:
    """A chain of four FMUs; those of ``windows`` have no library for Linux."""
    instances: dict[str, dict[str, Any]] = {
        name: {
            "fmu": str(windows_fmu(model) if name in windows else FMUS / f"{model}.fmu"),
            "start_values": START_VALUES[name],
            "step_size": POINTS_EACH.get(name, 1) * STEP,
            **({"group": "together"} if name in together else {}),
        }
        for name, model in NAMES.items()
    }
    record = {"file": "result.csv", "variables": [f"{name}.{variable}" for name, variable in RECORDED]}
    return write_config(
        place.folder,
        instances=instances,
        connections=[f"{pipe.source}.{pipe.output} -> {pipe.target}.{pipe.input}" for pipe in PIPES],
        stop_time=POINTS * STEP,
        record=record,
        simulation={"step_size": STEP},
        zenoh=zenoh or {},
    )


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> Table:
    """What the C loop computes. Only the pendulum calls a function of the C library, so its platform decides."""
    units = [
        Unit(name, str(windows_fmu(model)), START_VALUES[name], POINTS_EACH.get(name, 1))
        for name, model in NAMES.items()
    ]
    reference = Reference(units, PIPES, STEP, POINTS, RECORDED)
    return run_dlls(reference, tmp_path_factory.mktemp("dlls"))


@pytest.mark.parametrize(
    ("windows", "together", "arguments", "zenoh"),
    [
        (NAMES, (), (), {}),
        (("pendulum", "sum"), (), (), {}),
        (("pendulum", "sum"), (), ("--window", "1"), {}),
        (("pendulum", "sum"), ("delay", "sum"), (), {}),
        (NAMES, NAMES, (), {}),
        (("pendulum", "sum"), (), (), BY_STREAMS),
        (("pendulum", "sum"), (), ("--local",), {}),
    ],
    ids=["windows", "mixed", "lockstep", "group_of_both", "group", "streams", "local"],
)
def test_a_mesh_gives_every_float_of_the_c_loop(
    place: Place,
    expected: Table,
    windows: Sequence[str],
    together: Sequence[str],
    arguments: Sequence[str],
    zenoh: Mapping[str, bool],
) -> None:
    config = mesh_of(place, [*windows], [*together], zenoh)

    launched = place.run("launch", config, *arguments)

    assert launched.wait() == 0, launched.errors
    assert rows_of(place.folder / "result.csv") == expected
    place.assert_nothing_left(within_s=5.0)


def test_sixteen_windows_fmus_at_once_leave_nothing(place: Place) -> None:
    config = write_config(
        place.folder,
        instances={f"g{n}": {"fmu": str(windows_fmu("Gain")), "start_values": {"k": 1.0 + n / 8}} for n in range(16)},
        connections=["g15.y -> g0.u", *(f"g{n}.y -> g{n + 1}.u" for n in range(15))],
        stop_time=0.1,
    )
    native = config.read_text(encoding="utf-8").replace(str(windows_fmu("Gain")), str(FMUS / "Gain.fmu"))
    (place.folder / "native.yaml").write_text(native, encoding="utf-8")

    launched = place.run("launch", config, "--set", "g0.u=0.1", "--output", "windows.csv")
    twin = place.run("launch", "native.yaml", "--set", "g0.u=0.1", "--output", "native.csv")

    assert (launched.wait(), twin.wait()) == (0, 0), launched.errors
    assert rows_of(place.folder / "windows.csv") == rows_of(place.folder / "native.csv")
    place.assert_nothing_left(within_s=5.0)


@pytest.mark.parametrize("arguments", [(), ("--local",)], ids=["distributed", "local"])
@pytest.mark.parametrize(
    ("version", "kind"),
    [(1, "model_exchange"), (2, "co_simulation"), (2, "model_exchange"), (3, "co_simulation"), (3, "model_exchange")],
)
def test_all_versions_and_kinds_give_the_floats_of_their_native_twins(
    place: Place, version: Version, kind: str, arguments: Sequence[str]
) -> None:
    """These models call no function of the C library, so both platforms have the same floats."""

    def run(name: str, build: Callable[[str], Path]) -> bytes:
        instances = {
            "ball": {"fmu": str(build("Ball")), "kind": kind},
            "integral": {"fmu": str(build("Integral")), "kind": kind},
            "stairs": {"fmu": str(build("Stairs")), "kind": kind},
        }
        content = {
            "mesh": name,
            "simulation": {"stop_time": 2.0, "step_size": 0.01},
            "instances": instances,
            "connections": ["ball.h -> integral.u", "integral.above -> stairs.increment"],
            "record": {"file": f"{name}.csv"},
        }
        config = place.folder / f"{name}.yaml"
        config.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
        launched = place.run("launch", config, *arguments)
        assert launched.wait() == 0, launched.errors
        return (place.folder / f"{name}.csv").read_bytes()

    windows = run("windows", lambda model: windows_event_fmu(model, version))

    assert windows == run("native", lambda model: build_event_fmu(model, version, session_folder()))
    place.assert_nothing_left(within_s=5.0)


@pytest.mark.parametrize("arguments", [(), ("--local",)], ids=["distributed", "local"])
def test_bytes_texts_and_arrays_of_both_go_through(place: Place, arguments: tuple[str, ...]) -> None:
    """Binary values have zeros in them, are empty, and change their sizes from point to point."""
    data = [base64.b64encode(value).decode() for value in (b"", b"\0", b"a\0\0b", bytes(range(256)), b"\xff" * 99_999)]
    texts = ["", "a", "ü b", "c" * 70_000]
    times = {"times": [0.01 * point for point in range(1, 6)]}
    values = {
        "a.binary_in": times | {"values": data},
        "a.binary_array_in": times | {"values": [[data[n : n + 2], data[3 - n : 5 - n]] for n in (0, 1, 2, 3, 0)]},
        "a.string_in": times | {"values": [*texts, texts[1]]},
        "a.string_array_in": times | {"values": [[texts[n : n + 2], texts[1 - n : 3 - n]] for n in (0, 1, 0, 1, 0)]},
    }
    outputs = [name.removeprefix("a.").replace("_in", "_out") for name in values]

    def run(name: str, fmu: Path) -> bytes:
        config = write_config(
            place.folder,
            instances={
                one: {"fmu": str(fmu), "start_values": {"columns": 2, "binary_parameter": data[3]}} for one in "ab"
            },
            connections=[f"a.{output} -> b.{output.replace('_out', '_in')}" for output in outputs],
            name=name,
            stop_time=0.08,
            simulation={"step_size": 0.01},
            scenario={"values": values},
            record={"file": f"{name}.csv", "variables": [f"{one}.{output}" for one in "ab" for output in outputs]},
        )
        launched = place.run("launch", config, *arguments)
        assert launched.wait() == 0, launched.errors
        return config.with_suffix(".csv").read_bytes()

    windows = run("windows", windows_fmu("AllTypes3"))

    assert windows == run("native", build_test_fmu("AllTypes3", place.folder))
    assert base64.b64encode(b"\xff" * 99_999) in windows
    place.assert_nothing_left(within_s=5.0)


@pytest.mark.parametrize("name", ["AllTypes1", "Steps1"])
def test_co_simulation_of_fmi1_gives_the_values_of_its_twin(tmp_path: Path, name: str) -> None:
    windows = fmu_mesh.simulate(windows_fmu(name), stop_time=1.0, step_size=0.1)
    native = fmu_mesh.simulate(build_test_fmu(name, tmp_path), stop_time=1.0, step_size=0.1)

    assert {name: windows[name].tolist() for name in windows} == {name: native[name].tolist() for name in native}
    assert len(native.times) == 11


def test_inspect_and_check_say_that_it_runs_under_wine(place: Place) -> None:
    inspected = place.run("inspect", windows_fmu("Gain"))
    checked = place.run("check", mesh_of(place, ["gain"]))

    assert f"Runs here    under {wine_version()}" in inspected.output
    assert f"gain      Gain.fmu (FMI 2.0, under {wine_version()})" in checked.output


def test_a_rerun_under_another_wine_says_so(place: Place) -> None:
    config = mesh_of(place, ["gain"])
    assert place.run("launch", config, "--local", "--stop-time", "0.1").wait() == 0
    beside = place.folder / "result.csv.json"
    made = json.loads(beside.read_text(encoding="utf-8"))
    assert made["models"]["gain"]["computed_by"] == f"FMI 2.0, under {wine_version()}"
    made["models"]["gain"]["computed_by"] = "FMI 2.0, under Wine 1.0"
    beside.write_text(json.dumps(made), encoding="utf-8")
    notices: list[str] = []

    again = fmu_mesh.rerun(place.folder / "result.csv", on_notice=notices.append)

    (notice,) = notices
    assert f"'gain' by 'FMI 2.0, under Wine 1.0', and here by 'FMI 2.0, under {wine_version()}'" in notice
    assert fmu_mesh.Result.read(place.folder / "result.csv").compare(again).equal
