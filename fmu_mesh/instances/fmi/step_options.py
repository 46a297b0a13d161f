"""How an FMU is loaded and its steps are taken, as its section of the configuration and its model description say."""

from __future__ import annotations

from typing import Final, Literal

import msgspec

from ...config.mesh import LimitsConfig, TimeoutsConfig
from ...system.linear_inputs import LinearInput

__all__ = ["NO_STATE_OF_CVODE", "SolverName", "SolverSettings", "StepOptions", "Terms"]

SolverName = Literal["auto", "dopri5", "cvode", "euler"]

NO_STATE_OF_CVODE: Final = "CVode solves it, whose history is no state; use `solver: {name: dopri5}`"
"""Why a state cannot outlive its process, as the end of a sentence."""


class Terms(msgspec.Struct, frozen=True):
    """The conditions that an FMU must meet before it is used."""

    limits: LimitsConfig = LimitsConfig()
    sha256: str | None = None  # the SHA-256 that the configuration asks for, in hexadecimal digits
    content: str | None = None  # what `content_of` returned when the run was planned


class SolverSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the continuous states of a model-exchange FMU are solved."""

    name: SolverName = "auto"
    # bound of the local error. The absolute tolerance of a state is this times its nominal value.
    relative_tolerance: float = 1e-6
    maximum_step_size: float | None = None  # in s; None: at most the communication step.


class StepOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How one instance is loaded and stepped. The configuration has been checked against what its FMU can do."""

    solver: SolverSettings = SolverSettings()  # of a model-exchange FMU
    tolerance: float | None = None  # relative tolerance for a co-simulation FMU; None: that of its default experiment.
    retry_discarded_steps: bool = False  # whether a step that the FMU discards is repeated in smaller steps
    linear_inputs: tuple[LinearInput, ...] = ()  # the inputs whose connections are extrapolated
    deep_binding: bool = True  # whether the library finds its own functions and variables before those of the process
    timeouts: TimeoutsConfig = TimeoutsConfig()  # how long its calls may take, if it runs in WebAssembly
