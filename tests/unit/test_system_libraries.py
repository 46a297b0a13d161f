"""Libraries of the system that an FMU needs: what is found, and what is told before and after a load that fails."""

from __future__ import annotations

import subprocess
from pathlib import Path
from zipfile import ZipInfo

import pytest

import fmu_mesh
from fmu_mesh.errors import LoadFailed
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.archive.system_libraries import missing_libraries
from fmu_mesh.instances.fmi.opening import open_instance
from fmus.build import find_compiler
from tests.fmus.helpers import FMUS, NO_COMPILER
from tests.fmus.packing import repacked

LIBRARY = "binaries/linux64/Gain.so"

needs_compiler = pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))


def built(folder: Path, name: str, *needed: str, version: str = "", run_path: str = "") -> bytes:
    """A library in the folder that needs other ones in it, and whose function has a version."""
    calls = "int newest(void); int one(void) { return newest(); }" if needed else "int newest(void) { return 1; }"
    (folder / "one.c").write_text(f"{calls}\n")
    options = ["-Wl,--no-as-needed", f"-L{folder}", *(f"-l:{other}" for other in needed), f"-Wl,-soname,{name}"]
    if version:
        (folder / "versions").write_text(f"{version} {{ global: newest; }};\n")
        options.append(f"-Wl,--version-script,{folder / 'versions'}")
    options += [f"-Wl,-rpath,{run_path}"] if run_path else []
    command = [*find_compiler(), "-shared", "-fPIC", "-o", str(folder / name), str(folder / "one.c"), *options]
    subprocess.run(command, check=True, timeout=60)
    return (folder / name).read_bytes()


def fmu_of(path: Path, library: bytes, **beside: bytes) -> Path:
    """The gain with another library, and with others beside it."""
    others: dict[str | ZipInfo, bytes] = {f"binaries/linux64/{name}.so": data for name, data in beside.items()}
    return repacked(path, keep=lambda name: name != LIBRARY, add={LIBRARY: library, **others})


@pytest.mark.parametrize("name", ["Gain", "DampedPendulum"])
def test_the_libraries_of_c_are_on_every_system(name: str) -> None:
    assert missing_libraries(FMUS / f"{name}.fmu", f"binaries/linux64/{name}.so") == ()


@needs_compiler
def test_a_missing_library_is_named_with_its_package_before_and_after_run(tmp_path: Path) -> None:
    built(tmp_path, "libgfortran.so.4")
    built(tmp_path, "libnobody_has.so.7")
    path = fmu_of(tmp_path / "gain.fmu", built(tmp_path, "Gain.so", "libgfortran.so.4", "libnobody_has.so.7"))
    mesh = fmu_mesh.Mesh("one", step_size=0.1, stop_time=1.0)
    mesh.add("gain", fmu=path)
    before = Path.cwd()

    inspection = fmu_mesh.inspect(path)
    [finding] = mesh.check().findings
    with pytest.raises(LoadFailed) as failed:
        open_instance(path, "gain", read_description(path), tmp_path / "own")

    package = f"this system has no libgfortran.so.4, which '{LIBRARY}' needs; on Debian and Ubuntu it is in the package"
    other = f"this system has no libnobody_has.so.7, which '{LIBRARY}' needs"
    assert Path.cwd() == before
    assert not inspection.runs_here
    assert inspection.problems == (f"{package} libgfortran4", other)
    assert (finding.path, finding.found) == ("instances.gain.fmu", f"{package} libgfortran4; {other}")
    assert f"cannot be instantiated: {package} libgfortran4; {other}" in str(failed.value)


@needs_compiler
def test_a_library_beside_the_first_one_is_there_and_its_needs_count(tmp_path: Path) -> None:
    built(tmp_path, "libfar.so")
    near = built(tmp_path, "libnear.so", "libfar.so")
    path = fmu_of(tmp_path / "gain.fmu", built(tmp_path, "Gain.so", "libnear.so"), libnear=near)

    missing = missing_libraries(path, LIBRARY)

    assert missing == ("this system has no libfar.so, which 'binaries/linux64/libnear.so' needs",)


@needs_compiler
def test_a_library_in_a_run_path_inside_the_fmu_is_there(tmp_path: Path) -> None:
    far = built(tmp_path, "libfar.so")
    library = built(tmp_path, "Gain.so", "libfar.so", run_path="$ORIGIN/../../resources/lib")
    path = repacked(
        tmp_path / "gain.fmu",
        keep=lambda name: name != LIBRARY,
        add={LIBRARY: library, "resources/lib/libfar.so": far},
    )

    assert missing_libraries(path, LIBRARY) == ()


@needs_compiler
def test_a_library_of_system_that_is_too_old_is_told_with_version(tmp_path: Path) -> None:
    built(tmp_path, "libm.so.6", version="GLIBC_9.99")
    path = fmu_of(tmp_path / "gain.fmu", built(tmp_path, "Gain.so", "libm.so.6"))

    [missing] = missing_libraries(path, LIBRARY)

    assert missing == f"libm.so.6 of this system is too old: it has no GLIBC_9.99, which '{LIBRARY}' needs"
