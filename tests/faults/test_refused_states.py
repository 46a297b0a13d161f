"""States that are not used: damaged files, those of another mesh, and instances that cannot write one."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

import fmu_mesh
from fmu_mesh.errors import CallRefused, ConfigurationError, FmuError
from fmu_mesh.run.state_file import StateFile
from tests.fmus.packing import repacked
from tests.helpers import FMUS, write_config

INSTANCES: Mapping[str, Mapping[str, Any]] = {
    "pendulum": {"fmu": "DampedPendulum"},
    "delay": {"fmu": "TransportDelay", "start_values": {"d": 0.1}},
    "gain": {"fmu": "Gain", "start_values": {"k": 2.0}},
}
CONNECTIONS = ("pendulum.a -> delay.x", "delay.y -> gain.u")


@pytest.fixture(scope="module")
def state(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The state of a mesh at point 10."""
    folder = tmp_path_factory.mktemp("state")
    with mesh_of(folder).open() as system:
        system.step(10)
        assert system.save(folder / "a.state").point == 10
    return folder / "a.state"


def mesh_of(
    folder: Path,
    instances: Mapping[str, Mapping[str, Any]] = INSTANCES,
    connections: tuple[str, ...] = CONNECTIONS,
    **sections: Any,  # noqa: ANN401  those of a configuration
) -> fmu_mesh.Mesh:
    return fmu_mesh.load(write_config(folder, instances=instances, connections=connections, **sections))


def test_one_changed_bit_anywhere_is_refused(state: Path, tmp_path: Path) -> None:
    data, drawn, file = state.read_bytes(), random.Random(1), tmp_path / "changed.state"  # noqa: S311  a test
    places = [*range(8 * 60), *(drawn.randrange(8 * len(data)) for _ in range(1500))]
    for place in places:
        changed = bytearray(data)
        changed[place // 8] ^= 1 << place % 8
        file.write_bytes(changed)
        with pytest.raises(ConfigurationError, match=r"is damaged|is no state|has version [0-9]+ of its format"):
            StateFile.read(file)


def test_a_cut_file_and_one_with_more_are_refused(state: Path, tmp_path: Path) -> None:
    data, drawn, file = state.read_bytes(), random.Random(2), tmp_path / "cut.state"  # noqa: S311  a test
    for size in (9, 30, 52, len(data) - 1, *(drawn.randrange(8, len(data)) for _ in range(200))):
        file.write_bytes(data[:size])
        with pytest.raises(ConfigurationError, match="is damaged: it was cut or changed after it was written"):
            StateFile.read(file)
    file.write_bytes(data + b"\0")
    with pytest.raises(ConfigurationError, match="is damaged"):
        StateFile.read(file)


def test_what_is_no_state_is_refused(state: Path, tmp_path: Path) -> None:
    other, mesh = tmp_path / "other.state", mesh_of(tmp_path)
    other.write_text("time,a\n0,1\n")
    with pytest.raises(ConfigurationError, match=r"other\.state' is no state: `System.save` writes such files"):
        mesh.open(state=other)
    other.write_bytes(b"")
    with pytest.raises(ConfigurationError, match="is no state"):
        mesh.open(state=other)
    with pytest.raises(ConfigurationError, match=r"none\.state' cannot be read: No such file"):
        mesh.open(state=tmp_path / "none.state")
    with pytest.raises(ConfigurationError, match="cannot be read"):
        mesh.open(state=tmp_path)
    data = state.read_bytes()
    other.write_bytes(data[:8] + struct.pack("<I", 2) + data[12:])
    with pytest.raises(ConfigurationError, match="has version 2 of its format, and this fmu_mesh reads 1"):
        mesh.open(state=other)


def with_instance(name: str, **changes: Any) -> dict[str, dict[str, Any]]:  # noqa: ANN401  keys of its section
    return {**INSTANCES, name: {**INSTANCES[name], **changes}}  # type: ignore[dict-item]  # mappings


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            {"instances": with_instance("gain", fmu="Integrator", start_values={})},
            "gain: model: [0-9a-f]{16} here, and [0-9a-f]{16} in the state",
        ),
        ({"instances": with_instance("gain", step_size=0.002)}, "gain: step: 2 points here, and 1 point in the state"),
        ({"instances": with_instance("gain", tolerance=1e-9)}, "gain: options: "),
        (
            {"instances": with_instance("pendulum", start_values={"l": 3.0})},
            "'l' is 3.0, was 1.0, and is a fixed",
        ),
        (
            {"instances": with_instance("pendulum", start_values={"a": 0.5})},
            "'a' is 0.5, was .*, and is no input",
        ),
        ({"instances": {**INSTANCES, "more": {"fmu": "Gain"}}}, "more: the state has no such instance"),
        (
            {"instances": {n: INSTANCES[n] for n in ("pendulum", "delay")}, "connections": CONNECTIONS[:1]},
            "gain: the mesh has no such instance",
        ),
        ({"connections": CONNECTIONS[:1]}, "gain: connections: "),
        ({"connections": (CONNECTIONS[0], "pendulum.a -> gain.u")}, "gain: connections: "),
        ({"scenario": {"events": [{"at": 0.5, "set": {"gain.k": 1.0}}]}}, "gain: values over time: "),
        ({"simulation": {"step_size": 0.002}}, "simulation.step_size: was 0.001 s"),
        ({"simulation": {"start_time": 0.5}}, "simulation.start_time: was 0 s"),
        ({"stop_time": 0.005}, "simulation.stop_time: 0.005 s, and the state is of 0.01 s"),
    ],
)
def test_a_state_of_another_mesh_is_refused(change: dict[str, Any], told: str, state: Path, tmp_path: Path) -> None:
    mesh = mesh_of(tmp_path, **change)

    with pytest.raises(ConfigurationError, match=rf"a\.state' is not one of this mesh(.|\n)*{told}"):
        mesh.open(state=state)


def test_another_content_of_an_fmu_is_refused(state: Path, tmp_path: Path) -> None:
    fmu = repacked(tmp_path / "Gain.fmu", source=FMUS / "Gain.fmu", add={"resources/more.txt": b"more"})

    with pytest.raises(ConfigurationError, match=r"instances\.gain: model: [0-9a-f]{16} here, and"):
        mesh_of(tmp_path, with_instance("gain", fmu=str(fmu))).open(state=state)


def test_a_branch_has_other_parameters_and_a_later_end(state: Path, tmp_path: Path) -> None:
    instances = with_instance("gain", start_values={"k": 5.0})
    mesh = mesh_of(
        tmp_path, instances, stop_time=2.0, record={"file": "b.csv", "variables": ["gain.y", "pendulum.der(a)"]}
    )
    with mesh.open(state=state) as system, mesh_of(state.parent).open() as other:
        other.step(10)
        other.set("gain.k", 5.0)
        assert system.get("pendulum.der(a)") == other.get("pendulum.der(a)")
        for _ in range(200):
            assert system.get("gain.y") == other.get("gain.y")
            system.step()
            other.step()
        assert (system.point, system.last_point, other.last_point) == (210, 2000, 1000)


def test_a_state_after_a_reset_has_the_start_values_of_the_reset(tmp_path: Path) -> None:
    file, mesh = tmp_path / "a.state", mesh_of(tmp_path)
    with mesh.open() as system:
        for length in (3.0, 4.0):
            system.reset({"pendulum.l": length})
        system.step(5)
        system.save(file)
        system.step(5)
        expected = system.get("pendulum.a")

    with pytest.raises(ConfigurationError, match=r"'l' is 1.0, was 4\.0, and is a fixed parameter"):
        mesh.open(state=file)
    with mesh.open({"pendulum.l": 4.0}, state=file) as system:
        system.step(5)
        assert system.get("pendulum.a") == expected
        system.reset()
        assert system.point == 0


COMPONENT = """
import fmu_mesh

class Held(fmu_mesh.Component):
    y = fmu_mesh.Output(start=0.0)

    def __init__(self):
        self.seen = {1, 2}

    def step(self, time, step_size):
        self.y = time
"""


def test_a_component_with_another_attribute_is_named(tmp_path: Path) -> None:
    (tmp_path / "held.py").write_text(COMPONENT)
    mesh = mesh_of(tmp_path, {"held": {"python": "held.py:Held"}}, ())
    with mesh.open() as system:
        system.step()
        words = "instance held: its state cannot be written: it has a set in attribute 'seen'; expected None, bool"
        with pytest.raises(FmuError, match=words):
            system.save(tmp_path / "held.state")
        system.step()  # nothing has changed
    assert not (tmp_path / "held.state").exists()


def test_check_and_save_say_which_instances_have_no_state(tmp_path: Path, event_fmu: Callable[..., Path]) -> None:
    models = {"first": event_fmu("Ball", 1), "stiff": event_fmu("Ball", 2)}
    instances: dict[str, Any] = {n: {"fmu": str(fmu), "kind": "model_exchange"} for n, fmu in models.items()}
    instances["stiff"]["solver"] = {"name": "cvode"}
    mesh = mesh_of(tmp_path, {**INSTANCES, **instances})

    page = mesh.check().page
    told = "stiff: cannot be written: CVode solves it, whose history is no state; use `solver: {name: dopri5}`"
    assert (
        f"  pendulum, delay, gain: can be written\n  first: cannot be written: FMI 1.0 has no states\n  {told}" in page
    )
    assert [bool(own.stateless) for own in mesh.check().plan.instances] == [False, False, False, True, True]  # type: ignore[union-attr]  # it can run
    del instances["first"]
    with mesh_of(tmp_path, instances, ()).open() as system:
        system.save()  # in memory it has one
        with pytest.raises(CallRefused, match="instance stiff: its state cannot be written to a file: CVode solves it"):
            system.save(tmp_path / "stiff.state")


def test_a_file_that_cannot_be_written_leaves_the_older_one(tmp_path: Path) -> None:
    with mesh_of(tmp_path).open() as system:
        with pytest.raises(ConfigurationError, match=r"none/a\.state' cannot be written: No such file or directory"):
            system.save(tmp_path / "none" / "a.state")
        with pytest.raises(CallRefused, match="`file=3`: expected the name of a file"):
            system.save(3)  # type: ignore[arg-type]  # this is the test
        system.save(str(tmp_path / "a.state"))
        system.step()
    assert StateFile.read(tmp_path / "a.state").head.point == 0
    assert [path.name for path in tmp_path.glob("*.state")] == ["a.state"]
