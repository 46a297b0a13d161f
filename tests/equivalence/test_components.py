"""Components in Python in each place of an FMU: processes and one process give the same bytes; and what goes wrong."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml

import fmu_mesh
from fmu_mesh.errors import StepFailed
from tests.helpers import FMUS, Place, rows_of

PARTS = '''\
"""Components for tests."""

import math

import numpy as np

import fmu_mesh
from fmu_mesh import Input, Output, Parameter


class Source(fmu_mesh.Component):
    """A sine of its own, with memory."""

    step_by = Parameter(0.1, tunable=True)
    y = Output(unit="deg")

    def initialize(self):
        self.angle = self.start_time
        self.y = math.sin(self.angle)

    def step(self, time, step_size):
        self.angle += self.step_by * step_size * 100
        self.y = 90.0 * math.sin(self.angle) + time


class Lag(fmu_mesh.Component):
    """A first-order lag; the file has it, so that two instances could share `shared`."""

    shared = []
    t = Parameter(0.05, unit="s", min=0.0)
    u = Input(unit="rad")
    y = Output(0.25, unit="rad", depends_on=())

    def __init__(self, scale=1.0):
        self.scale = scale

    def step(self, time, step_size):
        self.shared.append(time)
        self.y += (self.scale * self.u - self.y) * step_size / self.t + 1e-9 * len(self.shared)


@fmu_mesh.component(y=Output())
def gain(time, u, k=2.0):
    return k * u + 1e-3 * time


class Half(fmu_mesh.Component):
    """Its initial output depends on its input; `initialize` counts, which must not count."""

    offset = Parameter(1.0)
    u = Input(0.3)
    y = Output()
    seen = Output(type="Int64", depends_on=())

    def __init__(self):
        self.calls = 0

    def initialize(self):
        self.calls += 1
        self.seen = self.calls
        self.y = 0.5 * self.u + self.offset + 0.01 * self.calls

    def step(self, time, step_size):
        self.y = 0.5 * math.cos(self.u) + 0.1 * self.y


class Arrays(fmu_mesh.Component):
    """All kinds of values, and a matrix product."""

    u = Input(shape=(2, 3))
    n = Input(type="Int32")
    text = Input(type="String")
    v = Output(shape=3)
    m = Output(shape=(2, 3))
    count = Output(type="Int32")
    odd = Output(False, type="Boolean")
    said = Output(type="String")
    small = Output(type="Float32")
    mode = Output(type="Enumeration", items={"off": 0, "on": 1})

    def initialize(self):
        self.v = [1.0, 2, np.float32(0.5)]
        self.m = np.arange(6.0).reshape(2, 3)
        self.count, self.said, self.small, self.mode = 0, "", 0.1, "off"

    def step(self, time, step_size):
        self.m = self.m + 0.1 * self.u
        self.v = self.m.T @ self.m @ np.ones(3) * 1e-3
        self.count = self.n + 1
        self.odd = self.count % 2 == 1
        self.said = self.text[-3:] + str(self.count)
        self.small = np.float32(self.small) * 1.01
        self.mode = 1 if self.odd else 0
'''

GAIN, INTEGRATOR, DELAY, PENDULUM = (
    str(FMUS / f"{name}.fmu") for name in ("Gain", "Integrator", "TransportDelay", "DampedPendulum")
)


def part(name: str, **keys: Any) -> dict[str, Any]:  # noqa: ANN401 as the file has it
    return {"python": f"parts.py:{name}", **keys}


SYSTEMS: dict[str, tuple[Mapping[str, Any], Sequence[Any]]] = {
    "first_of_a_chain": (
        {"source": part("Source"), "gain": {"fmu": GAIN}, "delay": {"fmu": DELAY, "start_values": {"d": 0.0105}}},
        ["source.y -> gain.u", "gain.y -> delay.x"],
    ),
    "within_a_chain": (
        {
            "pendulum": {"fmu": PENDULUM, "start_values": {"a": 1.3}},
            "lag": part("Lag", arguments={"scale": 2.0}, start_values={"t": 0.02}),
            "again": part("Lag"),
            "delay": {"fmu": DELAY, "start_values": {"d": 0.0105}},
        },
        ["pendulum.a -> lag.u", "lag.y -> again.u", "again.y -> delay.x"],
    ),
    "last_of_a_chain": (
        {"pendulum": {"fmu": PENDULUM, "start_values": {"a": 1.3}}, "gain": part("gain", start_values={"k": -0.7})},
        ["pendulum.a -> gain.u"],
    ),
    "units_are_converted": (
        {"source": part("Source"), "lag": part("Lag")},
        ["source.y -> lag.u"],
    ),
    "a_cycle": (
        {"lag": part("Lag"), "integrator": {"fmu": INTEGRATOR}},
        ["integrator.y -> lag.u", {"from": "lag.y", "to": "integrator.u", "factor": -1.0}],
    ),
    "a_cycle_of_components_in_a_group": (
        {"half": part("Half", group="g"), "other": part("Half", group="g"), "lag": part("Lag", group="g")},
        ["half.y -> other.u", "other.y -> half.u", "half.y -> lag.u"],
    ),
    "slower_than_others": (
        {"pendulum": {"fmu": PENDULUM}, "lag": part("Lag", step_size=0.005), "gain": {"fmu": GAIN}},
        ["pendulum.a -> lag.u", "lag.y -> gain.u"],
    ),
    "faster_than_others": (
        {"source": part("Source"), "gain": {"fmu": GAIN, "step_size": 0.003}, "lag": part("Lag")},
        ["source.y -> gain.u", "gain.y -> lag.u"],
    ),
    "arrays_and_all_types": (
        {"one": part("Arrays"), "two": part("Arrays", start_values={"u": [[1, 2, 3], [4, 5, 6]]})},
        [
            "one.m -> two.u",
            "two.v[2] -> one.u[1,3]",
            "one.count -> two.n",
            "two.count -> one.n",
            "one.said -> two.text",
            "two.said -> one.text",
        ],
    ),
    "an_algebraic_loop_at_the_start": (
        {"half": part("Half"), "other": part("Half", start_values={"offset": -2.0}), "gain": {"fmu": GAIN}},
        ["half.y -> other.u", "other.y -> half.u", "other.y -> gain.u"],
    ),
    "an_algebraic_loop_with_an_fmu": (
        {"half": part("Half"), "gain": {"fmu": GAIN, "start_values": {"k": 0.5}}, "last": part("gain")},
        ["half.y -> gain.u", "gain.y -> half.u", "half.y -> last.u"],
    ),
}


def written(
    folder: Path,
    instances: Mapping[str, Any],
    connections: Sequence[Any] = (),
    stop_time: float = 0.3,
    **more: Any,  # noqa: ANN401 as the file has it
) -> Path:
    """A configuration `m.yaml` with the components of `parts.py`; ``simulation`` and ``timeouts`` may be more."""
    (folder / "parts.py").write_text(PARTS, encoding="utf-8")
    content = {
        "mesh": "m",
        "record": {"file": "m.csv"},
        **more,
        "simulation": {"stop_time": stop_time, "step_size": 0.001, **more.get("simulation", {})},
        "instances": dict(instances),
        "connections": list(connections),
    }
    path = folder / "m.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path


def both(place: Place, config: Path) -> bytes:
    """The result of processes, which has to be that of one process."""
    local = place.folder / "local.csv"
    runs = [place.run("launch", config, "--no-progress"), place.run("launch", config, "--local", "--output", local)]
    assert [run.wait() for run in runs] == [0, 0], place.story()
    result = (place.folder / "m.csv").read_bytes()
    assert result == local.read_bytes()
    return result


@pytest.mark.parametrize("algorithm", ["gauss_seidel", "jacobi"])
@pytest.mark.parametrize("name", SYSTEMS)
def test_processes_and_one_process_write_the_same_bytes(place: Place, name: str, algorithm: str) -> None:
    instances, connections = SYSTEMS[name]
    config = written(place.folder, instances, connections, simulation={"algorithm": algorithm})

    lines = both(place, config).decode().splitlines()

    assert len(lines) == 302
    columns = list(zip(*csv.reader(lines), strict=True))
    ours = [column for column in columns if instances.get(column[0].partition(".")[0], {}).get("python")]
    assert ours
    assert all(len(set(column)) > 2 for column in ours if column[0].endswith((".y", ".count")))


def test_a_window_of_one_point_gives_the_same_bytes(place: Place) -> None:
    instances, connections = SYSTEMS["a_cycle"]
    simulations = ({"window": 1}, {"window": 64})
    results = [both(place, written(place.folder, instances, connections, simulation=own)) for own in simulations]

    assert results[0] == results[1]


def test_step_starts_at_its_point_and_its_outputs_belong_to_its_end(place: Place) -> None:
    """The system by hand: Gauss-Seidel, so the gain uses the value at the end of the step."""
    instances = {"lag": part("Lag", start_values={"u": 1.0}), "gain": part("gain", start_values={"k": 3.0})}
    both(place, written(place.folder, instances, ["lag.y -> gain.u"], stop_time=0.01))

    expected, y = [(0.0, 0.25, 3.0 * 0.25 + 1e-3 * 0.0)], 0.25
    for point in range(10):
        y += (1.0 * 1.0 - y) * 0.001 / 0.05 + 1e-9 * (point + 1)
        expected.append(((point + 1) * 0.001, y, 3.0 * y + 1e-3 * (point * 0.001)))
    assert rows_of(place.folder / "m.csv") == expected


def test_a_loop_at_the_start_is_iterated_whatever_initialize_changes_besides(place: Place) -> None:
    instances, connections = SYSTEMS["an_algebraic_loop_at_the_start"]
    first = both(place, written(place.folder, instances, connections)).decode().splitlines()[1].split(",")

    header = (place.folder / "m.csv").read_text().splitlines()[0].split(",")
    values = dict(zip(header, map(float, first), strict=True))
    assert values["half.seen"] == values["other.seen"] == 1
    # y = 0.5 x + 1.01 and x = 0.5 y - 1.99
    assert values["half.y"] == pytest.approx((1.01 - 0.5 * 1.99) / 0.75, abs=1e-6)
    assert values["other.y"] == 0.5 * values["half.y"] - 2.0 + 0.01


def test_a_unit_is_converted_and_one_of_another_dimension_is_refused(place: Place) -> None:
    instances = {"source": part("Source"), "lag": part("Lag"), "half": part("Half")}
    checked = place.run("check", written(place.folder, instances, ["source.y -> lag.u"]))
    assert checked.wait() == 0, checked.errors
    assert "deg to rad" in checked.output

    text = (place.folder / "parts.py").read_text(encoding="utf-8").replace('Output(unit="deg")', 'Output(unit="N.m")')
    (place.folder / "parts.py").write_text(text, encoding="utf-8")
    refused = place.run("check", place.folder / "m.yaml")

    assert refused.wait() == 2
    assert "connects the unit 'N.m' (kg.m2.s-2) to the unit 'rad' (rad)" in refused.errors


def test_a_running_component_is_looked_at_and_set_as_an_fmu_is(place: Place) -> None:
    instances = {"lag": part("Lag", start_values={"u": 1.0}), "source": part("Source")}
    launched = place.start("launch", written(place.folder, instances, stop_time=1e5), "--no-progress", "--paused")
    assert place.run("wait", "m", "--state", "paused").wait() == 0

    info = place.run("info", "source")
    tuned = place.run("set", "source.step_by", "0")
    fixed = place.run("set", "lag.t", "2")
    free = place.run("set", "lag.u", "4")
    wrong = place.run("set", "lag.u", "true")
    stepped = place.run("step", "m", "3")
    values = [float(place.run("get", f"{name}.y").output.split()[1]) for name in ("source", "lag")]
    stopped = place.run("stop", "m")

    assert [run.wait() for run in (info, tuned, free, stepped, stopped)] == [0] * 5, place.story()
    assert (fixed.wait(), wrong.wait()) == (2, 2)
    assert "only tunable ones can be set" in fixed.errors
    assert "Python" in info.output
    assert "component" in info.output
    assert values[0] == 0.002  # the sine of 0, and the time at which the last step started
    assert launched.wait() == 130, launched.errors  # stopped before its end


def fault(body: str, output: str = "Output()", code: int = 3) -> tuple[str, int]:
    """The file of a component that fails in line 9, and the exit code of its run."""
    head = "import sys, numpy as np, fmu_mesh\nfrom fmu_mesh import Output\n"
    head += "from fmu_mesh.errors import TerminationRequested\n\n\nclass C(fmu_mesh.Component):\n"
    return f"{head}    y = {output}\n{textwrap.indent(body, '    ')}\n", code


STEP = "def step(self, time, step_size):\n"
NO_STEP = f"\n{STEP}    pass"
AT_0 = "instance c.y, point 0, t = 0 s: "
FAULTS: dict[str, tuple[tuple[str, int], str]] = {
    "in_a_step": (
        fault(f"{STEP}    self.y = 1 / (time < 0.05)"),
        "instance c, point 50, t = 0.05 s: broken.py:9: ZeroDivisionError: division by zero. What was recorded",
    ),
    "in_initialize": (
        fault(f"def initialize(self):\n    self.y = [][1]{NO_STEP}"),
        "instance c: broken.py:9: IndexError: list index out of range",
    ),
    "in_a_library": (
        fault(f"{STEP}    np.linalg.inv(np.zeros((2, 2)))"),
        "broken.py:9: LinAlgError: Singular matrix (",
    ),
    "no_value": (
        fault(f"{STEP}    self.z = 1"),
        f"{AT_0}the component has not assigned this output. Assign `self.y` in `step`",
    ),
    "text_for_a_number": (fault(f"{STEP}    self.y = 'warm'"), f"{AT_0}its value is 'warm', expected a number"),
    "another_shape": (
        fault(f"{STEP}    self.y = np.zeros(2)", "Output(shape=3)"),
        "its value is an array of float64 with the shape (2,), expected an array of Float64 with the shape (3,)",
    ),
    "an_exit": (fault(f"{STEP}    sys.exit('over')"), "broken.py:9: SystemExit: over"),
    "in_the_constructor": (
        fault(f"def __init__(self):\n    open('/nowhere'){NO_STEP}"),
        "broken.py:9: FileNotFoundError: ",
    ),
    "an_orderly_end": (fault(f"{STEP}    raise TerminationRequested('landed')", "Output(0.0)", 0), "landed"),
}


@pytest.mark.parametrize("options", [(), ("--local",)], ids=["processes", "local"])
@pytest.mark.parametrize("name", FAULTS)
def test_what_goes_wrong_in_a_component_is_told_with_its_line(place: Place, name: str, options: Sequence[str]) -> None:
    (source, code), message = FAULTS[name]
    (place.folder / "broken.py").write_text(source, encoding="utf-8")
    config = written(place.folder, {"c": {"python": "broken.py:C"}, "gain": {"fmu": GAIN}})

    launched = place.run("launch", config, "--no-progress", *options)

    assert launched.wait() == code, place.story()
    assert message in (launched.message if code else launched.errors), place.story()
    place.assert_nothing_left(10.0)


@pytest.mark.parametrize("name", ["UInt8", "UInt64"])
def test_list_of_whole_numbers_is_an_array_of_unsigned_ones(tmp_path: Path, name: str) -> None:
    source, _ = fault(f"u = Input()\n{STEP}    self.y = [1, int(self.u)]", f"Output(type='{name}', shape=2)")
    (tmp_path / "broken.py").write_text(f"from fmu_mesh import Input\n{source}", encoding="utf-8")

    with fmu_mesh.load(written(tmp_path, {"c": {"python": "broken.py:C"}})).open() as system:
        system.set("c.u", 255.0)
        system.step()
        assert system.get("c.y").tolist() == [1, 255]
        system.set("c.u", -1.0)
        with pytest.raises(StepFailed, match=rf"its value is \[1, -1\], expected an array of {name}"):
            system.step()


@pytest.mark.parametrize("options", [(), ("--local",)], ids=["processes", "local"])
@pytest.mark.parametrize("where", ["initialize", "step"])
def test_a_component_that_hangs_is_told_by_its_name_and_line(place: Place, where: str, options: Sequence[str]) -> None:
    lines = ["import fmu_mesh", "class C(fmu_mesh.Component):", "    y = fmu_mesh.Output(0.0)"]
    lines += [f"    def {where}(self, *times):", "        while True:", "            pass"]
    lines += ["    def step(self, time, step_size): pass"] if where != "step" else []
    text = "\n".join(lines) + "\n"
    (place.folder / "slow.py").write_text(text, encoding="utf-8")
    timeouts = {"step": 1.0, "call": 1.0}
    config = written(place.folder, {"c": {"python": "slow.py:C"}, "gain": {"fmu": GAIN}}, timeouts=timeouts)

    launched = place.run("launch", config, "--no-progress", *options)

    assert launched.wait() == 3, place.story()
    assert f" s from {where} (slow.py:" in launched.message
    assert launched.message.startswith("fmu-mesh: instance c"), launched.message
    place.assert_nothing_left(10.0)


@pytest.mark.parametrize("options", [(), ("--local",)], ids=["processes", "local"])
def test_what_a_component_prints_goes_where_the_output_of_an_fmu_goes(place: Place, options: Sequence[str]) -> None:
    lines = ["import fmu_mesh", "print('imported')", "class C(fmu_mesh.Component):", "    y = fmu_mesh.Output(0.0)"]
    lines += ["    def step(self, time, step_size):", "        if time == 0.0: print('first step')"]
    lines += ["    def close(self): print('closed')"]
    text = "\n".join(lines) + "\n"
    (place.folder / "loud.py").write_text(text, encoding="utf-8")

    launched = place.run("launch", written(place.folder, {"c": {"python": "loud.py:C"}}), "--no-progress", *options)

    assert launched.wait() == 0
    for line in ("imported", "first step", "closed"):
        assert launched.errors.count(line) == 1
        assert line not in launched.output


def test_a_matrix_product_is_the_same_whatever_the_environment_says_about_threads(place: Place) -> None:
    """With two threads, OpenBLAS multiplies these matrices with other last digits."""
    text = "import numpy as np, fmu_mesh\nclass C(fmu_mesh.Component):\n    y = fmu_mesh.Output(0.0)\n"
    text += "    def __init__(self):\n        self.a = np.random.default_rng(0).standard_normal((400, 400))\n"
    text += "    def step(self, time, step_size):\n        self.a = self.a @ self.a\n"
    text += "        self.a /= np.abs(self.a).max()\n"
    text += "        self.y = float(self.a.sum())\n"
    (place.folder / "product.py").write_text(text, encoding="utf-8")
    config = written(place.folder, {"c": {"python": "product.py:C"}}, stop_time=0.005)
    place.environment |= {"OPENBLAS_NUM_THREADS": "2", "OMP_NUM_THREADS": "2", "MKL_NUM_THREADS": "2"}
    both(place, config)
    program = "import numpy, fmu_mesh\nnumpy.ones((9, 9)) @ numpy.ones((9, 9))\n"
    program += "fmu_mesh.load('m.yaml').run(processes=False)\n"

    in_a_program = place.start_command([sys.executable, "-c", program])

    assert in_a_program.wait() == 0, place.story()
    assert (place.folder / "m.csv").read_bytes() == (place.folder / "local.csv").read_bytes()


# --- importing what a user wrote


def refused(place: Place, config: Path, *options: str) -> str:
    launched = place.run("check", config, *options)
    assert launched.wait() == 2, place.story()
    return launched.errors


@pytest.mark.parametrize(
    ("keys", "found"),
    [
        ({"python": "part.py:Lag"}, "no such file; expected a component in Python, such as `controller.py:Controller`"),
        ({"python": "parts.py"}, "'parts.py' names no class at the top of the module, expected `parts.py:Controller`"),
        ({"python": "parts.py:Lagg"}, "there is no 'Lagg' in 'parts.py', which has Source, Lag, gain"),
        ({"python": "parts.py:math"}, "'math' in 'parts.py' is a module and no component"),
        ({"python": "no.such.module:Lag"}, "ModuleNotFoundError: No module named 'no'"),
        ({"python": "bad.py:Lag"}, "bad.py:2: SyntaxError: "),
        ({"python": "raising.py:Lag"}, "raising.py:1: KeyError: 'x'"),
        ({"python": "leaving.py:Lag"}, "its import ended the process with exit code 7; it wrote: goodbye"),
        ({"python": "unit.py:C"}, "unit.py:3: 'Flaot64' is no type of a variable"),
        ({"python": "plain.py:f"}, "'f' in 'plain.py' is a function and no component"),
        ({"python": "plain.py:D"}, "'D' in 'plain.py' is a class and no component (Derive it from"),
        ({"python": "parts.py:Lag", "arguments": {"scael": 1}}, "got an unexpected keyword argument 'scael'"),
        (
            {"python": "parts.py:gain", "arguments": {"k": 1}},
            "which could take the argument 'k' (The values of parameters",
        ),
        ({"python": "depends.py:C"}, "'y' depends on 'v', which is no input (The inputs are u)"),
        ({"python": "parts.py:Lag", "start_values": {"t": -1}}, "-1 for 't', which is out of its range"),
        ({"python": "parts.py:Lag", "interpreters": "x"}, "Did you mean 'interpreter'?"),
        ({"python": "parts.py:Lag", "interpreter": "/no/python"}, "the Python '/no/python' cannot be started"),
    ],
)
def test_what_cannot_be_imported_is_a_finding_with_its_place(place: Place, keys: dict[str, Any], found: str) -> None:
    files = {
        "bad.py": "def f():\n    return return\n",
        "raising.py": "{}['x']\n",
        "leaving.py": "import os, sys\nsys.stderr.write('goodbye')\nsys.stderr.flush()\nos._exit(7)\n",
        "unit.py": "import fmu_mesh\nclass C(fmu_mesh.Component):\n    y = fmu_mesh.Output(type='Flaot64')\n",
        "plain.py": "def f(u): return u\nclass D: pass\n",
        "depends.py": "import fmu_mesh\nclass C(fmu_mesh.Component):\n    u = fmu_mesh.Input()\n"
        "    y = fmu_mesh.Output(depends_on=('v',))\n    def step(self, t, h): pass\n",
    }
    for name, text in files.items():
        (place.folder / name).write_text(text, encoding="utf-8")

    errors = refused(place, written(place.folder, {"c": keys}))

    assert found in errors
    assert "m.yaml:" in errors
    assert "Traceback" not in errors


def test_the_folder_of_component_is_last_place_where_modules_are_looked_for(place: Place) -> None:
    (place.folder / "random.py").write_text("raise RuntimeError('the one of the user')\n", encoding="utf-8")
    (place.folder / "helping.py").write_text("factor = 3.0\n", encoding="utf-8")
    text = "import random, helping, fmu_mesh\nclass C(fmu_mesh.Component):\n    y = fmu_mesh.Output()\n"
    text += "    def step(self, time, step_size): self.y = helping.factor * random.Random(1).random()\n"
    (place.folder / "drawing.py").write_text(text, encoding="utf-8")

    both(place, written(place.folder, {"c": {"python": "drawing.py:C"}}))


def test_a_component_that_was_changed_after_the_plan_does_not_run(place: Place) -> None:
    text = (
        "import fmu_mesh\nclass C(fmu_mesh.Component):\n    y = fmu_mesh.Output(0.0)\n    def step(self, t, h): pass\n"
    )
    # It changes its own file when it is imported to be described.
    text += "open(__file__, 'a').write('# more\\n')\n"
    (place.folder / "changing.py").write_text(text, encoding="utf-8")

    launched = place.run("launch", written(place.folder, {"c": {"python": "changing.py:C"}}), "--no-progress")

    assert launched.wait() in (2, 3)
    assert "is another component than when the run was planned" in launched.message


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a file to another user")
@pytest.mark.parametrize("command", ["check", "launch"])
def test_code_that_the_file_of_another_user_names_does_not_run(place: Place, command: str) -> None:
    text = f"open({str(place.folder / 'ran')!r}, 'w')\n{PARTS}"
    config = written(place.folder, {"lag": part("Lag")})
    (place.folder / "parts.py").write_text(text, encoding="utf-8")
    os.chown(config, 12345, -1)

    launched = place.run(command, config)

    assert launched.wait() == 2
    expected = (
        "instances.lag.python: Python code, in a file of the user 12345; expected a file of your own, or `--allow-code`"
    )
    assert expected in launched.errors
    assert not (place.folder / "ran").exists()
    allowed = place.run(command, config, "--allow-code")
    assert allowed.wait() == 0, allowed.errors
    assert (place.folder / "ran").exists()


# --- another Python


@pytest.fixture(scope="module")
def other_python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Python with an environment of its own, which has our package and a module `only_there`."""
    folder = tmp_path_factory.mktemp("environment")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True, timeout=120)
    [packages] = folder.glob("lib/python*/site-packages")
    here = [path for path in sys.path if path.endswith("site-packages")]
    root = Path(fmu_mesh.__file__).parents[1]
    (packages / "ours.pth").write_text("\n".join([str(root), *here]) + "\n", encoding="utf-8")
    (packages / "only_there.py").write_text("value = 42.0\n", encoding="utf-8")
    return folder / "bin" / "python"


ELSEWHERE = """\
import sys
import only_there, fmu_mesh
class C(fmu_mesh.Component):
    y = fmu_mesh.Output()
    python = fmu_mesh.Output(type="String")
    def step(self, time, step_size):
        self.y = only_there.value
        self.python = sys.executable
"""


def elsewhere(place: Place, interpreter: Path | str, **keys: Any) -> Path:  # noqa: ANN401 as the file has it
    (place.folder / "elsewhere.py").write_text(ELSEWHERE, encoding="utf-8")
    own = {"python": "elsewhere.py:C", "interpreter": str(interpreter), **keys}
    record = {"file": "m.csv", "variables": ["c.y", "c.python"]}
    return written(place.folder, {"c": own, "lag": part("Lag", **keys)}, ["c.y -> lag.u"], record=record)


def test_a_component_runs_in_the_python_that_its_section_names(place: Place, other_python: Path) -> None:
    (place.folder / "env").symlink_to(other_python.parents[1])
    config = elsewhere(place, "env/bin/python")

    checked = place.run("check", config)
    launched = place.run("launch", config, "--no-progress")

    assert checked.wait() == 0, checked.errors
    assert f"(class C, {place.folder.resolve()}/env/bin/python)" in checked.output
    assert launched.wait() == 0, launched.errors
    *_, last = csv.reader((place.folder / "m.csv").read_text(encoding="utf-8").splitlines())
    assert last[1:] == ["42.0", f"{place.folder.resolve()}/env/bin/python"]


def test_a_component_of_another_python_is_refused_locally_and_in_a_group(place: Place, other_python: Path) -> None:
    local = place.run("launch", elsewhere(place, other_python), "--local")
    grouped = place.run("check", elsewhere(place, other_python, group="g"))

    assert (local.wait(), grouped.wait()) == (2, 2)
    assert (
        f"'c' needs the Python '{other_python}', and this process is another one. Run the mesh in processes"
        in local.errors
    )
    assert "expected one interpreter for all components of the group 'g'" in grouped.errors


def test_this_python_by_its_name_is_no_other_python(place: Place) -> None:
    (place.folder / "parts.py").write_text(PARTS, encoding="utf-8")
    both(place, written(place.folder, {"lag": part("Lag", interpreter=sys.executable)}))


def test_inputs_of_a_component_in_another_python_are_recorded_as_here(place: Place, other_python: Path) -> None:
    (place.folder / "parts.py").write_text(PARTS, encoding="utf-8")
    found = []
    for python in (sys.executable, str(other_python)):
        instances = {"source": part("Source"), "lag": part("Lag", interpreter=python)}
        record = {"file": "m.csv", "variables": ["*", "in:*"]}
        config = written(place.folder, instances, ["source.y -> lag.u"], record=record)
        done = place.run("launch", config, "--no-progress")
        assert done.wait() == 0, done.errors
        found.append((place.folder / "m.csv").read_bytes())

    assert found[0] == found[1]
    assert found[0].startswith(b"time,source.y,lag.y,lag.u\n")


def test_node_started_by_hand_in_wrong_python_says_how_to_start_it(place: Place, other_python: Path) -> None:
    config = elsewhere(place, other_python)

    node = place.run("node", config, "c")

    assert node.wait() == 2
    assert f"Start it with `{other_python} -m fmu_mesh node {config} c`." in node.message


@pytest.mark.parametrize("version", ["", "0.0.9"])
def test_a_python_without_our_version_is_finding_that_says_what_to_install(place: Place, version: str) -> None:
    python = place.folder / "python"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", place.folder / "bare"], check=True, timeout=120)
    if version:
        [packages] = (place.folder / "bare").glob("lib/python*/site-packages")
        (packages / "fmu_mesh.py").write_text(f"__version__ = {version!r}\n", encoding="utf-8")
    python = place.folder / "bare" / "bin" / "python"

    errors = refused(place, elsewhere(place, python))

    has = f"has fmu-mesh {version}" if version else "has no fmu-mesh"
    wanted = f"{python} -m pip install {FMUS.parent}"
    assert f"the Python '{python}' {has} (Install fmu-mesh {fmu_mesh.__version__} there: {wanted})" in errors


# --- a class of a program

PROGRAM = """\
import fmu_mesh


class C(fmu_mesh.Component):
    y = fmu_mesh.Output(0.0)

    def step(self, time, step_size):
        self.y += 1.0


def main():
    mesh = fmu_mesh.Mesh("m", step_size=0.1, stop_time=0.5)
    mesh.add("c", component=C)
    print(mesh.run(record="memory")["c.y"])


"""
GUARDED = f"{PROGRAM}if __name__ == '__main__':\n    main()\n"


def test_a_class_of_the_program_that_runs_is_found_in_its_file(place: Place) -> None:
    (place.folder / "program.py").write_text(GUARDED, encoding="utf-8")

    done = place.start_command([sys.executable, str(place.folder / "program.py")])

    assert done.wait() == 0, done.errors
    assert done.output == "[0. 1. 2. 3. 4. 5.]\n"
    place.assert_nothing_left(10.0)


def test_a_program_in_a_folder_of_modules_is_found_in_its_file(place: Place) -> None:
    (place.folder / "package").mkdir()
    (place.folder / "package" / "__init__.py").touch()
    (place.folder / "package" / "program.py").write_text(GUARDED, encoding="utf-8")

    done = place.start_command([sys.executable, "-m", "package.program"])

    assert done.wait() == 0, done.errors
    assert done.output == "[0. 1. 2. 3. 4. 5.]\n"


def test_a_program_without_a_guard_is_told_so_and_starts_nothing(place: Place) -> None:
    (place.folder / "program.py").write_text(f"{PROGRAM}main()\n", encoding="utf-8")

    done = place.start_command([sys.executable, "program.py"])

    assert done.wait() == 1
    expected = "program.py:14: mesh 'm' would run while "
    assert expected in done.errors
    assert 'is imported (Write `if __name__ == "__main__":` before what the program does)' in done.errors
    place.assert_nothing_left(10.0)


@pytest.mark.parametrize("how", ["-c", "-"])
def test_a_class_without_a_file_is_refused_as_that_of_a_notebook(place: Place, how: str) -> None:
    program = f"{PROGRAM}main()\n"
    done = subprocess.run(
        [sys.executable, *(["-c", program] if how == "-c" else ["-"])],
        input=program if how == "-" else None,
        env=place.environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )

    assert done.returncode == 1
    expected = "the component 'C': no file has it, because a notebook or an interactive session defined it. Write it to"
    assert expected in done.stderr


def test_a_class_within_a_function_is_refused(place: Place) -> None:
    program = GUARDED.replace(
        "import fmu_mesh\n",
        "import fmu_mesh\n\ndef make():\n    class C(fmu_mesh.Component):\n"
        "        def step(self, time, step_size): pass\n    return C\n",
        1,
    ).replace("component=C", "component=make()")
    (place.folder / "program.py").write_text(program, encoding="utf-8")

    done = place.start_command([sys.executable, "program.py"])

    assert done.wait() == 1
    assert "'make.<locals>.C': it is defined within a function or a class. Define it at the top" in done.errors


def test_a_component_is_stepped_by_hand_and_goes_back_to_a_state(place: Place) -> None:
    config = written(place.folder, {"source": part("Source"), "gain": part("gain")}, ["source.y -> gain.u"])
    both(place, config)
    rows = rows_of(place.folder / "m.csv")
    header = (place.folder / "m.csv").read_text(encoding="utf-8").splitlines()[0].split(",")

    with fmu_mesh.load(config).open() as system:
        system.step(100)
        state = system.save()
        for _ in range(2):
            system.restore(state)
            system.step(50)
            assert tuple(system.get(name) for name in header[1:]) == rows[150][1:]
