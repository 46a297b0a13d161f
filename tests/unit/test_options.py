"""Options of a run: flags, help and configuration keys follow from one list."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import pytest

from fmu_mesh.cli.main import command_parser
from fmu_mesh.cli.run_options import add_options, read_options
from fmu_mesh.config.findings import Findings
from fmu_mesh.config.loading import read_text
from fmu_mesh.config.mesh import SimulationConfig
from fmu_mesh.config.structure import json_schema
from fmu_mesh.errors import ConfigurationError
from fmu_mesh.instances.configuration import installed_config, parse
from fmu_mesh.run.options import Options, option_fields, with_config_values, with_options
from fmu_mesh.run.preparing import prepare
from fmu_mesh.text import listed
from tests.helpers import FMUS

TEXT = """\
mesh: one
simulation: {stop_time: 1, step_size: 0.1}
instances: {gain: {fmu: Gain.fmu}}
"""
GIVEN: dict[str, tuple[str | None, Any]] = {
    "algorithm": ("jacobi", "jacobi"),
    "step_size": ("0.5", 0.5),
    "stop_time": ("7", 7.0),
    "window": ("3", 3),
    "real_time_factor": ("2", 2.0),
    "update_period": ("0.25", 0.25),
    "catch_up": ("4", 4.0),
    "start_values": ("gain.k=1", ("gain.k=1",)),
    "config_values": ("zenoh.mode=client", ("zenoh.mode=client",)),
    "output": ("r.csv", Path("r.csv")),
    "listen": ("tcp/127.0.0.1:1", ("tcp/127.0.0.1:1",)),
    "connect": ("tcp/127.0.0.1:2", ("tcp/127.0.0.1:2",)),
    "paused": (None, True),
    "allow_code": (None, True),
    "view": (None, True),
    "scenario": ("drive.yaml", Path("drive.yaml")),
    "video": ("film.gif", Path("film.gif")),
    "profile": ("p.json", Path("p.json")),
}


@pytest.mark.parametrize("name", option_fields())
def test_what_a_flag_is_given_is_the_value_of_its_option(name: str) -> None:
    parser = argparse.ArgumentParser()
    add_options(parser, *option_fields())
    text, value = GIVEN[name]
    flag = option_fields()[name].flag.name
    assert read_options(parser.parse_args([])) == Options()
    assert read_options(parser.parse_args([flag] if text is None else [flag, text])) == Options(**{name: value})


def test_a_command_reads_the_options_that_it_has() -> None:
    arguments = command_parser()[0].parse_args(["check", "mesh.yaml", "--window", "auto", "--set", "gain.k=1"])
    assert read_options(arguments) == Options(window="auto", start_values=("gain.k=1",))


def test_the_help_of_a_flag_is_the_description_of_its_key() -> None:
    definitions = json_schema(installed_config())["$defs"]
    assert isinstance(definitions, dict)
    sections = {"simulation": "SimulationConfig", "zenoh": "ZenohConfig", "record": "RecordConfig"}
    for setting in option_fields().values():
        if setting.flag.key is None or setting.flag.text is not None:
            continue
        section, _, key = setting.flag.key.partition(".")
        description = definitions[sections[section]]["properties"][key]["description"]
        text = setting.help.removesuffix("; repeatable")
        assert description[1:].startswith(text[1:])
        assert description[len(text) :].strip(".").partition(":")[0] in ("", "; null")


def test_every_option_with_a_key_replaces_it() -> None:
    loaded = parse(TEXT, Path("one.yaml"))
    options = Options(**{name: value for name, (_, value) in GIVEN.items()})
    findings = Findings("one.yaml")
    changed = with_options(loaded, options, findings)
    assert not len(findings)
    simulation, zenoh = changed.config.simulation, changed.config.zenoh
    assert (simulation.step_size, simulation.stop_time, simulation.window) == (0.5, 7.0, 3)
    assert (simulation.real_time_factor, simulation.update_period, simulation.catch_up) == (2.0, 0.25, 4.0)
    assert (zenoh.listen, zenoh.connect) == (["tcp/127.0.0.1:1"], ["tcp/127.0.0.1:2"])
    assert changed.config.records["record"].file == str(Path("r.csv").absolute())
    assert changed.overrides["simulation.catch_up"] == "--catch-up 4"
    assert changed.overrides["zenoh.listen"] == "--listen tcp/127.0.0.1:1"
    assert changed.config.scenario == str(Path("drive.yaml").absolute())
    assert changed.overrides.keys() == {setting.flag.key for setting in option_fields().values()} - {None} | {
        "scenario"
    }


def test_options_that_are_not_given_leave_the_configuration_as_it_is() -> None:
    loaded = parse(TEXT, Path("one.yaml"))
    assert with_options(loaded, Options()) == loaded


def test_a_value_that_its_key_does_not_allow_is_a_finding_that_names_the_flag() -> None:
    findings = Findings("one.yaml")
    with_options(parse(TEXT, Path("one.yaml")), Options(update_period=-1.0, catch_up=-2.0), findings)
    assert [str(finding) for finding in findings] == [
        "one.yaml: --update-period -1: -1.0; expected a finite number >= 0",
        "one.yaml: --catch-up -2: -2.0; expected a finite number >= 0 or null",
    ]


def values_of(*config_values: str, text: str = TEXT) -> tuple[Any, list[str]]:
    """The data of a configuration with these keys replaced, and the findings."""
    changed = with_config_values(read_text(text, Path("one.yaml")), config_values)
    return changed.data, [str(finding) for finding in changed.findings]


def test_any_key_is_replaced_by_its_path_with_a_value_in_yaml() -> None:
    data, findings = values_of(
        "simulation.window=16",
        "zenoh={mode: client}",
        "zenoh.connect=[tcp/a:1]",
        "instances.gain.group=fast",
        "ros=null",
    )

    assert findings == []
    assert data["simulation"] == {"stop_time": 1, "step_size": 0.1, "window": 16}
    assert data["zenoh"] == {"mode": "client", "connect": ["tcp/a:1"]}
    assert data["instances"] == {"gain": {"fmu": "Gain.fmu", "group": "fast"}}
    assert data["ros"] is None


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("simulation.window", "no value of a key; expected KEY=VALUE, such as simulation.window=16"),
        (".window=3", "no value of a key; expected KEY=VALUE, such as simulation.window=16"),
        ("connections[0].factor=2", "a key inside a list; expected the whole list, as in connections=[...]"),
        ("connections.factor=2", "a key inside 'connections', which is a list; expected connections=VALUE"),
        ("simulation.step_size.s=2", "a key inside 'simulation.step_size', which is a single value; expected "),
        ("instances.gian.group=a", "the unknown instance 'gian'; expected one of gain. Did you mean 'gain'?"),
        ("instances.gain.start_values.k=2", "a start value; expected --set gain.k=2"),
        ("zenoh={mode", "expected a value in YAML"),
    ],
)
def test_a_key_that_cannot_be_replaced_is_a_finding_that_names_the_option(given: str, words: str) -> None:
    _, findings = values_of(given, text=f"{TEXT}connections: [a.y -> b.u]\n")

    assert len(findings) == 1
    assert findings[0].startswith(f"one.yaml: --set-config {given}: ")
    assert words in findings[0]


def test_a_replaced_value_is_checked_like_the_file(tmp_path: Path) -> None:
    file = tmp_path / "one.yaml"
    file.write_text(TEXT.replace("Gain.fmu", str(FMUS / "Gain.fmu")))

    def findings(**options: Any) -> list[str]:  # noqa: ANN401 the values of options
        with pytest.raises(ConfigurationError) as raised:
            prepare(file, Options(**options))
        return [str(finding).removeprefix(f"{file}: ") for finding in raised.value.findings]

    keys = listed(SimulationConfig.__struct_fields__)
    assert findings(config_values=("simulation.windw=3", "zenoh={mode: pear}", "timeouts.step=0")) == [
        f"--set-config simulation.windw=3: an unknown key; expected one of {keys}. Did you mean 'window'?",
        "--set-config zenoh={mode: pear}: 'pear'; expected client or peer. Did you mean 'peer'?",
        "--set-config timeouts.step=0: 0; expected a finite number > 0",
    ]
    assert findings(algorithm="jacoby") == [
        "--algorithm jacoby: 'jacoby'; expected gauss_seidel or jacobi. Did you mean 'jacobi'?"
    ]
    assert findings(window=3, config_values=("simulation.window=4",)) == [
        "--set-config simulation.window=4: replaced by --window as well; expected one of the two options"
    ]
    plan = prepare(file, Options(algorithm="jacobi", step_size=0.25, config_values=("simulation.stop_time=null",)))
    assert (plan.system.config.simulation.algorithm, plan.grid.step_size, plan.grid.stop_time) == ("jacobi", 0.25, None)
