"""`new`: what it suggests for FMUs, and that it can run."""

from __future__ import annotations

import shutil
from pathlib import Path

import jsonschema
import pytest
import yaml

from fmu_mesh.cli.main import main
from fmu_mesh.cli.new_mesh import Model, configuration_for
from fmu_mesh.variables.model_description import DefaultExperiment, ModelDescription, Variable
from fmu_mesh.variables.units import BaseUnit
from tests.helpers import FMUS

NO_EXPERIMENT = DefaultExperiment()


def variable(
    name: str, causality: str, type_: str = "Real", unit: str | None = None, base: BaseUnit | None = None
) -> Variable:
    return Variable(name, 1, type_, causality, "continuous", start=0.0, unit=unit, base_unit=base)  # type: ignore[arg-type]  # words


def model(name: str, *variables: Variable, experiment: DefaultExperiment = NO_EXPERIMENT) -> Model:
    description = ModelDescription("2.0", name, name, "co_simulation", "{}", variables, default_experiment=experiment)
    return Model(name, f"{name}.fmu", description)


def text_of(*models: Model) -> str:
    return configuration_for(models, mesh="made", file=Path("mesh.yaml"), schema="mesh.schema.json")


METRE, SECOND = BaseUnit(m=1), BaseUnit(s=1)


def test_an_output_and_an_input_with_one_name_are_connected() -> None:
    text = text_of(model("a", variable("x", "output")), model("b", variable("x", "input")))

    assert yaml.safe_load(text)["connections"] == ["a.x -> b.x"]


@pytest.mark.parametrize(
    "target",
    [
        variable("x", "input", "Boolean"),
        variable("x", "input", unit="s", base=SECOND),
        variable("X", "input"),
    ],
    ids=["another type", "another dimension", "another name"],
)
def test_what_does_not_fit_is_not_connected(target: Variable) -> None:
    text = text_of(model("a", variable("x", "output", unit="m", base=METRE)), model("b", target))

    assert yaml.safe_load(text)["connections"] == []
    assert f"#   b.{target.name} = 0.0" in text


def test_of_several_outputs_that_fit_a_person_chooses() -> None:
    x = variable("x", "output")

    text = text_of(model("a", x), model("b", x), model("c", variable("x", "input")))

    assert yaml.safe_load(text)["connections"] == []
    assert "  # 2 outputs fit c.x; choose one:\n  # - a.x -> c.x\n  # - b.x -> c.x\n" in text


def test_times_are_those_of_the_default_experiments() -> None:
    text = text_of(
        model("a", variable("x", "output"), experiment=DefaultExperiment(stop_time=3.0, step_size=0.1)),
        model("b", experiment=DefaultExperiment(stop_time=7.05, step_size=0.3)),
        model("c", experiment=DefaultExperiment(step_size=0.25)),
    )

    content = yaml.safe_load(text)
    assert content["simulation"] == {"stop_time": 7.0, "step_size": 0.1}
    assert content["instances"]["b"] == {"fmu": "b.fmu", "step_size": 0.3}
    assert content["instances"]["c"] == {"fmu": "c.fmu"}
    assert "# step_size: 0.25  # its default, but no multiple of 0.1" in text


def test_what_is_written_passes_check_and_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in FMUS.glob("*.fmu"):
        shutil.copy(path, tmp_path)
    shutil.copy(FMUS / "Gain.fmu", tmp_path / "mesh.fmu")
    (tmp_path / "broken.fmu").write_bytes(b"no archive")
    monkeypatch.chdir(tmp_path)

    assert main(["new"]) == 0
    assert main(["check", "mesh.yaml"]) == 0
    assert main(["launch", "mesh.yaml", "--local", "--stop-time", "0.02", "-q"]) == 0

    text = (tmp_path / "mesh.yaml").read_text()
    assert text.startswith("# yaml-language-server: $schema=mesh.schema.json\n")
    assert "# broken: {fmu: broken.fmu}  # cannot run here: " in text
    content = yaml.safe_load(text)
    assert content["instances"].keys() == {path.stem for path in FMUS.glob("*.fmu")} | {"mesh_2"}
    jsonschema.validate(content, yaml.safe_load((tmp_path / "mesh.schema.json").read_text()))
    header = (tmp_path / f"results/{content['mesh']}.csv").read_text().partition("\n")[0]
    assert {"time", "Gain.y", "DampedPendulum.a"} <= set(header.split(","))
    assert "left out: broken.fmu" in capsys.readouterr().out


def test_a_file_that_exists_is_overwritten_with_force_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "own.yaml"
    file.write_text("mine")

    assert main(["new", str(FMUS / "Gain.fmu"), "--output", str(file)]) == 2
    assert (file.read_text(), "--force" in capsys.readouterr().err) == ("mine", True)
    assert main(["new", str(FMUS / "Gain.fmu"), "--output", str(file), "--force", "-q"]) == 0
    assert capsys.readouterr() == ("", "")
    assert (tmp_path / yaml.safe_load(file.read_text())["instances"]["Gain"]["fmu"]).resolve() == FMUS / "Gain.fmu"


def test_a_schema_of_somebody_else_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "own.schema.json").write_text("{}")

    assert main(["new", str(FMUS / "Gain.fmu"), "--output", str(tmp_path / "own.yaml")]) == 2
    assert not (tmp_path / "own.yaml").exists()


@pytest.mark.parametrize("given", ["gone", "."])
def test_without_an_fmu_there_is_nothing_to_write(given: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)

    assert main(["new", given]) == 2
    assert list(tmp_path.iterdir()) == []
