"""Worlds of the simulator Gazebo classic 11 as a kind of instances."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from ... import files
from ...config.base import Base
from ...config.instance_sections import (
    KIND,
    Actuators,
    Controllers,
    FluidDynamics,
    Group,
    Host,
    PhysicsSection,
    StartValues,
    StepSize,
)
from ...config.mesh import LimitsConfig
from ...variables.model_description import ModelDescription
from ..contract import Instance, Kind, Opening

__all__ = ["KIND_OF_GAZEBO_CLASSIC", "GazeboClassicConfig"]


class GazeboClassicConfig(Base, PhysicsSection, frozen=True, kw_only=True, tag_field=KIND, tag="gazebo_classic"):
    """A world that the simulator Gazebo classic 11 computes: its joints and links are variables."""

    gazebo_classic: Annotated[str, Meta(description="Path of the SDF world, relative to this file.")]
    physics_steps: Annotated[
        Annotated[int, Meta(ge=1)] | None,
        Meta(
            description="Steps of the engine per own step; default: as few as make none longer than the world's "
            "max_step_size.",
        ),
    ] = None
    controllers: Controllers = []
    actuators: Actuators = []
    fluid_dynamics: FluidDynamics = []
    start_values: StartValues = {}
    step_size: StepSize = None
    group: Group = None
    host: Host = None


class GazeboClassicKind(Kind[GazeboClassicConfig]):
    """Worlds that Gazebo classic computes, in a process of its own."""

    section = GazeboClassicConfig
    expected = "an SDF world for Gazebo classic 11"

    def describe(
        self,
        path: Path,
        section: GazeboClassicConfig,
        limits: LimitsConfig,  # noqa: ARG002  for FMUs
        tell: Callable[[str], None],  # noqa: ARG002  reading a world is fast
    ) -> ModelDescription:
        """Read the world; its joints and links are the variables. Gazebo is not needed for that."""
        from .gazebo_world import describe_gazebo_world  # noqa: PLC0415  only where there is a world

        return describe_gazebo_world(path, section)

    def content(self, path: Path) -> str:
        """The SHA-256 of the file: nothing else is read, see `fmu_mesh.instances.gazebo.gazebo_world`."""
        return files.sha256_of(path)

    def check_engine(self) -> None:
        """Check that Gazebo classic runs on this host."""
        from .gazebo_classic import check_gazebo_classic  # noqa: PLC0415  as above

        check_gazebo_classic()

    def open(self, opening: Opening[GazeboClassicConfig]) -> Instance:
        """Start Gazebo with the world."""
        from .gazebo_classic import GazeboClassicInstance  # noqa: PLC0415  as above

        return GazeboClassicInstance(opening.path, opening.name, opening.section)


KIND_OF_GAZEBO_CLASSIC = GazeboClassicKind()
"""What the entry point `gazebo_classic` names."""
