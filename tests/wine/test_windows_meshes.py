"""Meshes with FMUs for Windows: every float is that of a C loop over their DLLs under the same Wine."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml

from fmu_mesh.instances.fmi.wine import wine_version
from tests.equivalence.reference import Pipe, Reference, Table, Unit
from tests.fmus.event_fmus import Version, build_event_fmu
from tests.fmus.helpers import FMUS, find_fmu, session_folder
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
def test_texts_and_bytes_of_fmi3_pass_as_in_the_native_twin(place: Place, arguments: Sequence[str]) -> None:
    """Of two instances in a row: what a getter returns, and what a setter takes."""
    kinds = ["binary", "binary_array", "string", "string_array", "boolean", "uint8", "float32"]

    def run(name: str, fmu: Path) -> bytes:
        values = {
            "columns": 2,
            "binary_in": "AAH/",
            "binary_array_in": [["AA==", ""], ["/w==", "AAAA"]],
            "string_in": "ä",
        }
        content = {
            "mesh": name,
            "simulation": {"stop_time": 0.5, "step_size": 0.1},
            "instances": {
                "first": {"fmu": str(fmu), "start_values": values},
                "second": {"fmu": str(fmu), "start_values": {"columns": 2}},
            },
            "connections": [f"first.{kind}_out -> second.{kind}_in" for kind in kinds],
            "record": {"file": f"{name}.csv", "variables": [f"second.{kind}_out" for kind in kinds]},
        }
        config = place.folder / f"{name}.yaml"
        config.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
        launched = place.run("launch", config, *arguments)
        assert launched.wait() == 0, launched.errors
        return (place.folder / f"{name}.csv").read_bytes()

    windows = run("windows", windows_fmu("AllTypes3"))

    assert b"AAH/" in windows
    assert windows == run("native", find_fmu("AllTypes3", place.folder))
    place.assert_nothing_left(within_s=5.0)


def test_a_result_says_with_which_wine_it_was_computed(place: Place) -> None:
    config = mesh_of(place, ["pendulum"])
    result = place.folder / "result.csv"
    notes = place.folder / "result.csv.json"

    assert place.run("launch", config).wait() == 0
    models = json.loads(notes.read_text(encoding="utf-8"))["models"]
    notes.write_text(
        notes.read_text(encoding="utf-8").replace("under Wine (wine-", "under Wine (wine-1"), encoding="utf-8"
    )
    again = place.run("rerun", result)

    assert models["pendulum"]["computed_by"].startswith(f"FMI 2.0, under Wine ({wine_version()}")
    assert models["delay"]["computed_by"] == "FMI 2.0"
    assert again.wait() == 0, again.errors
    assert "'pendulum' was computed by FMI 2.0, under Wine (wine-1" in again.errors


def test_inspect_and_check_say_that_it_runs_under_wine(place: Place) -> None:
    inspected = place.run("inspect", windows_fmu("Gain"))
    checked = place.run("check", mesh_of(place, ["gain"]))

    assert "Runs here    under Wine" in inspected.output
    assert "gain      Gain.fmu (FMI 2.0, under Wine)" in checked.output
