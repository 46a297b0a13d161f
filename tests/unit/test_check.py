"""What `check` prints: the whole page of small systems, from the FMUs that are kept."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path

import pytest
from msgspec.structs import replace

from fmu_mesh.cli.main import main
from fmu_mesh.config.structure import json_schema
from fmu_mesh.errors import Finding
from fmu_mesh.instances.configuration import installed_config
from fmu_mesh.pictures.plan_page import plan_page
from tests.planning import prepare

FMUS = Path(__file__).parents[2] / "fmus"


def write(folder: Path, text: str) -> Path:
    """A configuration in ``folder`` that finds the kept FMUs under `fmus/`."""
    (folder / "fmus").symlink_to(FMUS)
    path = folder / "mesh.yaml"
    path.write_text(text, encoding="utf-8")
    return path


LOOP = """\
mesh: loop
simulation: {start_time: 1.0, stop_time: 3.0, step_size: 0.01, window: 16, real_time_factor: 2}
instances:
  pendulum: {fmu: fmus/DampedPendulum.fmu, start_values: {a: 1.3}}
  sum: {fmu: fmus/Adder.fmu}
  loop: {fmu: fmus/Gain.fmu, start_values: {k: -0.5}, step_size: 0.02}
  inner: {fmu: fmus/Gain.fmu, group: pair}
  outer: {fmu: fmus/Integrator.fmu, group: pair, start_values: {u: 0.25}}
connections:
  - {from: pendulum.a, to: sum.u1, factor: 57.3, offset: -1}
  - sum.y -> loop.u
  - loop.y -> sum.u2
  - {from: sum.y, to: inner.u, offset: 2}
  - {from: inner.y, to: outer.u, delay: 1}
record: {file: results/loop.csv, variables: [pendulum.a, outer.y]}
"""

LOOP_PAGE = """\
Mesh        loop
Simulation  1 s to 3 s in 200 steps of 0.01 s
Algorithm   gauss_seidel
Window      16 points
Speed       2 times real time

Instances
  pendulum  DampedPendulum.fmu (FMI 2.0)  step 0.01 s  a process of its own
  sum       Adder.fmu (FMI 2.0)           step 0.01 s  a process of its own
  loop      Gain.fmu (FMI 2.0)            step 0.02 s  a process of its own
  inner     Gain.fmu (FMI 2.0)            step 0.01 s  group pair
  outer     Integrator.fmu (FMI 2.0)      step 0.01 s  group pair

Start values
  pendulum.a  = 1.3 rad  mesh.yaml:4
  loop.k      = -0.5     mesh.yaml:6
  outer.u     = 0.25     mesh.yaml:8

Connections
  pendulum.a -> sum.u1  delay 0  value at the end of the step    u1 = 57.3 * a - 1                  not converted: sum.u1 has no unit
  sum.y -> loop.u       delay 0  value at the end of the step
  loop.y -> sum.u2      delay 1  value at the start of the step                     closes a cycle
  sum.y -> inner.u      delay 0  value at the end of the step    u = y + 2
  inner.y -> outer.u    delay 1  value at the start of the step

Coupling
  order 1, because inputs are held; `extrapolation: auto` has order 2: midpoint for 5 inputs

Execution order within one point
  pendulum -> sum -> loop -> inner -> outer
  cycle: sum, loop

Groups
  sum, loop form a cycle over 2 nodes: each point costs a round trip; `group: auto` would put them into one

Initialization
  level 0: pendulum.a
  levels 1 to 2 are iterated, beginning with sum.u2 = 0.0
  level 1: sum.y
  level 2: loop.y
  level 3: inner.y

Recorded
  pendulum.a  Real  rad
  outer.y     Real
  into results/loop.csv

Warnings
  mesh.yaml:8: instances.outer.start_values.u: a start value for 'u', which gets its value from the connection inner.y -> outer.u (connections[4]): it has no effect
  mesh.yaml:11: connections[1]: a loop at every point: sum.y -> loop.u, loop.y -> sum.u2. Each of these outputs depends directly on the input before it. The delay of 1 at loop.y -> sum.u2 makes this a fixed-point iteration in time, one sweep per point, which may be unstable: compare with a smaller step size, or solve it by `loops: solved` in `simulation`

OK: mesh.yaml can run.
"""  # noqa: E501 a line of the page is as long as it is


def test_the_page_shows_everything_that_the_plan_decides(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path, LOOP)
    monkeypatch.chdir(tmp_path)

    code = main(["check", "mesh.yaml"])

    assert (code, capsys.readouterr().out) == (0, LOOP_PAGE)


SLOW = """\
mesh: slow
simulation: {stop_time: 1, step_size: 0.1, extrapolation: midpoint}
instances:
  fast: {fmu: fmus/Gain.fmu}
  free: {fmu: fmus/Integrator.fmu, step_size: 0.4}
  fed: {fmu: fmus/Integrator.fmu, step_size: 0.4}
  sum: {fmu: fmus/Adder.fmu}
connections:
  - free.y -> sum.u1
  - fed.y -> sum.u2
  - fast.y -> fed.u
record: {file: null}
"""


def test_a_slow_source_that_cannot_go_ahead_is_named(tmp_path: Path) -> None:
    config = write(tmp_path, SLOW)
    told = "  extrapolated, because the slower source waits for inputs with delay 0: fed.y -> sum.u2"

    assert [line for line in plan_page(prepare(config)) if "extrapolated" in line] == [told]
    config.write_text(SLOW.replace("fast.y -> fed.u", "free.y -> fed.u"), encoding="utf-8")
    assert [line for line in plan_page(prepare(config)) if "extrapolated" in line] == []


JACOBI = """\
mesh: jacobi
simulation: {stop_time: 1, step_size: 0.5, algorithm: jacobi, window: 1}
instances: {a: {fmu: fmus/Gain.fmu}, b: {fmu: fmus/Gain.fmu}}
connections: [a.y -> b.u]
record: {file: null}
"""

JACOBI_PAGE = """\
Mesh        jacobi
Simulation  0 s to 1 s in 2 steps of 0.5 s
Algorithm   jacobi
Window      1 point: lockstep
Speed       as fast as possible

Instances
  a  Gain.fmu (FMI 2.0)  step 0.5 s  a process of its own
  b  Gain.fmu (FMI 2.0)  step 0.5 s  a process of its own

Connections
  a.y -> b.u  delay 1  value at the start of the step

Coupling
  order 1, because inputs are held; `extrapolation: auto` has order 2: midpoint for 1 input

Execution order within one point
  a, b  (at the same time)

Inputs that are not connected
  a  u = 0.0

Initialization
  level 0: a.y

Recorded
  nothing

OK: mesh.yaml can run.
"""


def test_without_order_start_values_and_record_the_page_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path, JACOBI)
    monkeypatch.chdir(tmp_path)

    assert main(["check", "mesh.yaml"]) == 0

    assert capsys.readouterr().out == JACOBI_PAGE


def test_the_page_is_the_same_on_a_narrow_terminal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path, LOOP)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "20")
    monkeypatch.setenv("FORCE_COLOR", "1")

    main(["check", "mesh.yaml"])

    assert capsys.readouterr().out == LOOP_PAGE


def test_a_run_without_an_end_is_shown_as_one(tmp_path: Path) -> None:
    plan = prepare(write(tmp_path, JACOBI.replace("stop_time: 1,", "stop_time: null,")))

    assert plan_page(plan)[1] == "Simulation  0 s to an open end in steps of 0.5 s"
    assert plan.grid.stop_time is None


def test_options_change_the_plan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path, JACOBI)

    assert main(["check", str(path), "--window", "8", "--set", "b.k=4.5"]) == 0

    page = capsys.readouterr().out
    assert "Window      8 points\n" in page
    assert "Start values\n  b.k  = 4.5  --set b.k=4.5\n" in page


def test_what_is_odd_but_can_run_is_a_warning(tmp_path: Path) -> None:
    plan = prepare(write(tmp_path, JACOBI))
    a = plan.system.instances["a"]
    odd = replace(a, description=replace(a.description, problems=("line 3:\n  no  attribute " + 300 * "x",)))
    finding = Finding("mesh.yaml", "connections[0]", "it connects rad to deg", "the same unit")
    system = replace(plan.system, instances={**plan.system.instances, "a": odd}, warnings=(finding,))

    page = plan_page(replace(plan, system=system))

    assert page[page.index("Warnings") :] == [
        "Warnings",
        "  mesh.yaml: connections[0]: it connects rad to deg; expected the same unit",
        f"  a: Gain.fmu: line 3: no attribute {'x' * 176}...",
    ]


def test_a_configuration_with_problems_is_refused_with_all_of_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path, JACOBI.replace("a.y -> b.u", "a.z -> b.u, a.y -> c.u"))

    assert main(["check", str(path)]) == 2

    captured = capsys.readouterr()
    assert captured.out == ""
    assert "2 problems" in captured.err
    assert "the unknown variable 'z' of instance 'a'" in captured.err
    assert "the unknown instance 'c'" in captured.err


@pytest.mark.parametrize("config", sorted((FMUS.parent / "configs").glob("*.yaml")), ids=lambda path: path.name)
def test_every_kept_configuration_can_run(
    config: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    double = Path(__file__).parents[1] / "physics" / "gazebo_double.py"
    monkeypatch.setenv("FMU_MESH_GAZEBO", shlex.join([sys.executable, str(double), "nothing"]))

    assert main(["check", str(config)]) == 0
    assert capsys.readouterr().out.endswith(f"\n\nOK: {config} can run.\n")


def test_schema_prints_the_json_schema(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["schema"]) == 0
    assert json.loads(capsys.readouterr().out) == json_schema(installed_config())


@pytest.mark.parametrize("key", ["fmu", "mujoco", "gazebo_classic"])
def test_an_empty_path_of_a_model_is_a_finding(key: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "mesh.yaml"
    config.write_text(
        f"mesh: m\nsimulation: {{stop_time: 1, step_size: 0.1}}\ninstances: {{a: {{{key}: ''}}}}\n", encoding="utf-8"
    )

    assert main(["check", str(config)]) == 2

    assert f"mesh.yaml:3: instances.a.{key}: an empty path; expected a" in capsys.readouterr().err
