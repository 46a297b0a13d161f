"""The section of a MuJoCo world in a configuration."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from ...config.base import Base
from ...config.instance_sections import (
    KIND,
    Actuators,
    Controllers,
    ExtrapolationOfInputs,
    Feedthrough,
    FluidDynamics,
    Group,
    Host,
    Inputs,
    NotFinitePolicy,
    OnFailure,
    PhysicsSection,
    Process,
    StartValues,
    StepSize,
)

__all__ = ["MujocoConfig"]


class MujocoConfig(Base, PhysicsSection, frozen=True, kw_only=True, tag_field=KIND, tag="mujoco"):
    """A world that the physics engine MuJoCo computes: its joints and bodies are variables."""

    mujoco: Annotated[str, Meta(description="Path of the model (MJCF or URDF), relative to this file.")]
    physics_steps: Annotated[
        Annotated[int, Meta(ge=1)] | None,
        Meta(
            description="Steps of the engine per own step; default: as few as make none longer than the model's "
            "timestep.",
        ),
    ] = None
    keyframe: Annotated[str | None, Meta(description="The model's keyframe to start from.")] = None
    controllers: Controllers = []
    actuators: Actuators = []
    fluid_dynamics: FluidDynamics = []
    start_values: StartValues = {}
    inputs: Inputs = {}
    step_size: StepSize = None
    group: Group = None
    host: Host = None
    not_finite: NotFinitePolicy = None
    on_failure: OnFailure = "stop"
    process: Process = None
    extrapolation: ExtrapolationOfInputs = None
    feedthrough: Feedthrough = None
