"""FMUs whose library or model identifier is not what the standard demands: what can run, runs."""

from __future__ import annotations

import re
import shutil
import zipfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
import yaml

from fmu_mesh import FMIAdapter
from fmu_mesh.cli.main import main
from fmu_mesh.errors import LoadFailed
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.opening import open_instance
from tests.fmus.helpers import FMUS, NO_COMPILER, find_fmu
from tests.fmus.packing import repacked, unpacked

GAIN = FMUS / "Gain.fmu"


def renamed(target: Path, *names: str, source: Path = GAIN, description: Callable[[str], str] = lambda t: t) -> Path:
    """Write ``target``: an FMU whose library has these names, each beside the others, and no sources."""
    with zipfile.ZipFile(source) as archive:
        (old,) = [name for name in archive.namelist() if name.startswith("binaries/")]
        library = archive.read(old)
    folder = old.rpartition("/")[0]
    return repacked(
        target,
        source=source,
        description=description,
        keep=lambda name: not name.startswith(("binaries/", "sources/")),
        add={f"{folder}/{name}": library for name in names},
    )


def without_identifier(text: str) -> str:
    changed = re.sub(r' modelIdentifier="[^"]*"', "", text)
    assert changed != text
    return changed


def config_with(fmu: Path, result: str = "one.csv", **more: object) -> Path:
    file = fmu.parent / "mesh.yaml"
    content = {
        "mesh": "one",
        "simulation": {"stop_time": 1, "step_size": 0.1},
        "instances": {"gain": {"fmu": str(fmu), "start_values": {"u": 3.0, "k": 0.1}, **more}},
        "record": {"file": result},
    }
    file.write_text(yaml.safe_dump(content), encoding="utf-8")
    return file


@pytest.mark.parametrize("options", [(), ("--local",)], ids=["distributed", "local"])
@pytest.mark.parametrize("description", [lambda text: text, without_identifier], ids=["named", "without identifier"])
@pytest.mark.parametrize("form", ["archive", "folder"])
def test_the_only_library_is_loaded_whatever_its_name_is(
    description: Callable[[str], str], options: tuple[str, ...], form: str, tmp_path: Path
) -> None:
    expected = config_with(Path(shutil.copy(GAIN, tmp_path)), "expected.csv")
    assert main(["launch", *options, str(expected)]) == 0
    fmu = renamed(tmp_path / "odd.fmu", "exported_v2.so", description=description)
    if form == "folder":
        fmu = unpacked(tmp_path / "folder", source=fmu)
    before = sorted(tmp_path.glob("folder/**/*"))

    assert main(["launch", *options, str(config_with(fmu))]) == 0

    assert (fmu.parent / "one.csv").read_bytes() == (tmp_path / "expected.csv").read_bytes()
    assert sorted(tmp_path.glob("folder/**/*")) == before


@pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))
@pytest.mark.parametrize("name", ["AllTypes1", "AllTypes", "AllTypes3"])
def test_so_it_is_in_every_version_and_in_the_adapter(name: str, tmp_path: Path) -> None:
    fmu = renamed(tmp_path / "odd.fmu", "exported_v2.so", source=find_fmu(name, tmp_path / "built"))

    description = read_description(fmu)

    with closing(open_instance(fmu, "odd", description, tmp_path)) as instance:
        instance.enter_initialization(0.0, 1.0, {})
        instance.exit_initialization()
    with FMIAdapter(fmu, 0.1) as adapter:
        adapter.exit_initialization_mode(0.0)
        adapter.do_step()


@pytest.mark.parametrize("version", [1, 2, 3])
def test_so_it_is_in_model_exchange(event_fmu: Callable[..., Path], version: int, tmp_path: Path) -> None:
    more = {} if version == 1 else {"only": "model_exchange"}
    fmu = renamed(tmp_path / "odd.fmu", "exported_v2.so", source=event_fmu("Ball", version, **more))

    description = read_description(fmu)

    assert description.kind == "model_exchange"
    with closing(open_instance(fmu, "odd", description, tmp_path)) as instance:
        instance.enter_initialization(0.0, 1.0, {})
        instance.exit_initialization()


def test_of_several_libraries_with_other_names_none_is_taken(tmp_path: Path) -> None:
    fmu = renamed(tmp_path / "odd.fmu", "model.so", "solver.so")

    with pytest.raises(LoadFailed) as caught:
        read_description(fmu)

    assert caught.value.message == (
        f"'{fmu}' has no 'binaries/linux64/Gain.so'; it has 'binaries/linux64/model.so' and "
        "'binaries/linux64/solver.so', and it is not clear which of them to load."
    )


def test_library_with_right_name_is_taken_among_others_and_is_no_problem(tmp_path: Path) -> None:
    description = read_description(renamed(tmp_path / "right.fmu", "Gain.so", "solver.so"))

    assert description.library == "binaries/linux64/Gain.so"
    assert description.problems == ()


def test_inspect_shows_only_library_as_a_problem_of_an_fmu_that_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fmu = renamed(tmp_path / "odd.fmu", "exported_v2.so", description=without_identifier)

    assert main(["inspect", str(fmu)]) == 0

    page = " ".join(capsys.readouterr().out.split())
    assert "Runs here yes" in page
    assert "Identifier exported_v2" in page
    assert "the library 'binaries/linux64/exported_v2.so' is all that tells the model identifier" in page
    assert "The attribute 'modelIdentifier' is required but missing" in page


def test_fmu_without_model_identifier_and_library_is_shown_and_refused_with_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fmu = renamed(tmp_path / "odd.fmu", description=without_identifier)

    assert main(["inspect", str(fmu)]) == 0
    page = " ".join(capsys.readouterr().out.split())
    assert main(["check", str(config_with(fmu))]) == 2
    said = capsys.readouterr().err

    reason = f"'{fmu}' has no model identifier to find its library by, nor a library for this platform"
    assert "Runs here no, see Problems" in page
    assert "Inputs (1)" in page
    assert reason in page
    assert reason in said
    assert "Report it to the maker of its tool" in said


KINDS = [
    pytest.param("Gain", "", "declares no kind of FMU: it has neither a <CoSimulation> nor a <ModelExchange>.", id="2"),
    pytest.param("AllTypes3", "", "it has neither a <CoSimulation> nor a <ModelExchange>.", id="3"),
    pytest.param(
        "AllTypes3",
        '<ScheduledExecution modelIdentifier="AllTypes3"/>',
        "is for scheduled execution only, not for co-simulation or model exchange.",
        id="scheduled execution",
    ),
]


@pytest.mark.parametrize("command", ["inspect", "check", "launch"])
@pytest.mark.parametrize(("name", "instead", "says"), KINDS)
def test_fmu_of_no_kind_that_runs_is_told_what_it_is(
    name: str, instead: str, says: str, command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def changed(text: str) -> str:
        return re.sub(r"<CoSimulation[^>]*/>|<CoSimulation.*?</CoSimulation>", instead, text, flags=re.DOTALL)

    fmu = repacked(tmp_path / "odd.fmu", source=find_fmu(name, tmp_path / "built"), description=changed)
    file = fmu if command == "inspect" else config_with(fmu)

    assert main([command, str(file)]) == 2

    assert says.rstrip(".") in capsys.readouterr().err


def elf(machine: int) -> bytes:
    """The first bytes of a library for a processor, as ELF calls it."""
    return b"\x7fELF\x02\x01".ljust(18, b"\0") + machine.to_bytes(2, "little")


def with_libraries(target: Path, **libraries: int) -> Path:
    """An FMU with these folders of libraries, each for a processor, and no sources."""
    add: dict[str | zipfile.ZipInfo, bytes] = {
        f"binaries/{name.replace('_', '-')}/Gain.so": elf(machine) for name, machine in libraries.items()
    }
    return repacked(target, source=GAIN, keep=lambda name: not name.startswith(("binaries/", "sources/")), add=add)


@pytest.fixture
def on_arm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fmpy.platform_tuple", "aarch64-linux")
    monkeypatch.setattr("platform.machine", lambda: "aarch64")


@pytest.mark.usefixtures("on_arm")
@pytest.mark.parametrize(
    ("libraries", "folder"),
    [
        ({"aarch64_linux": 183, "linux64": 62}, "aarch64-linux"),
        ({"aarch64_linux_gnu": 183, "linux64": 62}, "aarch64-linux-gnu"),  # OpenModelica, for another processor
        ({"linux64": 183}, "linux64"),  # OpenModelica on ARM itself
    ],
)
def test_on_arm_a_library_is_found_by_each_name_of_its_folder(
    libraries: dict[str, int], folder: str, tmp_path: Path
) -> None:
    description = read_description(with_libraries(tmp_path / "gain.fmu", **libraries))

    assert description.library == f"binaries/{folder}/Gain.so"
    assert description.problems == ()


def test_a_library_for_another_processor_does_not_run_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for_arm = with_libraries(tmp_path / "arm.fmu", linux64=183, aarch64_linux=183)
    for_x86 = with_libraries(tmp_path / "x86.fmu", linux64=62)

    with pytest.raises(LoadFailed, match=r"platform \(linux64\); it has: aarch64-linux, linux64 \(for aarch64\)\."):
        read_description(for_arm)
    monkeypatch.setattr("fmpy.platform_tuple", "aarch64-linux")
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    with pytest.raises(LoadFailed, match=r"platform \(aarch64-linux\); it has: linux64 \(for x86_64\)\."):
        read_description(for_x86)


def test_inspect_shows_that_an_fmu_has_a_library_for_arm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(with_libraries(tmp_path / "gain.fmu", aarch64_linux=183, linux64=62))]) == 0

    assert "Platforms linux64, aarch64-linux Runs here yes" in " ".join(capsys.readouterr().out.split())
