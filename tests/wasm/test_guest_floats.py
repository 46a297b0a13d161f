"""An FMU in a sandbox of WebAssembly gives the floats that it gives natively, but where the C libraries differ."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

import fmu_mesh
from fmu_mesh.instances.fmi.archive.reading import read_description
from tests.fmus.event_fmus import Version, build_event_fmu, event_source_fmu
from tests.fmus.helpers import FMUS, KEPT_FMUS, NO_COMPILER, find_fmu
from tests.fmus.packing import repacked
from tests.helpers import Place, rows_of, write_config
from tests.wasm.guests import SANDBOX, meshed

OF_ANOTHER_LIBM = {"ActiveShuttle", "DampedPendulum"}
"""Their sines are those of musl in the sandbox, and those of glibc outside."""


def both(fmu: Path, **keys: Any) -> tuple[fmu_mesh.Result, fmu_mesh.Result]:  # noqa: ANN401 those of an instance
    """The results natively and in the sandbox, with all inputs away from 0."""
    inputs = read_description(fmu).with_causality("input")
    started = {one.name: 0.7 for one in inputs if one.type == "Float64" and not one.shape}
    own = {"start_values": started} | keys
    native, guest = (meshed(fmu, process, **own) for process in (None, SANDBOX))
    return native.run(processes=False, record="memory"), guest.run(processes=False, record="memory")


@pytest.mark.parametrize("name", KEPT_FMUS)
def test_example_fmus_give_native_floats(name: str) -> None:
    native, guest = both(FMUS / f"{name}.fmu")

    assert list(native) == list(guest)
    for variable in native:
        if name in OF_ANOTHER_LIBM:
            np.testing.assert_allclose(guest[variable], native[variable], rtol=1e-12, atol=1e-14)
        else:
            np.testing.assert_array_equal(guest[variable], native[variable])


@pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))
@pytest.mark.parametrize("kind", ["co_simulation", "model_exchange"])
@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("name", ["Ball", "Stairs", "Oscillator"])
def test_events_happen_where_they_do_natively(
    tmp_path: Path, name: str, version: Version, kind: Literal["co_simulation", "model_exchange"]
) -> None:
    built = build_event_fmu(name, version, tmp_path)
    sources = event_source_fmu(name, version, tmp_path / "sources.fmu")

    native = meshed(built, None, kind=kind).run(processes=False, record="memory")
    guest = meshed(sources, kind=kind).run(processes=False, record="memory")

    for variable in native:
        np.testing.assert_array_equal(guest[variable], native[variable])


@pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))
@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("AllTypes", {}),
        ("AllTypes3", {"columns": 3, "string_in": "Grüße", "binary_in": "AAECAwQ="}),
    ],
)
def test_each_type_goes_in_and_out(tmp_path: Path, name: str, values: dict[str, Any]) -> None:
    fmu = find_fmu(name, tmp_path)
    known = {one.name for one in read_description(fmu).variables}

    native, guest = both(fmu, start_values={name: value for name, value in values.items() if name in known})

    assert set(values) <= known
    for variable in native:
        np.testing.assert_array_equal(guest[variable], native[variable])


def test_nodes_give_the_floats_of_one_process(place: Place) -> None:
    config = write_config(place.folder, process=SANDBOX, simulation={"algorithm": "gauss_seidel"})
    local = place.run("launch", "--local", config)
    assert local.wait() == 0, local.story()
    expected = rows_of(config.with_suffix(".csv"))

    launched = place.run("launch", config)

    assert launched.wait() == 0, launched.story()
    assert rows_of(config.with_suffix(".csv")) == expected
    assert math.isfinite(float(expected[-1][1]))
    place.assert_nothing_left()


def test_a_group_may_have_guests_and_others(place: Place) -> None:
    instances: dict[str, dict[str, Any]] = {
        "gain": {"fmu": "Gain", "start_values": {"k": 3.0, "u": 2.0}, "group": "one", "process": SANDBOX},
        "integrator": {"fmu": "Integrator", "group": "one"},
    }
    names = {one.causality: one.name for one in read_description(FMUS / "Integrator.fmu").variables}
    config = write_config(place.folder, instances=instances, connections=[f"gain.y -> integrator.{names['input']}"])

    launched = place.run("launch", config)

    assert launched.wait() == 0, launched.story()
    assert len(rows_of(config.with_suffix(".csv"))) == 1001
    place.assert_nothing_left()


def test_a_prefix_of_functions_is_found(tmp_path: Path) -> None:
    with zipfile.ZipFile(FMUS / "Gain.fmu") as archive:
        header = archive.read("sources/fmi2Functions.h")
    prefixed = repacked(
        tmp_path / "prefixed.fmu",
        keep=lambda name: not name.startswith("binaries/") and name != "sources/fmi2Functions.h",
        add={"sources/fmi2Functions.h": b"#define FMI2_FUNCTION_PREFIX Gain_\n" + header},
    )

    result = meshed(prefixed, start_values={"u": 2.0, "k": 3.0}).run(processes=False, record="memory")

    assert set(result["one.y"]) == {6.0}
