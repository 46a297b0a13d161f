"""A world in the hands of a test: the instance with rings of its own, one row per step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from fmu_mesh.instances.mujoco.mujoco_instance import MujocoInstance
from fmu_mesh.instances.mujoco.mujoco_section import MujocoConfig
from fmu_mesh.instances.mujoco.rendering import Picture
from fmu_mesh.rings.ring import Ring
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.layout import Layout

__all__ = ["Driven", "body", "slider", "write_world"]

ROWS = 4


def write_world(folder: Path, content: str, options: str = "", rest: str = "") -> Path:
    """A model file with ``content`` as its world, without gravity and contacts."""
    path = folder / "world.xml"
    path.write_text(
        "<mujoco model='test'><option gravity='0 0 0' timestep='0.001' integrator='Euler'>"
        f"<flag contact='disable' eulerdamp='disable' {options}/></option>"
        f"<worldbody>{content}</worldbody>{rest}</mujoco>",
        encoding="utf-8",
    )
    return path


def body(name: str = "cube", inertial: str = "pos='0 0 0' mass='2' diaginertia='1 1 1'", pose: str = "") -> str:
    """A free body."""
    return f"<body name='{name}' {pose}><freejoint/><inertial {inertial}/></body>"


def slider(joint: str = "axis='1 0 0'") -> str:
    """A body of 2 kg on a prismatic joint `slide`."""
    return (
        f"<body name='sledge'><joint name='slide' type='slide' {joint}/>"
        "<inertial pos='0 0 0' mass='2' diaginertia='1 1 1'/></body>"
    )


class Driven:
    """One instance that is stepped by a test.

    Args:
        path: the model file.
        inputs: the connected inputs.
        outputs: the outputs to read.
        config: the rest of its section.
        start_values: by name.
        step_size: own step in s.
        last_step: the last own step.
        picture: a film, if it is to be shown.
    """

    def __init__(
        self,
        path: Path,
        inputs: Sequence[str] = (),
        outputs: Sequence[str] = (),
        *,
        config: MujocoConfig | None = None,
        start_values: Mapping[str, float | list[float]] | None = None,
        step_size: float = 0.001,
        last_step: int = 1000,
        picture: Picture | None = None,
    ) -> None:
        self.messages: list[str] = []
        self.instance = MujocoInstance(
            path,
            "world",
            config or MujocoConfig(mujoco="world.xml"),
            lambda message: self.messages.append(message.message),
            picture,
        )
        self.inputs = Ring(Layout.of([(name, "Float64") for name in inputs]), ROWS)
        self.outputs = Ring(Layout.of([(name, "Float64") for name in outputs]), ROWS)
        self.grid = TimeGrid(0.0, step_size, last_step)
        self.step = 0
        self.instance.enter_initialization(0.0, self.grid.stop_time, start_values or {})
        self.instance.exit_initialization()
        self.instance.bind(self.inputs, (self.outputs,), self.grid, 1)

    def go(self, steps: int = 1, /, **values: float) -> dict[str, float]:
        """Take steps with these inputs (`_` stands for a dot), all others 0; the outputs after the last."""
        given = {name: values.get(name.replace(".", "_"), 0.0) for name in self.inputs.layout.names}
        assert len(values) == sum(name.replace(".", "_") in values for name in given)
        for _ in range(steps):
            self.inputs.part("Float64")[self.step & self.inputs.mask] = list(given.values())
            self.instance.do_step(self.step)
            self.step += 1
        return self.read()

    def read(self) -> dict[str, float]:
        """The outputs of the last point."""
        row = self.outputs.part("Float64")[self.step & self.outputs.mask].tolist()
        return dict(zip(self.outputs.layout.names, row, strict=True))
