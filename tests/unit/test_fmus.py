"""The example FMUs as files: what they hold, how they are built, and what their descriptions promise.

How they take calls is tested in ``tests/fmus/test_calls.py``, what they compute in
``tests/fmus/test_models.py``.
"""

from __future__ import annotations

import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path

import fmpy
import pytest
from fmpy.validation import validate_fmu

from fmus.build import BuildError, build, find_compiler, main
from tests.fmus.harness import VARYING_STEPS, Unit, Value, refusal
from tests.fmus.helpers import FMUS, KEPT_FMUS, NO_COMPILER, TEST_FMUS, extracted_fmu, find_fmu

ALL_FMUS = (*KEPT_FMUS, *TEST_FMUS)

needs_compiler = pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))
every_fmu = pytest.mark.parametrize("name", ALL_FMUS)
every_kept_fmu = pytest.mark.parametrize("name", KEPT_FMUS)

Find = Callable[[str], Path]


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fmus")


@pytest.fixture(scope="module")
def folder(base: Path) -> Find:
    """Return the extracted folder of an FMU by its name."""
    return lambda name: extracted_fmu(name, base)


@pytest.fixture(scope="module")
def fresh(base: Path) -> Find:
    """Return a freshly built archive of a kept FMU by its name."""

    def find(name: str) -> Path:
        built = base / "fresh" / f"{name}.fmu"
        return built if built.is_file() else build(FMUS / "src" / name, built.parent)

    return find


def members(path: Path, *, without: str = "\0") -> dict[str, bytes]:
    """Return the content of an archive by name, leaving out names that start with ``without``."""
    with zipfile.ZipFile(path) as file:
        return {name: file.read(name) for name in file.namelist() if not name.startswith(without)}


# ---- the files ----


def test_every_model_folder_has_a_kept_fmu() -> None:
    models = sorted(path.parent.name for path in (FMUS / "src").glob("*/modelDescription.xml"))

    assert models == list(KEPT_FMUS)
    assert "DampedPendulum" in models


@every_fmu
def test_fmpy_finds_no_problem_in_an_fmu(name: str, base: Path) -> None:
    assert validate_fmu(str(find_fmu(name, base))) == []


@needs_compiler
@every_kept_fmu
def test_a_kept_fmu_is_what_its_sources_build(name: str, fresh: Find) -> None:
    kept = FMUS / f"{name}.fmu"

    same = members(fresh(name), without="binaries/") == members(kept, without="binaries/")

    assert same, f"{kept.name} is older than its sources: run `python fmus/build.py {name}`"


@needs_compiler
@every_kept_fmu
def test_a_kept_fmu_computes_exactly_what_a_fresh_build_computes(
    name: str, folder: Find, fresh: Find, tmp_path: Path
) -> None:
    fresh_folder = Path(fmpy.extract(str(fresh(name)), unzipdir=str(tmp_path)))

    with Unit(folder(name)) as kept_unit, Unit(fresh_folder) as fresh_unit:
        kept_rows = kept_unit.start().run(VARYING_STEPS)
        fresh_rows = fresh_unit.start().run(VARYING_STEPS)

    assert kept_rows == fresh_rows


@needs_compiler
def test_two_builds_give_the_same_bytes(fresh: Find, tmp_path: Path) -> None:
    second = build(FMUS / "src" / "Gain", tmp_path)

    assert fresh("Gain").read_bytes() == second.read_bytes()


@needs_compiler
@every_kept_fmu
def test_the_sources_in_an_archive_compile_by_themselves_without_a_warning(name: str, tmp_path: Path) -> None:
    for member, content in members(FMUS / f"{name}.fmu").items():
        if member.startswith("sources/"):
            (tmp_path / Path(member).name).write_bytes(content)
    c_files = sorted(path.name for path in tmp_path.glob("*.c"))
    flags = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wshadow", "-Werror", "-fsyntax-only"]

    result = subprocess.run(
        [*find_compiler(), *flags, *c_files], cwd=tmp_path, capture_output=True, text=True, check=False
    )

    assert (result.returncode, result.stderr) == (0, "")


@needs_compiler
def test_the_guid_changes_with_one_byte_of_a_source(tmp_path: Path) -> None:
    model = tmp_path / "Gain"
    model.mkdir()
    for path in (FMUS / "src" / "Gain").iterdir():
        (model / path.name).write_bytes(path.read_bytes() + b"\n")

    changed = fmpy.read_model_description(str(build(model, tmp_path)))

    assert changed.guid != fmpy.read_model_description(str(FMUS / "Gain.fmu")).guid


def test_a_build_without_a_compiler_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")

    code = main(["Gain", "--output", str(tmp_path)])

    assert code == 1
    assert "no C compiler found (looked for no-such-compiler): install gcc" in capsys.readouterr().err


def test_a_build_of_an_unknown_model_names_the_models_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["Gian"])

    message = capsys.readouterr().err
    assert code == 1
    assert "no model Gian" in message
    assert ", ".join(KEPT_FMUS) in message


@needs_compiler
def test_a_compiler_message_reaches_the_user(tmp_path: Path) -> None:
    (tmp_path / "modelDescription.xml").write_bytes((FMUS / "src/Gain/modelDescription.xml").read_bytes())
    (tmp_path / "Gain.c").write_text("#error this model is not finished\n")

    with pytest.raises(BuildError, match="this model is not finished"):
        build(tmp_path, tmp_path)


# ---- what the model description promises ----


@every_fmu
def test_every_start_value_of_the_description_is_the_one_in_the_code(name: str, folder: Find) -> None:
    with Unit(folder(name)) as unit:
        unit.setup()
        variables = [v for v in unit.description.modelVariables if v.start is not None]

        values = {variable.name: unit.get(variable.name) for variable in variables}

    assert values == {variable.name: typed(variable.type, variable.start) for variable in variables}


def typed(kind: str, text: str) -> Value:
    """Return the value that the text of an XML attribute stands for."""
    match kind:
        case "Real":
            return float(text)
        case "Integer" | "Enumeration":
            return int(text)
        case "Boolean":
            return text == "true"
        case _:
            return text


@pytest.mark.parametrize("mode", ["instantiated", "initialization mode", "step complete"])
@every_fmu
def test_a_variable_can_be_set_exactly_where_the_fmi_allows_it(name: str, mode: str, folder: Find) -> None:
    examples: dict[str, Value] = {
        "Real": 1.0,
        "Integer": 1,
        "Enumeration": 1,
        "Boolean": False,
        "String": "x",
    }

    for variable in fmpy.read_model_description(str(folder(name))).modelVariables:
        with Unit(folder(name)) as unit:
            if mode != "instantiated":
                unit.setup()
            if mode == "step complete":
                unit.fmi.exitInitializationMode()

            if settable(variable.causality, variable.variability, variable.initial, mode):
                unit.set(variable.name, examples[variable.type])
            else:
                value = examples[variable.type]
                message = refusal(unit, lambda: unit.set(variable.name, value))  # noqa: B023 - called at once
                assert f'"{variable.name}" (value reference {variable.valueReference}) is a' in message.text
                assert f'cannot be set in the state "{mode}"' in message.text


def settable(causality: str, variability: str, initial: str | None, mode: str) -> bool:
    """FMI 2.0.4, the table in 4.2.4, notes 1, 3 and 6 of the fmi2SetXXX row."""
    if mode == "step complete":
        return causality == "input" or (causality == "parameter" and variability == "tunable")
    return causality == "input" or initial == "exact"
