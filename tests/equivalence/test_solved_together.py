"""A group that is solved gives the same floats in processes, in one process, in copies, and step by step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

import fmu_mesh
from fmu_mesh.rings.library import LIBRARY_VARIABLE
from fmu_mesh.run.options import PlanOptions
from tests.helpers import Place, write_config
from tests.plain_run import PlainRun
from tests.planning import prepare
from tests.solved_systems import driven_masses

GROUPS: Mapping[str, Mapping[str, Any]] = {
    "one step": {},
    "step control": {"step_control": {"tolerance": 1e-3}},
}
SIMULATION = {"step_size": 0.01}
both = pytest.mark.parametrize("name", GROUPS)


@pytest.fixture
def written(event_fmu: Callable[..., Path]) -> Callable[..., Path]:
    """Writes the configuration of the driven masses into a folder."""

    def write(folder: Path, name: str, **simulation: Any) -> Path:  # noqa: ANN401  keys of the section
        content = driven_masses(event_fmu("LinearPart", 2), folder, **GROUPS[name])
        return write_config(folder, name="driven", **content, simulation={**SIMULATION, **simulation})

    return write


def plain(config: Path) -> bytes:
    """The result of the plainest run."""
    output = config.with_name("plain.csv")
    PlainRun(prepare(config, PlanOptions(output=output))).run()
    return output.read_bytes()


@both
def test_one_process_gives_the_floats_of_the_plainest_run(
    written: Callable[..., Path], tmp_path: Path, name: str
) -> None:
    config = written(tmp_path, name)

    result = fmu_mesh.load(config).run(processes=False)

    assert config.with_suffix(".csv").read_bytes() == plain(config)
    assert len(result.times) == 101
    assert abs(result["two.y"]).max() > 1.0


@both
@pytest.mark.parametrize("window", [1, 16, "auto"])
def test_processes_give_the_floats_of_the_plainest_run(
    place: Place, written: Callable[..., Path], name: str, window: int | str
) -> None:
    config = written(place.folder, name, window=window)

    launched = place.run("launch", config, "--no-progress")

    assert launched.wait() == 0, launched.story()
    assert config.with_suffix(".csv").read_bytes() == plain(config)


def test_processes_without_the_library_give_the_same_floats(place: Place, written: Callable[..., Path]) -> None:
    config = written(place.folder, "step control")
    place.environment[LIBRARY_VARIABLE] = "none"

    launched = place.run("launch", config, "--no-progress")

    # The library has the solver of the plain run, so the floats of that are others.
    local = place.run("launch", config, "--no-progress", "--local", "--output", place.folder / "local.csv")
    assert [launched.wait(), local.wait()] == [0, 0], launched.story()
    assert config.with_suffix(".csv").read_bytes() == (place.folder / "local.csv").read_bytes()


def test_a_value_sent_with_a_time_to_the_second_member_is_used(written: Callable[..., Path], tmp_path: Path) -> None:
    """From the first such value on, the member follows times, while the first member takes its steps."""
    mesh = fmu_mesh.load(written(tmp_path, "one step"))
    with mesh.start(paused=True, output=tmp_path / "sent.csv") as run:
        run.set("two.free", 40.0, at=0.5)
        run.resume()
        sent = run.wait()

    without = mesh.run(processes=False, record="memory")
    mesh.scenario(events=[{"at": 0.5, "set": {"two.free": 40.0}}])
    prescribed = mesh.run(processes=False, record="memory")
    assert [name for name in sent if sent[name].tobytes() != prescribed[name].tobytes()] == []
    assert (sent["two.x"] == without["two.x"]).sum() == 51


@both
def test_copies_give_the_floats_of_a_system(written: Callable[..., Path], tmp_path: Path, name: str) -> None:
    mesh = fmu_mesh.load(written(tmp_path, name))
    names = ["one.x", "two.y", "back.y"]

    with mesh.batch(2, processes=1) as batch, mesh.open() as system:
        for _ in range(60):
            batch.step()
            system.step()
            assert [batch.get(one).tolist() for one in names] == [[system.get(one)] * 2 for one in names]


@both
def test_restored_and_written_states_go_on_with_the_same_floats(
    written: Callable[..., Path], tmp_path: Path, name: str
) -> None:
    mesh = fmu_mesh.load(written(tmp_path, name))
    names, file = ["one.x", "one.v", "two.y", "back.y"], tmp_path / "a.state"

    with mesh.open() as system:
        system.step(25)
        state = system.save()
        system.save(file)
        rows = []
        for _ in range(30):
            system.step()
            rows.append([system.get(one) for one in names])
        system.restore(state)
        for row in rows:
            system.step()
            assert [system.get(one) for one in names] == row
    with mesh.open(state=file) as system:
        for row in rows:
            system.step()
            assert [system.get(one) for one in names] == row
    result = mesh.run(processes=False, state=file, record="memory")
    assert [result[one][1 + number] for number in (0, 7, 29) for one in names] == [
        one for number in (0, 7, 29) for one in rows[number]
    ]


ARRAYS = """
import fmu_mesh


class Pair(fmu_mesh.Component):
    u = fmu_mesh.Input([0.0, 0.0], shape=2)
    e = fmu_mesh.Input([0.0, 0.0, 7.0], shape=3)
    y = fmu_mesh.Output([0.0, 0.0], shape=2, depends_on=("u", "e"))

    def initialize(self):
        self.x = [1.0, -1.0]
        self.tell()

    def tell(self):
        self.y = [x - 0.5 * u + 0.1 * e + 0.01 * self.e[2] for x, u, e in zip(self.x, self.u, self.e)]

    def step(self, time, step_size):
        self.x = [x + step_size * (u - x) for x, u in zip(self.x, self.u)]
        self.tell()
"""


def test_arrays_and_their_elements_are_solved(place: Place) -> None:
    (place.folder / "parts.py").write_text(ARRAYS, encoding="utf-8")
    config = write_config(
        place.folder,
        instances={
            "a": {"python": "parts.py:Pair", "group": {"name": "g", "solve": "newton"}},
            "b": {"python": "parts.py:Pair", "group": "g"},
        },
        connections=["a.y -> b.u", "b.y -> a.u", "a.y[2] -> b.e[1]", "b.y[1] -> a.e[2]"],
        simulation=SIMULATION,
    )

    launched = place.run("launch", config, "--no-progress")

    assert launched.wait() == 0, launched.story()
    assert config.with_suffix(".csv").read_bytes() == plain(config)
    # Both are linear: with their direct dependences, two tries give the values of both ends.
    assert "the group 'g' took 100 steps and 200 tries for 100 points" in launched.errors
