"""The part of `simulation_interfaces` 2.1 that a mesh offers: fields and numbers, which every peer has to have alike.

They are those of https://github.com/ros-simulation/simulation_interfaces (Robotec.ai and others, Apache-2.0), which
`rosbags` does not contain; what they mean is written there. Defaults and constants are no part of a type hash.
"""

from __future__ import annotations

from enum import IntEnum

from .definitions import MessageTypes

__all__ = [
    "SIMULATION_SERVICES",
    "ResultCode",
    "SimulationStates",
    "SimulatorFeature",
    "define_simulation_types",
]

_MESSAGES = {
    "Result": "uint8 result\nstring error_message\n",
    "SimulationState": "uint8 state\n",
    "SimulatorFeatures": "uint16[] features\nstring[] spawn_formats\nstring custom_info\n",
    "EntityCategory": "uint8 category\n",
    "TagsFilter": "string[] tags\nuint8 filter_mode\n",
    "Bounds": "uint8 type\ngeometry_msgs/Vector3[] points\n",
    "EntityFilters": "string filter\nEntityCategory[] categories\nTagsFilter tags\nBounds bounds\n",
    "EntityState": "std_msgs/Header header\ngeometry_msgs/Pose pose\ngeometry_msgs/Twist twist\n"
    "geometry_msgs/Accel acceleration\n",
}

SIMULATION_SERVICES = {
    "GetSimulatorFeatures": ("", "SimulatorFeatures features\n"),
    "GetSimulationState": ("", "SimulationState state\nResult result\n"),
    "SetSimulationState": ("SimulationState state\n", "Result result\n"),
    "StepSimulation": ("uint64 steps\n", "Result result\n"),
    "ResetSimulation": ("uint8 scope\n", "Result result\n"),
    "GetEntities": ("EntityFilters filters\n", "Result result\nstring[] entities\n"),
    "GetEntityState": ("string entity\n", "Result result\nEntityState state\n"),
    "SetEntityState": (
        "string entity\nEntityState state\nbool set_pose\nbool set_twist\nbool set_acceleration\n",
        "Result result\n",
    ),
}
"""Request and response of each service."""


class ResultCode(IntEnum):
    """Codes in a `Result`; those above 100 belong to `SetSimulationState`, and the last one to `SetEntityState`."""

    FEATURE_UNSUPPORTED = 0
    OK = 1
    NOT_FOUND = 2
    OPERATION_FAILED = 4
    ALREADY_IN_TARGET_STATE = 101
    STATE_TRANSITION_ERROR = 102
    INCORRECT_TRANSITION = 103
    INVALID_POSE = 101


class SimulationStates(IntEnum):
    """States in a `SimulationState`."""

    STOPPED = 0
    PLAYING = 1
    PAUSED = 2
    QUITTING = 3
    LOADING_WORLD = 5


class SimulatorFeature(IntEnum):
    """The numbers in `SimulatorFeatures` of what a mesh can do."""

    ENTITY_STATE_GETTING = 10
    ENTITY_STATE_SETTING = 11
    SIMULATION_RESET = 20
    SIMULATION_STATE_GETTING = 24
    SIMULATION_STATE_SETTING = 25
    SIMULATION_STATE_PAUSE = 26
    STEP_SIMULATION_SINGLE = 31
    STEP_SIMULATION_MULTIPLE = 32
    STEP_SIMULATION_ACTION = 33


def define_simulation_types(types: MessageTypes) -> None:
    """Add the types.

    Raises:
        ConfigurationError: one of these names has another definition already.
    """
    for name, text in _MESSAGES.items():
        types.define(f"simulation_interfaces/msg/{name}", text)
    for name, (request, response) in SIMULATION_SERVICES.items():
        types.define_service(f"simulation_interfaces/srv/{name}", request, response)
