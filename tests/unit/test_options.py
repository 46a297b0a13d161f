"""Options of a run: flags, help, signatures, docstrings and configuration keys follow from one Struct."""

from __future__ import annotations

import argparse
import ast
import inspect
import re
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import pytest

import fmu_mesh
from fmu_mesh.api.run_handle import Run
from fmu_mesh.cli.main import command_parser
from fmu_mesh.cli.output.flag_words import in_flags
from fmu_mesh.cli.run_options import add_options, given_options
from fmu_mesh.config.call_options import Option, option_fields, takes
from fmu_mesh.config.loading import read_text
from fmu_mesh.config.mesh import SimulationConfig
from fmu_mesh.config.structure import json_schema
from fmu_mesh.errors import CallRefused, ConfigurationError
from fmu_mesh.instances.configuration import examine_data, installed_config
from fmu_mesh.run.options import PlanOptions, RunOptions
from fmu_mesh.run.overriding import with_options
from fmu_mesh.text import listed
from tests.helpers import FMUS
from tests.planning import prepare

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
    "start_values": ("gain.k=1", {"gain.k": 1}),
    "config_values": ("zenoh.mode=client", {"zenoh.mode": "client"}),
    "keys_from": ("first.csv", Path("first.csv")),
    "state": ("at20s.state", Path("at20s.state")),
    "replaced": ("pump", ("pump",)),
    "output": ("r.csv", Path("r.csv")),
    "listen": ("tcp/127.0.0.1:1", ("tcp/127.0.0.1:1",)),
    "connect": ("tcp/127.0.0.1:2", ("tcp/127.0.0.1:2",)),
    "security": ("lab/host", Path("lab/host")),
    "insecure": (None, True),
    "defects": (None, True),
    "paused": (None, True),
    "allow_code": (None, True),
    "view": (None, True),
    "scenario": ("drive.yaml", Path("drive.yaml")),
    "video": ("film.gif", Path("film.gif")),
    "profile": ("p.json", Path("p.json")),
}
"""Of each option with a flag: a text after the flag, and the value that this is."""


def read(*arguments: str) -> PlanOptions:
    parser = argparse.ArgumentParser()
    add_options(parser, *GIVEN)
    given = given_options(parser.parse_args(arguments))
    return PlanOptions(**{name: value for name, value in given.items() if name != "on_notice"})


@pytest.mark.parametrize("name", [name for name, field in option_fields(PlanOptions).items() if field.flag])
def test_what_a_flag_is_given_is_the_value_of_its_option(name: str) -> None:
    text, value = GIVEN[name]
    flag = option_fields(PlanOptions)[name].flag or ""

    assert read(*([flag] if text is None else [flag, text])).given() == {name: value}


def test_no_flag_is_no_option() -> None:
    assert read() == PlanOptions()


def test_a_command_reads_the_options_that_it_has() -> None:
    arguments = command_parser()[0].parse_args(["check", "mesh.yaml", "--window", "auto", "--set", "gain.k=1"])
    assert PlanOptions(**given_options(arguments)).given().keys() == {"window", "start_values", "on_notice"}


def test_the_help_of_a_flag_is_the_description_of_its_key() -> None:
    definitions = json_schema(installed_config())["$defs"]
    assert isinstance(definitions, dict)
    sections = {"simulation": "SimulationConfig", "zenoh": "ZenohConfig", "record": "RecordConfig"}
    for field in option_fields(PlanOptions).values():
        if field.key is None or field.text is not None:
            continue
        section, _, key = field.key.partition(".")
        description = definitions[sections[section]]["properties"][key]["description"]
        assert description[1:].startswith(field.line[1:])
        assert description[len(field.line) :].strip(".").partition(":")[0] in ("", "; null")


class MoreOptions(RunOptions, frozen=True, kw_only=True):
    """One option more than any run has."""

    wind: Annotated[float | None, Option("speed of the wind in m/s", "--wind", "V")] = None


def test_an_option_is_one_field(capsys: pytest.CaptureFixture[str]) -> None:
    @takes(MoreOptions)
    def fly(_mesh: str, options: MoreOptions) -> float | None:
        """Fly.

        Args:
            _mesh: what flies.
            options: see `MoreOptions`.
        """
        return options.wind

    parser = argparse.ArgumentParser()
    add_options(parser, "wind", options=MoreOptions)
    parser.print_help()

    assert "--wind V    speed of the wind in m/s" in capsys.readouterr().out
    assert parser.parse_args(["--wind", "3"]).wind == 3.0
    assert "wind: 'float | None' = None" in str(inspect.signature(fly))
    assert "\n    _mesh: what flies.\n    algorithm: " in (inspect.getdoc(fly) or "")
    assert "\n    wind: speed of the wind in m/s" in (inspect.getdoc(fly) or "")
    assert fly("kite", wind=np.float32(0.5)) == 0.5  # type: ignore[arg-type]  # numpy's own scalars are taken too
    with pytest.raises(CallRefused, match="Did you mean `wind`"):
        fly("kite", wnd=1)  # type: ignore[call-arg]  # what is to be refused


def test_the_help_of_a_method_has_all_options() -> None:
    for method in (fmu_mesh.Mesh.run, fmu_mesh.Mesh.start):
        lines = (inspect.getdoc(method) or "").splitlines()

        assert set(option_fields(RunOptions)) < set(inspect.signature(method).parameters)
        assert all(any(line.startswith(f"    {name}: ") for line in lines) for name in option_fields(RunOptions))


def replaced(options: PlanOptions, text: str = TEXT) -> tuple[Any, list[str]]:
    """The data of a configuration with these options, and the findings about its structure."""
    plain = with_options(read_text(text, Path("one.yaml")), options)
    return plain.data, [str(finding) for finding in examine_data(plain)[1]]


def test_every_option_with_a_key_replaces_it() -> None:
    options = PlanOptions(
        **{name: value for name, (_, value) in GIVEN.items() if name not in ("view", "config_values")}
    )

    changed = with_options(read_text(TEXT, Path("one.yaml")), options)

    assert changed.findings == ()
    assert changed.data == {
        "mesh": "one",
        "simulation": {
            "step_size": 0.5,
            "stop_time": 7.0,
            "algorithm": "jacobi",
            "window": 3,
            "real_time_factor": 2.0,
            "update_period": 0.25,
            "catch_up": 4.0,
            "defects": True,
        },
        "instances": {"gain": {"fmu": "Gain.fmu"}},
        "zenoh": {"listen": ["tcp/127.0.0.1:1"], "connect": ["tcp/127.0.0.1:2"], "insecure": True},
        "security": {"folder": str(Path("lab/host").absolute())},
        "record": {"file": str(Path("r.csv").absolute())},
        "scenario": str(Path("drive.yaml").absolute()),
    }
    assert changed.overrides["simulation.catch_up"] == "`catch_up=4.0`"
    assert changed.overrides["zenoh.listen"] == "`listen=['tcp/127.0.0.1:1']`"
    keys = {field.key for field in option_fields(PlanOptions).values()} - {None}
    assert changed.overrides.keys() == keys | {"scenario"}


def test_options_that_are_not_given_leave_the_configuration_as_it_is() -> None:
    plain = read_text(TEXT, Path("one.yaml"))
    assert with_options(plain, PlanOptions()) == plain


def test_value_that_its_key_does_not_allow_is_finding_that_names_option() -> None:
    assert replaced(PlanOptions(update_period=-1.0, catch_up=np.float64(-2.0)))[1] == [
        "one.yaml: `update_period=-1.0`: -1.0; expected a finite number >= 0",
        "one.yaml: `catch_up=-2.0`: -2.0; expected a finite number >= 0 or null",
    ]


@pytest.mark.parametrize("section", ["simulation: 3", "simulation: [1]"])
def test_an_option_does_not_hide_a_wrong_section(section: str) -> None:
    text = TEXT.replace("simulation: {stop_time: 1, step_size: 0.1}", section)

    assert any(": simulation: " in finding for finding in replaced(PlanOptions(step_size=0.1), text)[1])


def test_any_key_is_replaced_by_its_path() -> None:
    values = {
        "simulation.window": np.int64(16),
        "zenoh": {"mode": "client"},
        "zenoh.connect": ("tcp/a:1",),
        "instances.gain.group": "fast",
        "ros": None,
    }

    data, findings = replaced(PlanOptions(config_values=values))

    assert findings == []
    assert data["simulation"] == {"stop_time": 1, "step_size": 0.1, "window": 16}
    assert data["zenoh"] == {"mode": "client", "connect": ["tcp/a:1"]}
    assert data["instances"] == {"gain": {"fmu": "Gain.fmu", "group": "fast"}}
    assert data["ros"] is None


@pytest.mark.parametrize(
    ("path", "words"),
    [
        (".window", "no path of a key; expected one such as simulation.window"),
        ("connections[0].factor", "a key inside a list; expected a value for the whole list connections"),
        ("connections.factor", "a key inside 'connections', which is a list; expected connections=VALUE"),
        ("simulation.step_size.s", "a key inside 'simulation.step_size', which is a single value; expected "),
        ("instances.gian.group", "the unknown instance 'gian'; expected one of gain. Did you mean 'gain'?"),
        ("instances.gain.start_values.k", "a start value; expected `start_values={'gain.k': 2}`"),
    ],
)
def test_a_key_that_cannot_be_replaced_is_a_finding_that_names_option(path: str, words: str) -> None:
    plain = with_options(
        read_text(f"{TEXT}connections: [a.y -> b.u]\n", Path("one.yaml")), PlanOptions(config_values={path: 2})
    )

    (finding,) = plain.findings
    assert str(finding).startswith(f"one.yaml: `config_values={{'{path}': 2}}`: ")
    assert words in str(finding)


def test_a_replaced_value_is_checked_like_the_file(tmp_path: Path) -> None:
    file = tmp_path / "one.yaml"
    file.write_text(TEXT.replace("Gain.fmu", str(FMUS / "Gain.fmu")))

    def findings(**options: Any) -> list[str]:  # noqa: ANN401 the values of options
        with pytest.raises(ConfigurationError) as raised:
            prepare(file, PlanOptions(**options))
        return [in_flags(str(finding).removeprefix(f"{file}: ")) for finding in raised.value.findings]

    keys = listed(SimulationConfig.__struct_fields__)
    assert findings(config_values={"simulation.windw": 3, "zenoh": {"mode": "pear"}, "timeouts.step": 0}) == [
        f"--set-config simulation.windw=3: an unknown key; expected one of {keys}. Did you mean 'window'?",
        "--set-config zenoh={'mode': 'pear'}: 'pear'; expected client or peer. Did you mean 'peer'?",
        "--set-config timeouts.step=0: 0; expected a finite number > 0",
    ]
    assert findings(algorithm="jacoby") == [
        "--algorithm jacoby: 'jacoby'; expected gauss_seidel or jacobi. Did you mean 'jacobi'?"
    ]
    assert findings(window=3, config_values={"simulation.window": 4}) == [
        "--set-config simulation.window=4: replaced by `--window` as well; expected one of the two options"
    ]
    options = PlanOptions(algorithm="jacobi", step_size=0.25, config_values={"simulation.stop_time": None})
    plan = prepare(file, options)
    assert (plan.system.config.simulation.algorithm, plan.grid.step_size, plan.grid.stop_time) == ("jacobi", 0.25, None)


SPELLS_FLAGS = {
    "run/options.py": "it says how the command line spells them",
    "hosts/processes.py": "commands that an engine runs",
    "hosts/slurm.py": "options of sbatch",
    "hosts/slurm_mesh.py": "options of sbatch, and of a command that a job runs",
    "sweeps/slurm_array.py": "options of sbatch",
    "sweeps/slurm_sweep.py": "a command that the tasks of a job run",
    "__main__.py": "it reads the command line",
    "foxglove/foxglove_server.py": "only the command line serves it",
}
"""Modules outside of `cli` with the flags of options, with the reason."""


def test_messages_of_the_library_name_options_without_dashes() -> None:
    flags = {field.flag for field in option_fields(RunOptions).values() if field.flag} | {"--ssd", "--ssv", "--timeout"}
    written = re.compile(rf"(?:{'|'.join(sorted(flags))})\b(?!-)")
    found = set()
    for path in (FMUS.parent / "fmu_mesh").rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        docstrings = {node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        texts = (node for node in ast.walk(tree) if isinstance(node, ast.Constant) and node not in docstrings)
        if any(isinstance(text.value, str) and written.search(text.value) for text in texts):
            found.add(path.relative_to(FMUS.parent / "fmu_mesh").as_posix())

    assert {name for name in found if not name.startswith("cli/")} == SPELLS_FLAGS.keys()


@pytest.mark.parametrize(
    ("text", "flags"),
    [
        ("`output='a b.csv'`: a file", "--output a b.csv: a file"),
        ("Choose another file with `output=...`.", "Choose another file with `--output`."),
        ("m.yaml: `listen=['tcp/a:1', 'tcp/b:1']`: x", "m.yaml: --listen tcp/a:1, tcp/b:1: x"),
        ("expected `step_size`, in s", "expected `--step-size`, in s"),
        ("a `window` of `record`, or `resume`", "a `window` of `record`, or `resume`"),
        ("`allow_code=True` runs it", "`--allow-code` runs it"),
        ("`processes=4`: expected bool", "--local 4: expected bool"),
    ],
)
def test_the_command_line_shows_options_as_flags(text: str, flags: str) -> None:
    assert in_flags(text) == flags


def test_the_options_of_a_bag_are_checked_before_it_is_played() -> None:
    run = cast("Run", None)  # not reached

    with pytest.raises(CallRefused, match="Did you mean `topics`"):
        Run.play(run, "bag.mcap", topic=["/a=b.c"])  # type: ignore[call-arg]  # as above
    with pytest.raises(CallRefused, match="`stamps='sent'`: expected 'header', 'log'"):
        Run.play(run, "bag.mcap", stamps="sent")  # type: ignore[arg-type]  # as above
