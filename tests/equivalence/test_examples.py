"""The examples and the page about the library show what is true: the floats of a plain loop, and of the mesh."""

from __future__ import annotations

import csv
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from threading import Event

import fmpy
import pytest
from fmpy.fmi2 import FMU2Slave

from examples import integrated_node
from fmu_mesh import FMIAdapter
from fmu_mesh.run.options import PlanOptions
from tests.plain_run import PlainRun
from tests.planning import prepare

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "configs" / "chapter_library_example.yaml"

Rows = list[tuple[float, ...]]


@pytest.fixture(scope="module")
def example() -> Rows:
    return [*integrated_node.run()]


def rows_of(path: Path) -> Rows:
    with path.open(newline="") as file:
        return [tuple(map(float, row)) for row in list(csv.reader(file))[1:]]


def local_rows(config: Path, output: Path) -> Rows:
    """The result of a configuration that runs in this process."""
    PlainRun(prepare(config, PlanOptions(output=output))).run()
    return rows_of(output)


def jacobi_config(folder: Path) -> Path:
    """The chapter's configuration with the other algorithm."""
    text = CONFIG.read_text(encoding="utf-8").replace("algorithm: gauss_seidel", "algorithm: jacobi")
    path = folder / CONFIG.name
    path.write_text(text.replace("../fmus", f"{ROOT}/fmus"), encoding="utf-8")
    return path


@pytest.fixture
def fmpy_pair(tmp_path: Path) -> Iterator[tuple[FMU2Slave, dict[str, int], FMU2Slave, dict[str, int]]]:
    """Pendulum and delay with their value references, loaded by FMPy alone and in Initialization Mode."""
    loaded = []
    for name, start_values in (("DampedPendulum", {"a": 1.3, "l": 2.0, "d": 0.001}), ("TransportDelay", {"d": 5.5})):
        folder = fmpy.extract(str(ROOT / "fmus" / f"{name}.fmu"), unzipdir=str(tmp_path / name))
        description = fmpy.read_model_description(folder)
        fmu = FMU2Slave(
            guid=description.guid,
            unzipDirectory=folder,
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName=name,
        )
        references = {variable.name: variable.valueReference for variable in description.modelVariables}
        fmu.instantiate()
        fmu.setupExperiment(startTime=0.0)
        fmu.setReal([references[variable] for variable in start_values], list(start_values.values()))
        fmu.enterInitializationMode()
        loaded += [fmu, references]
    pendulum, pendulum_references, delay, delay_references = loaded
    yield pendulum, pendulum_references, delay, delay_references
    for fmu in (pendulum, delay):
        fmu.terminate()
        fmu.freeInstance()


def test_the_integrated_node_equals_a_plain_fmpy_loop_in_every_float(
    example: Rows, fmpy_pair: tuple[FMU2Slave, dict[str, int], FMU2Slave, dict[str, int]]
) -> None:
    pendulum, pendulum_references, delay, delay_references = fmpy_pair
    a, x, y = pendulum_references["a"], delay_references["x"], delay_references["y"]
    delay.setReal([x], pendulum.getReal([a]))
    pendulum.exitInitializationMode()
    delay.exitInitializationMode()
    rows = [(0.0, pendulum.getReal([a])[0], delay.getReal([y])[0])]
    for k in range(3000):
        pendulum.doStep(currentCommunicationPoint=k * 0.02, communicationStepSize=0.02)
        delay.setReal([x], pendulum.getReal([a]))
        delay.doStep(currentCommunicationPoint=k * 0.02, communicationStepSize=0.02)
        rows.append(((k + 1) * 0.02, pendulum.getReal([a])[0], delay.getReal([y])[0]))

    assert example == rows


def test_the_integrated_node_equals_the_chapter_s_mesh_in_every_float(example: Rows, tmp_path: Path) -> None:
    assert example == local_rows(CONFIG, tmp_path / "local.csv")


def test_the_integrated_node_gives_same_floats_on_a_clock_of_unix_time(example: Rows) -> None:
    assert integrated_node.run(start=1_700_000_000.123) == example


def test_stamps_at_end_of_step_as_in_chapter_s_listing_are_jacobi(tmp_path: Path) -> None:
    rows: Rows = []
    with (
        FMIAdapter(ROOT / "fmus/DampedPendulum.fmu", 0.02) as pendulum,
        FMIAdapter(ROOT / "fmus/TransportDelay.fmu", 0.02) as delay,
    ):
        for name, value in (("d", 0.001), ("l", 2.0), ("a", 1.3)):
            pendulum.set_initial_value(name, value)
        delay.set_initial_value("d", 5.5)
        delay.set_initial_value("x", 1.3)
        pendulum.exit_initialization_mode(0.0)
        delay.exit_initialization_mode(0.0)
        for k in range(3001):
            if k > 0:
                pendulum.do_steps_until(k * 0.02)
                delay.set_input_value("x", k * 0.02, pendulum.get_output_value("a"))
                delay.do_steps_until(k * 0.02)
            rows.append((k * 0.02, float(pendulum.get_output_value("a")), float(delay.get_output_value("y"))))

    assert rows == local_rows(jacobi_config(tmp_path), tmp_path / "local.csv")


def test_the_integrated_node_as_program_prints_end_and_writes_what_it_computed(example: Rows, tmp_path: Path) -> None:
    output = tmp_path / "made" / "result.csv"

    done = subprocess.run(
        [sys.executable, "-W", "error", ROOT / "examples" / "integrated_node.py", "--output", output],
        capture_output=True,
        text=True,
        check=True,
    )

    _, angle, delayed_angle = example[-1]
    assert done.stdout == (
        f"t = 60 s: angle {angle:.6f} rad, delayed angle {delayed_angle:.6f} rad\nResult: {output}\n"
    )
    assert done.stderr == ""
    assert rows_of(output) == example


def test_in_real_time_the_integrated_node_waits_until_a_step_is_due(
    example: Rows, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Clock(Event):
        """A clock on which waiting takes no time, but for what it says."""

        now = 100.0

        def wait(self, timeout: float | None = None) -> bool:
            assert timeout is not None
            self.now += timeout
            return self.is_set()

    clock = Clock()
    monkeypatch.setattr("time.time", lambda: clock.now)

    rows = integrated_node.run(start=100.0, duration=0.4, stop=clock)

    assert rows == example[:21]
    assert clock.now == pytest.approx(100.4, abs=1e-9)  # a sum of 20 differences of floats near 100


def test_in_real_time_a_stopped_integrated_node_keeps_its_rows(example: Rows) -> None:
    stop = Event()
    stop.set()

    assert integrated_node.run(stop=stop) == example[:1]


def test_every_name_on_the_page_about_the_library_exists() -> None:
    page = (ROOT / "docs" / "library.md").read_text(encoding="utf-8")
    table = page[page.index("| C++") : page.index("The same:")]
    cells = [row.split(" | ")[1] for row in table.splitlines()[2:] if row]
    named = {name for cell in cells for name in re.findall(r"`([a-z_]+)(?:\(|`|\.)", cell)} - {"with"}
    public = {name for name in vars(FMIAdapter) if not name.startswith("_")}

    assert named == public
