"""What SSP can say and a mesh does: connections, start values with their lines, and every float of a run."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import pytest

import fmu_mesh
from tests.ssp.comparing import differences
from tests.ssp.packages import write_package
from tests.ssp.reference_run import run_system
from tests.ssp.reference_system import read_system, solver_of
from tests.ssp.supported_systems import SUPPORTED, Supported

RUNS = [(own, algorithm) for own in SUPPORTED for algorithm in own.algorithms]


def name_of(part: Supported | str) -> str:
    return part if isinstance(part, str) else part.name


def package_of(own: Supported, folder: Path, suffix: str = ".ssp") -> Path:
    built = folder / "built"
    built.mkdir()
    return write_package(folder / f"own{suffix}", own.files(built))


def options_of(own: Supported, algorithm: str) -> dict[str, Any]:
    return {"algorithm": algorithm} if own.step_size is None else {"algorithm": algorithm, "step_size": own.step_size}


@pytest.mark.parametrize("own", SUPPORTED, ids=lambda own: own.name)
@pytest.mark.parametrize("suffix", [".ssp", ""])
def test_check_shows_connections_start_values_and_where_they_come_from(
    own: Supported, suffix: str, tmp_path: Path
) -> None:
    path = package_of(own, tmp_path, suffix)

    check = fmu_mesh.load(path, ssd=own.ssd).check(**options_of(own, own.algorithms[0]))

    assert check.findings == ()
    plan = check.plan
    assert plan is not None
    connections = [
        f"{one.source} -> {one.target}"
        + (f" * {one.factor:.12g} + {one.offset:.12g}" if (one.factor, one.offset) != (1.0, 0.0) else "")
        + (f" {one.map}" if one.map else "")
        for one in plan.connections
    ]
    assert connections == [*own.connections]
    starts = {f"{one.name}.{name}": value for one in plan.instances for name, value in one.start_values.items()}
    assert starts == {name: start.value for name, start in own.starts.items()}
    origins = {f"{one.name}.{name}": origin for one in plan.instances for name, origin in one.origins.items()}
    for name, start in own.starts.items():
        origin = origins[name]
        assert origin.file == str(path / start.file), name
        assert start.line in text_of(own, start.file, tmp_path).splitlines()[(origin.line or 0) - 1], (name, origin)
    assert {one.name: one.step_size for one in plan.instances} == {
        one.name: own.step_sizes.get(one.name, plan.simulation.step_size) for one in plan.instances
    }
    assert len(check.warnings) == len(own.warnings), check.warnings
    for words in own.warnings:
        assert any(all(word in warning for word in words) for warning in check.warnings), check.warnings


def text_of(own: Supported, name: str, folder: Path) -> str:
    """The text of a file of the package; the name may lead into an archive."""
    files = own.files(folder / "built")
    if name in files:
        content = files[name]
        return content if isinstance(content, str) else content.decode()
    outer = next(one for one in files if name.startswith(f"{one}/"))
    data = files[outer]
    assert isinstance(data, bytes)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return archive.read(name.removeprefix(f"{outer}/")).decode()


@pytest.mark.parametrize(("own", "algorithm"), [run for run in RUNS if run[0].in_reference], ids=name_of)
def test_a_run_equals_the_independent_reference(own: Supported, algorithm: str, tmp_path: Path) -> None:
    path, result = package_of(own, tmp_path), tmp_path / "result.csv"
    file = own.ssd if own.ssd in own.files(tmp_path / "built") else "SystemStructure.ssd"
    reference = read_system(path, tmp_path / "unpacked", file or "SystemStructure.ssd")

    fmu_mesh.load(path, ssd=file).run(
        output=result, processes=False, config_values=solver_of(reference), **options_of(own, algorithm)
    )

    outputs, rows = run_system(reference, step_size=0.125, stop_time=1.0, algorithm=algorithm)
    assert differences(result, outputs, rows) == []


@pytest.mark.parametrize(("own", "algorithm"), RUNS, ids=name_of)
def test_a_run_in_processes_is_the_run_in_one_process(own: Supported, algorithm: str, tmp_path: Path) -> None:
    mesh = fmu_mesh.load(package_of(own, tmp_path), ssd=own.ssd)
    apart, here = tmp_path / "apart.csv", tmp_path / "here.csv"

    mesh.run(output=apart, **options_of(own, algorithm))
    mesh.run(output=here, processes=False, **options_of(own, algorithm))

    assert len(here.read_text().splitlines()) == 1 + 9
    assert apart.read_bytes() == here.read_bytes()


def test_one_connection_is_delayed_where_two_cycles_share_it(tmp_path: Path) -> None:
    [own] = [own for own in SUPPORTED if own.name == "two cycles that share a connection"]

    check = fmu_mesh.load(package_of(own, tmp_path)).check(**options_of(own, "gauss_seidel"))

    assert check.plan is not None
    assert [one.target for one in check.plan.connections if one.closes_cycle] == ["one.u"]
