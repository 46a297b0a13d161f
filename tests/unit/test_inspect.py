"""`inspect`: what a page about an FMU says, and that it stays readable."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import pytest

import fmu_mesh
from fmu_mesh.cli.main import main
from tests.fmus.helpers import FMUS, find_fmu
from tests.fmus.packing import repacked, unpacked

PENDULUM = FMUS / "DampedPendulum.fmu"


def inspected(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    assert main(["inspect", *map(str, arguments)]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    return said.out


def many_variables(path: Path, count: int) -> Path:
    """An FMU with many local variables, some with names and descriptions of a length that tools really make."""

    def change(text: str) -> str:
        more = "".join(
            f'<ScalarVariable name="plant.body[{n}].{"joint." * (n % 12)}x" valueReference="{100 + n}" '
            f'causality="local" description="{"Position in the world frame, " * (n % 5)}x"><Real unit="m"/>'
            "</ScalarVariable>"
            for n in range(count)
        )
        return text.replace("</ModelVariables>", f"{more}</ModelVariables>")

    return repacked(path, source=PENDULUM, description=change)


def test_the_page_says_what_an_fmu_is(capsys: pytest.CaptureFixture[str]) -> None:
    page = inspected(capsys, PENDULUM)

    assert f"SHA-256      {hashlib.sha256(PENDULUM.read_bytes()).hexdigest()}\n" in page
    for line in (
        "Kind         FMI 2.0 co-simulation",
        "Platforms    C sources, linux64",
        "Runs here    yes",
        "Can          variable step size, get and set its state, serialize its state",
        "Experiment   start 0 s, stop 40 s, step 0.002 s",
        "Variables    3 outputs, 3 parameters",
        "  der(a,2)  Real  continuous  [rad/s2]     Angular acceleration",
        "  l  Real  fixed  = 1.0 m      Length, greater than 0",
    ):
        assert f"{line}\n" in page


def test_the_page_says_what_all_kinds_support_and_counts_the_states(
    event_fmu: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    page = " ".join(inspected(capsys, event_fmu("Ball", 3)).split())

    assert "Kind FMI 3.0 co-simulation or model exchange " in page
    assert "Can variable step size, get and set its state, serialize its state, event mode " in page
    assert "Variables 1 input, 4 outputs, 2 parameters, 1 independent variable, 6 local variables " in page
    assert "States 2 continuous, 1 event indicator " in page


def test_start_values_are_shown_as_a_configuration_has_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = inspected(capsys, find_fmu("AllTypes3", tmp_path), "*_in")

    for name, start in {
        "float64_array_in": "[[0.0,0.0,0.0],[0.0,0.0,0.0]]",
        "enumeration_in": "low (1)",
        "string_in": "''",
        "binary_in": "''",
        "boolean_in": "false",
    }.items():
        (line,) = [one for one in page.splitlines() if one.split()[0] == name]
        assert line.rpartition(" = ")[2] == start


def test_the_json_has_everything(capsys: pytest.CaptureFixture[str]) -> None:
    told = json.loads(inspected(capsys, PENDULUM, "--json"))

    assert list(told) == ["file", "sha256", "bytes", "runs_here", "problems", "description"]
    assert (told["bytes"], told["runs_here"], told["problems"]) == (PENDULUM.stat().st_size, True, [])
    assert [variable["name"] for variable in told["description"]["variables"]] == ["a", "der(a)", "der(a,2)", *"ldg"]


@pytest.mark.parametrize("width", [80, 120])
def test_a_page_about_a_thousand_variables_is_short_and_keeps_to_width(
    width: int, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    path = many_variables(tmp_path / "many.fmu", 1000)

    page = inspected(capsys, path)

    lines = page.splitlines()
    assert len(lines) < 60
    assert "Local variables (1000)" in lines
    assert "  ... and 980 more: --all lists them, a name such as 'x*' some" in lines
    for line in lines:
        assert len(line) <= width or line.split()[0].startswith(("plant.", "File")) or str(tmp_path) in line
    assert len(inspected(capsys, path, "--all").splitlines()) > 1000


def test_variables_are_found_by_name_and_unknown_one_is_told_with_nearest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = many_variables(tmp_path / "many.fmu", 30)

    page = inspected(capsys, path, "plant.body[2].*", "der(a)")

    assert [line.split()[0] for line in page.splitlines() if line.startswith("  ")] == [
        "der(a)",
        "plant.body[2].joint.joint.x",
    ]
    assert main(["inspect", str(path), "der(aa)"]) == 2
    assert "has no variable 'der(aa)'. Did you mean 'der(a)'?" in capsys.readouterr().err


def test_an_fmu_that_cannot_run_here_is_shown_with_the_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "/nonexistent")  # without Wine
    path = repacked(
        tmp_path / "elsewhere.fmu",
        keep=lambda name: name == "modelDescription.xml",
        description=lambda text: text.replace('author="', 'colour="red" author="'),
        add={"binaries/win64/Gain.dll": b""},
    )

    page = inspected(capsys, path)

    assert "Runs here    no, see Problems" in page
    assert "Problems (2)" in page
    assert "has no binary for this platform (linux64); it has: win64." in " ".join(page.split())
    assert "or with its sources; `apt install wine` lets it run under Wine." in " ".join(page.split())
    assert "attribute 'colour'" in " ".join(page.split())


def test_an_unpacked_fmu_is_shown_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = inspected(capsys, unpacked(tmp_path / "gain"))

    assert "gain (a folder)" in " ".join(page.split())
    assert "SHA-256" not in page


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("DampedPendulun.fmu", "does not exist. Did you mean"),
        ("build.py", "is no ZIP archive"),
        ("build.py:Controller", "A component is not read without running it"),
    ],
)
def test_what_is_no_fmu_is_refused(name: str, says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(FMUS / name)]) == 2

    assert says in capsys.readouterr().err


def test_clocks_are_shown_with_their_times(event_fmu: Callable[..., Path], capsys: pytest.CaptureFixture[str]) -> None:
    clock = 'intervalVariability="constant" intervalDecimal="0.4" shiftDecimal="0.2"'

    page = inspected(capsys, event_fmu("Stairs", 3, clocks=clock))

    assert "tick (input, constant, every 0.4 s from 0.2 s on), stair (output, triggered)" in " ".join(page.split())


def test_an_fmu_with_both_kinds_says_which_one_is_used(
    tmp_path: Path, event_fmu: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    fmu = repacked(
        tmp_path / "Both.fmu",
        source=event_fmu("Ball", 2),
        description=lambda text: text.replace('modelName="', 'generationTool="Modeller 3" modelName="', 1),
    )
    made, other = (
        "its co-simulation was made by Modeller 3",
        "`kind: model_exchange` is solved by us with tolerance 1e-06",
    )
    said = f"has both kinds; {made}; {other}"
    mesh = fmu_mesh.Mesh.from_fmu(fmu, name="ball", simulation={"step_size": 0.01, "stop_time": 1.0})

    page = inspected(capsys, fmu)

    assert f"Used as co-simulation: it {said}" in " ".join(page.split())
    assert f"\n  ball {said}\n" in mesh.check().page
    for kind in ("co_simulation", "model_exchange"):  # chosen: there is nothing to say
        chosen = fmu_mesh.Mesh.from_fmu(fmu, kind=kind, simulation={"step_size": 0.01, "stop_time": 1.0})
        assert "has both" not in chosen.check().page
    assert "Used as" not in inspected(capsys, PENDULUM)
