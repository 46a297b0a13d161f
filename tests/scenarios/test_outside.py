"""An instance whose steps come from a program outside of the mesh: the values, and what can go wrong."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

import fmu_mesh
from tests.helpers import Launched, Place, on_a_busy_machine, row_count, wait_until, write_config

RINGS = Path(fmu_mesh.__file__).parent / "rings"
LINES = ("pendulum.a -> importer.angle", "importer.doubled -> delay.x")
IMPORTER = {"outside": {"inputs": {"angle": {"unit": "rad"}}, "outputs": {"doubled": {"unit": "rad"}}}}
COMPONENT = '''"""The same as the programs."""

import fmu_mesh


class Doubler(fmu_mesh.Component):
    """Its output is its input, times two."""

    angle = fmu_mesh.Input(unit="rad")
    doubled = fmu_mesh.Output(start=0.0, unit="rad", depends_on=())

    def step(self, time, step_size):
        self.doubled = 2.0 * self.angle
'''
PROGRAM = '''"""Doubles; stops for good where it is told to."""

import os, sys, time
import fmu_mesh

address, how, at = sys.argv[1], sys.argv[2], int(sys.argv[3])
with fmu_mesh.attach_as(address, timeout=30.0) as me:
    while me.step():
        if me.point == at:
            print("here", flush=True)
            if how == "detach":
                break
            if how == "wait":
                time.sleep(float(os.environ["NAP"]))
        me.set("doubled", 2.0 * me.get("angle"))
    print("ended at", me.point, flush=True)
'''
DOUBLE = """
#include <stdio.h>
#include "outside.h"

int main(int argc, char **argv) {
  char error[600];
  double value = 0.0;
  Outside *own = outside_attach(argc > 1 ? argv[1] : NULL, 30000000000, error, sizeof error);
  if (own == NULL) return fprintf(stderr, "%s\\n", error), 2;
  const int64_t angle = outside_index(own, "angle"), doubled = outside_index(own, "doubled");
  if (outside_index(own, "nothing") != -1 || outside_set_float64(own, angle, &value, 1) != OUTSIDE_WRONG) return 3;
  if (outside_get_float64(own, angle, &value, 2) != OUTSIDE_WRONG) return 4;
  while (outside_step(own, 1) == OUTSIDE_OK) {
    outside_get_float64(own, angle, &value, 1);
    value *= 2.0;
    outside_set_float64(own, doubled, &value, 1);
  }
  printf("%s at %lld\\n", outside_error(own), (long long)outside_point(own));
  outside_detach(own);
  return 0;
}
"""


@pytest.fixture(scope="module")
def in_c(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program in C, as a user would build it."""
    gcc = shutil.which("gcc")
    if gcc is None:
        pytest.skip("there is no gcc")
    folder = tmp_path_factory.mktemp("outside")
    (folder / "double.c").write_text(DOUBLE, encoding="utf-8")
    command = [gcc, "-O2", "-Wall", "-Werror", f"-I{RINGS}", "double.c", str(RINGS / "outside.c"), "-o", "double"]
    subprocess.run(command, cwd=folder, check=True)
    return folder / "double"


def mesh(folder: Path, importer: Mapping[str, Any] = IMPORTER, **others: Any) -> Path:  # noqa: ANN401  of any key
    """A pendulum, an importer and a delay."""
    own = others.pop("own", {})
    instances = {
        "pendulum": {"fmu": "DampedPendulum", "start_values": {"a": 1.3, "l": 1.0}, **own},
        "importer": {**importer, **others.pop("of_importer", {}), **own},
        "delay": {"fmu": "TransportDelay", "start_values": {"d": 0.5}, **own},
    }
    simulation = {"algorithm": "gauss_seidel", **others.pop("simulation", {})}
    name = others.pop("name", "with_importer")
    return write_config(folder, instances=instances, connections=LINES, name=name, simulation=simulation, **others)


def program(place: Place, how: str = "", at: int = -1) -> Launched:
    """The program in Python, for the mesh of `mesh`."""
    (place.folder / "program.py").write_text(PROGRAM, encoding="utf-8")
    return place.start_command([sys.executable, "program.py", "with_importer/importer", how, str(at)])


@pytest.mark.parametrize(
    "sections",
    [
        pytest.param({"simulation": {"window": 1}}, id="window 1"),
        pytest.param({"simulation": {"window": 16}}, id="window 16"),
        pytest.param({}, id="window auto"),
        pytest.param({"own": {"group": "together"}}, id="in a group"),
        pytest.param({"of_importer": {"step_size": 0.002}}, id="two rates"),
        pytest.param({"simulation": {"algorithm": "jacobi"}}, id="jacobi"),
    ],
)
@pytest.mark.parametrize("language", ["c", "python"])
def test_program_gives_the_floats_of_a_component(
    place: Place, in_c: Path, language: str, sections: Mapping[str, Any]
) -> None:
    (place.folder / "doubler.py").write_text(COMPONENT, encoding="utf-8")
    expected = mesh(place.folder, {"python": "doubler.py:Doubler"}, name="with_component", **sections)
    assert place.run("launch", expected).wait() == 0
    launched = place.start("launch", config := mesh(place.folder, **sections))

    own = place.start_command([str(in_c), "with_importer/importer"]) if language == "c" else program(place)

    assert launched.wait() == 0, launched.errors
    assert own.wait() == 0, own.errors
    assert "1000" in own.output
    assert config.with_suffix(".csv").read_bytes() == expected.with_suffix(".csv").read_bytes()
    place.assert_nothing_left(2.0)


def test_every_type_reaches_the_program_and_comes_back(place: Place) -> None:
    values = {"Int32": -7, "UInt64": 5, "Boolean": True, "Float32": 0.25, "String": "grüß", "Int8": [1, -2]}
    variables = {
        name: {"type": name, **({"shape": [2]} if isinstance(value, list) else {})} for name, value in values.items()
    }
    kinds = {
        "inputs": {f"in_{name}": {**own, "start": values[name]} for name, own in variables.items()},
        "outputs": {f"out_{name}": own for name, own in variables.items()},
    }
    config = write_config(
        place.folder,
        instances={"importer": {"outside": kinds}},
        connections=(),
        stop_time=0.005,
        record={"file": "pair.csv", "variables": [f"importer.out_{name}" for name in values]},
    )
    (place.folder / "echo.py").write_text(
        "import fmu_mesh\nwith fmu_mesh.attach_as('pair/importer', timeout=30.0) as me:\n"
        "    for name in [n for n in me.names if n.startswith('in_')]:\n"
        "        me.set(name.replace('in_', 'out_'), me.get(name))\n    while me.step():\n        pass\n",
        encoding="utf-8",
    )
    launched = place.start("launch", config)

    echo = place.start_command([sys.executable, "echo.py"])

    assert launched.wait() == 0, launched.errors
    assert echo.wait() == 0, echo.errors
    rows = config.with_suffix(".csv").read_text(encoding="utf-8").splitlines()
    named = dict(zip(rows[0].split(","), rows[1].split(","), strict=True))
    assert named["importer.out_Int32"] == "-7"
    assert named["importer.out_String"] == '"grüß"'
    assert named["importer.out_Int8[2]"] == "-2"
    assert rows[1].partition(",")[2] == rows[-1].partition(",")[2]


def test_program_that_waits_for_longer_than_a_deadline_ends_nothing(place: Place) -> None:
    place.environment = {**place.environment, "NAP": "8"}
    launched = place.start("launch", mesh(place.folder, timeouts={"step": 0.5}))
    own = program(place, "wait", 100)
    wait_until(lambda: "here" in own.output, "the wait of the program")

    status = place.run("status", "with_importer/importer", "--json")

    assert f"waiting at point 99 for its program (process {own.pid}) since " in status.output
    assert launched.wait() == 0, launched.errors
    assert own.wait() == 0


def test_killed_program_ends_the_run_with_its_name(place: Place) -> None:
    place.environment = {**place.environment, "NAP": "60"}
    launched = place.start("launch", config := mesh(place.folder, stop_time=1e6))
    own = program(place, "wait", 200)
    wait_until(lambda: "here" in own.output, "the wait of the program")

    own.signal(signal.SIGKILL)

    assert launched.wait() == 3
    assert launched.ended_after_s < on_a_busy_machine(2.0)
    assert f"its program (process {own.pid}) has ended without `outside_detach`" in launched.message
    assert "instance importer, point 199" in launched.message
    assert row_count(config.with_suffix(".csv")) >= 199
    place.assert_nothing_left(2.0)


@pytest.mark.parametrize(("victim", "code"), [("importer", 4), ("master", 4)])
def test_killed_process_of_the_mesh_ends_the_wait(place: Place, victim: str, code: int) -> None:
    launched = place.start("launch", config := mesh(place.folder, stop_time=1e6))
    own = program(place)
    wait_until(lambda: row_count(config.with_suffix(".csv")) > 500, "rows")

    launched.child(victim).kill()

    assert launched.wait() == code
    own.wait(20.0)
    assert own.ended_after_s < on_a_busy_machine(2.0)


def test_stop_reaches_a_mesh_whose_program_waits(place: Place) -> None:
    place.environment = {**place.environment, "NAP": "60"}
    launched = place.start("launch", mesh(place.folder, stop_time=1e6))
    own = program(place, "wait", 200)
    wait_until(lambda: "here" in own.output, "the wait of the program")

    launched.signal(signal.SIGINT)

    assert launched.wait() == 130
    assert launched.ended_after_s < on_a_busy_machine(2.0)


def test_program_that_detaches_ends_the_run_at_its_point(place: Place) -> None:
    launched = place.start("launch", config := mesh(place.folder, stop_time=1e6))

    own = program(place, "detach", 200)

    assert own.wait() == 0
    assert launched.wait() == 0, launched.errors
    assert row_count(config.with_suffix(".csv")) == 201


def test_second_program_and_unknown_instance_are_refused(place: Place) -> None:
    place.environment = {**place.environment, "NAP": "60"}
    launched = place.start("launch", mesh(place.folder, stop_time=1e6))
    own = program(place, "wait", 100)
    wait_until(lambda: "here" in own.output, "the wait of the program")
    command = "import sys, fmu_mesh\nfmu_mesh.attach_as(sys.argv[1], timeout=0.1)"

    for address in ("with_importer/importer", "with_importer/nobody", "nonsense"):
        other = place.start_command([sys.executable, "-c", command, address])
        assert other.wait() == 1
        assert f"'{address}'" in other.errors

    launched.signal(signal.SIGINT)
    launched.wait()


def test_mesh_without_a_program_says_what_it_waited_for(place: Place) -> None:
    launched = place.run("launch", mesh(place.folder, timeouts={"initialize": 1.0}))

    assert launched.wait() == 3
    assert "no program has attached within 0.9 s (`timeouts.initialize`: 1 s)" in launched.message
    assert "instance importer" in launched.message
    place.assert_nothing_left(2.0)
