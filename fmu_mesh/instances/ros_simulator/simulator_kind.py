"""Simulators in ROS 2 as a kind of instances: Gazebo, Isaac Sim, O3DE, or another mesh.

In a configuration: `sim: {ros_simulator: {namespace: /gz, step: 0.001}, topics: [...]}`. `docs/ros-simulation.md` says
what is what.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ...config.mesh import LimitsConfig
from ...variables.model_description import ModelDescription
from ..child_question import check_version
from ..contract import Instance, Kind, Opening
from .simulator_section import RosSimulatorConfig

__all__ = ["KIND_OF_ROS_SIMULATORS"]


class RosSimulatorKind(Kind[RosSimulatorConfig]):
    """Simulators that run already, and are stepped through `simulation_interfaces`."""

    section = RosSimulatorConfig
    expected = "topics of a ROS simulator"

    def describe(
        self, path: Path, section: RosSimulatorConfig, limits: LimitsConfig, tell: Callable[[str], None]
    ) -> ModelDescription:
        """The fields of the topics that the section names are the variables. The simulator is not asked."""
        from .simulator_topics import SimulatorTopics  # noqa: PLC0415  rosbags is an extra, and slow to import

        if section.interpreter is not None:
            check_version(section.interpreter)
        return SimulatorTopics.of(section).description(section.ros_simulator.step)

    def content(self, path: Path) -> str:
        """Empty: there is no file."""
        return ""

    def open(self, opening: Opening[RosSimulatorConfig]) -> Instance:
        """Find the simulator."""
        from .simulator_instance import RosSimulatorInstance  # noqa: PLC0415  as above

        return RosSimulatorInstance(opening)


KIND_OF_ROS_SIMULATORS = RosSimulatorKind()  # what the entry point `ros_simulator` names
