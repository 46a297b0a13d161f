"""`examples/gazebo` against a real mesh, with a stand-in for Gazebo's own modules, which cannot be installed here."""

from __future__ import annotations

import importlib
import re
import socket
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from tests.fmus.harness import Unit
from tests.fmus.helpers import extracted_fmu
from tests.helpers import Place

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "gazebo"
STEP_SIZE = 1e-3


class Arm:
    """What Gazebo does with the joint: a moment of inertia of 1.001 kg m2 with a damping of 0.1 N m s/rad."""

    def __init__(self) -> None:
        self.position = self.velocity = self.force = 0.0

    def step(self) -> None:
        self.velocity += STEP_SIZE * (self.force - 0.1 * self.velocity) / 1.001
        self.position += STEP_SIZE * self.velocity


class Joint:
    """`gz.sim8.Joint` as far as the example uses it; the entity is the arm."""

    def __init__(self, arm: Arm | None) -> None:
        self._arm = arm
        self._reports: set[str] = set()

    def valid(self, _ecm: object) -> bool:
        return self._arm is not None

    def enable_position_check(self, _ecm: object) -> None:
        self._reports.add("position")

    def enable_velocity_check(self, _ecm: object) -> None:
        self._reports.add("velocity")

    def position(self, _ecm: object) -> list[float] | None:
        assert self._arm is not None
        return [self._arm.position] if "position" in self._reports else None

    def velocity(self, _ecm: object) -> list[float] | None:
        assert self._arm is not None
        return [self._arm.velocity] if "velocity" in self._reports else None

    def set_force(self, _ecm: object, forces: list[float]) -> None:
        assert self._arm is not None
        (self._arm.force,) = forces


class Sdf:
    """The plugin's element in the world file, with where the mesh really is."""

    def __init__(self, connect: str) -> None:
        plugin = ET.parse(EXAMPLE / "actuator.sdf").find(".//model/plugin")  # noqa: S314  our own file
        assert plugin is not None
        self._values = {child.tag: str(child.text) for child in plugin} | {"connect": connect}

    def get_string(self, key: str) -> str:
        return self._values[key]

    def get_double(self, key: str) -> float:
        return float(self._values[key])


@pytest.fixture
def arm() -> Arm:
    return Arm()


@pytest.fixture
def example(arm: Arm, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The example's module, imported as Gazebo does it."""
    model = SimpleNamespace(joint_by_name=lambda _ecm, name: arm if name == "joint" else None)
    modules: dict[str, Any] = {"gz": ModuleType("gz"), "gz.sim8": ModuleType("gz.sim8")}
    modules["gz.sim8"].Joint, modules["gz.sim8"].Model = Joint, lambda _entity: model
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.syspath_prepend(str(EXAMPLE))
    yield importlib.import_module("mesh_actuator")
    for name in ("mesh_actuator", "mesh_client"):
        del sys.modules[name]


@pytest.fixture
def endpoint(place: Place) -> Iterator[str]:
    """Where the example's mesh runs."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    text = (EXAMPLE / "actuator.yaml").read_text(encoding="utf-8").replace("tcp/127.0.0.1:7447", address)
    config = place.folder / "actuator.yaml"
    config.write_text(text.replace("../../", f"{EXAMPLE.parents[1]}/"), encoding="utf-8")
    launched = place.start("launch", config, "--output", place.folder / "result.csv")
    launched.wait_for_error_line(f"' at {address}")  # and not that of the warning
    yield address
    launched.close()


def test_the_system_drives_the_joint_by_the_actuator_in_every_float(
    example: ModuleType, arm: Arm, endpoint: str, tmp_path: Path
) -> None:
    system = example.get_system()
    system.configure(1, Sdf(endpoint), None, None)
    first = system._mesh.point
    forces = []
    for _ in range(50):
        system.pre_update(SimpleNamespace(paused=True), None)
        system.pre_update(SimpleNamespace(paused=False), None)
        forces.append(arm.force)
        arm.step()
    last = system._mesh.point
    system._mesh.stop()
    system._mesh.close()

    assert last - first == 50
    assert forces == expected_forces(tmp_path)
    assert arm.position > 1e-4


def expected_forces(folder: Path) -> list[float]:
    """The same loop around the FMU alone."""
    arm, forces = Arm(), []
    with Unit(extracted_fmu("SimpleElectricalActuator", folder)) as unit:
        unit.start()
        for point in range(50):
            unit.set("actuatorInput", 10.0 * (1.0 - arm.position) - 3.0 * arm.velocity)
            unit.set("jointPosition", arm.position)
            unit.set("jointVelocity", arm.velocity)
            unit.step(point * STEP_SIZE, STEP_SIZE)
            arm.force = unit.real("jointTorque")
            forces.append(arm.force)
            arm.step()
    return forces


def test_a_joint_that_is_not_there_is_named(example: ModuleType) -> None:
    sdf = Sdf("tcp/127.0.0.1:1")
    sdf._values["joint"] = "elbow"

    with pytest.raises(ValueError, match="the model has no joint 'elbow'"):
        example.get_system().configure(1, sdf, None, None)


def test_the_commands_of_the_page_name_files_that_are_there() -> None:
    page = (EXAMPLE / "README.md").read_text(encoding="utf-8")

    assert all((EXAMPLE.parents[1] / name).exists() for name in re.findall(r"examples/gazebo/\S+\.\w+", page))
