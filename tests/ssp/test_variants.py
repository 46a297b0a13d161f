"""The values of an SSV file that is chosen replace those of a package."""

from __future__ import annotations

from pathlib import Path

import pytest

import fmu_mesh
from fmu_mesh.errors import ConfigurationError
from tests.helpers import Place
from tests.ssp.bad_packages import GOOD
from tests.ssp.packages import parameter, parameter_file, write_package

COLD = "resources/cold.ssv"
FILES = {**GOOD, COLD: parameter_file(parameter("inner.gain.k", 4.0), parameter("pendulum.l", 3.0))}


def values_of(mesh: fmu_mesh.Mesh) -> dict[str, tuple[object, str]]:
    """The start values with the lines that they come from."""
    plan = mesh.check().plan
    assert plan is not None
    return {
        f"{one.name}.{name}": (value, f"{Path(one.origins[name].file or '').name}:{one.origins[name].line}")
        for one in plan.instances
        for name, value in one.start_values.items()
    }


def test_a_set_of_the_package_replaces_its_values_and_leaves_the_others(tmp_path: Path) -> None:
    package = write_package(tmp_path / "good.ssp", FILES)

    mesh = fmu_mesh.load(package, ssv=[COLD])

    assert {name: value for name, (value, _) in values_of(mesh).items()} == {
        "pendulum.l": 3.0,
        "inner-gain.k": 4.0,
        "delay.d": 0.25,
    }
    assert {name: line.partition(":")[0] for name, (_, line) in values_of(mesh).items()} == {
        "pendulum.l": "cold.ssv",
        "inner-gain.k": "cold.ssv",
        "delay.d": "SystemStructure.ssd",
    }


def test_of_several_sets_last_one_counts_and_one_may_be_on_disk(tmp_path: Path) -> None:
    package, own = write_package(tmp_path / "good.ssp", FILES), tmp_path / "own.ssv"
    own.write_text(parameter_file(parameter("inner.gain.k", 5.0)))

    last = values_of(fmu_mesh.load(package, ssv=[COLD, own]))
    first = values_of(fmu_mesh.load(package, ssv=[own, COLD]))

    assert (last["inner-gain.k"][0], last["pendulum.l"][0]) == (5.0, 3.0)
    assert first["inner-gain.k"][0] == 4.0


def test_a_mistake_in_a_chosen_set_is_told_with_its_line(tmp_path: Path) -> None:
    package, own = write_package(tmp_path / "good.ssp", FILES), tmp_path / "own.ssv"
    own.write_text(parameter_file(parameter("inner.gain.k", "5,0")))

    (finding,) = fmu_mesh.load(package, ssv=[own]).check().findings

    assert (finding.file, finding.found) == (str(own), "the value '5,0'")
    assert own.read_text().splitlines()[(finding.line or 0) - 1].strip().startswith("<ssv:Real")


@pytest.mark.parametrize(
    ("source", "ssv", "words"),
    [
        ("good.ssp", "resources/cool.ssv", ("there is no such file", "good.ssp", "Did you mean 'resources/cold.ssv'?")),
        ("good.ssp", ".", ("there is no such file",)),
        ("mesh.yaml", COLD, ("`ssv=...` chooses a variant of a package", "mesh.yaml")),
    ],
)
def test_a_set_that_is_nowhere_is_refused(source: str, ssv: str, words: tuple[str, ...], tmp_path: Path) -> None:
    write_package(tmp_path / "good.ssp", FILES)
    (tmp_path / "mesh.yaml").write_text("mesh: m\n")

    with pytest.raises(ConfigurationError) as caught:
        fmu_mesh.load(tmp_path / source, ssv=[ssv])

    assert all(word in str(caught.value) for word in words), caught.value


def test_every_command_runs_the_chosen_set_and_a_result_runs_again(place: Place) -> None:
    write_package(place.folder / "good.ssp", FILES)
    assert place.run("convert", "good.ssp", "cold.yaml", "--ssv", COLD).wait() == 0, place.story()

    for source, options in (("good.ssp", ("--ssv", COLD)), ("cold.yaml", ())):
        for more in ((), ("--local",)):
            name = f"{source}{len(more)}.csv"
            launched = place.run("launch", source, *options, *more, "--no-progress", "--output", name)
            assert launched.wait() == 0, place.story()
    assert place.run("rerun", "good.ssp0.csv", "--output", "again.csv").wait() == 0, place.story()
    assert place.run("graph", "good.ssp", "--ssv", COLD).wait() == 0, place.story()

    results = [*place.folder.glob("*.csv")]
    assert len(results) == 5
    assert len({result.read_bytes() for result in results}) == 1
