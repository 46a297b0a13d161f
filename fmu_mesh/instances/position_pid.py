"""The position controller of a joint: a PID whose derivative acts on the measured velocity.

``effort = p (target - position) + i ∫ (target - position) dt - d velocity``. Because the target's own jumps are not
differentiated, a new target causes no jump of the effort. The gains are tunable and the target is an input, so both can
be set while a mesh runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, cast

import msgspec
from msgspec import Meta

from ..config.base import Base
from ..config.instance_sections import (
    KIND,
    ExtrapolationOfInputs,
    Feedthrough,
    Group,
    Host,
    Inputs,
    InstanceSection,
    NotFinitePolicy,
    OnFailure,
    StartValues,
    StepSize,
)
from ..config.mesh import LimitsConfig
from ..errors import StepFailed
from ..rings.ring import Ring
from ..simtime import TimeGrid
from ..variables.model_description import Causality, ModelDescription, Value, Variable
from .contract import Instance, KeepsStateAsBytes, Kind, Opening

__all__ = ["KIND_OF_CONTROLLERS", "PidConfig", "PidInstance", "describe_pid"]

_PARAMETERS = {
    "p": (0.0, "proportional gain in effort per rad or m"),
    "i": (0.0, "integral gain in effort per rad s or m s"),
    "d": (0.0, "derivative gain in effort per rad/s or m/s"),
    "effort_limit": (0.0, "largest absolute effort; 0: no limit"),
    "integral_limit": (0.0, "largest absolute effort of the integral part; 0: no limit"),
}
_INPUTS = {
    "target": "position to reach in rad or m",
    "position": "measured position in rad or m",
    "velocity": "measured velocity in rad/s or m/s",
}


class PidConfig(Base, InstanceSection, frozen=True, kw_only=True, tag_field=KIND, tag="controller"):
    """A controller that needs no FMU."""

    controller: Annotated[
        Literal["position_pid"],
        Meta(description="position_pid: gains p, i, d; inputs target, position, velocity; output effort."),
    ]
    start_values: StartValues = {}
    inputs: Inputs = {}
    step_size: StepSize = None
    group: Group = None
    host: Host = None
    not_finite: NotFinitePolicy = None
    on_failure: OnFailure = "stop"
    extrapolation: ExtrapolationOfInputs = None
    feedthrough: Feedthrough = None

    @property
    def path(self) -> str:
        """Empty: there is no file."""
        return ""


class ControllerKind(Kind[PidConfig]):
    """Controllers that are part of fmu_mesh: their content is that of our version."""

    section = PidConfig
    expected = "no file"

    def describe(
        self, path: Path, section: PidConfig, limits: LimitsConfig, tell: Callable[[str], None]
    ) -> ModelDescription:
        """The model description of the controller."""
        return describe_pid()

    def content(self, path: Path) -> str:
        """Empty: there is no file."""
        return ""

    def open(self, opening: Opening[PidConfig]) -> Instance:
        """A new controller, with nothing integrated yet."""
        return PidInstance(opening.name)


KIND_OF_CONTROLLERS = ControllerKind()  # what the entry point `controller` names


def describe_pid() -> ModelDescription:
    """The model description of the controller."""
    variables: list[tuple[str, Causality, str, float | None]] = [
        *((name, "parameter", text, start) for name, (start, text) in _PARAMETERS.items()),
        *((name, "input", text, 0.0) for name, text in _INPUTS.items()),
        ("effort", "output", "what the controller asks for, in N m or N", None),
    ]
    return ModelDescription(
        model_name="position_pid",
        model_identifier="position_pid",
        fmi_version="",
        kind="controller",
        guid="{position_pid}",
        variables=tuple(_variable(number, *row) for number, row in enumerate(variables)),
        description="position controller of a joint",
        generation_tool="fmu_mesh",
        can_get_and_set_state=True,
        can_serialize_state=True,
    )


def _variable(number: int, name: str, causality: Causality, text: str, start: float | None) -> Variable:
    return Variable(
        name=name,
        value_reference=number,
        type="Float64",
        causality=causality,
        variability="tunable" if causality == "parameter" else "continuous",
        initial={"parameter": "exact", "output": "calculated"}.get(causality),  # type: ignore[arg-type]  # mypy sees str
        start=start,
        description=text,
        minimum=0.0 if name.endswith("_limit") else None,
        dependencies=tuple(_INPUTS) if causality == "output" else (),
        feedthrough=tuple(_INPUTS) if causality == "output" else (),
    )


class PidInstance(KeepsStateAsBytes):
    """The controller; see `fmu_mesh.instances.contract.Instance` for the call sequence."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.description = describe_pid()
        self._values = {v.name: float(v.start) for v in self.description.variables if isinstance(v.start, float)}
        self._integral = 0.0

    def enter_initialization(
        self, start_time: float, stop_time: float | None, start_values: Mapping[str, Value]
    ) -> None:
        """Set ``start_values``."""
        self.set_values(start_values)

    def exit_initialization(self) -> None:
        """Leave Initialization Mode; there is nothing to do."""

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set gains, limits and inputs by name."""
        for name, value in values.items():
            self._values[name] = float(cast("float", value))

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """Current values by name."""
        return [self._effort() if name == "effort" else self._values[name] for name in names]

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Choose the rings of `do_step`, and write the current effort to row ``step``."""
        self._inputs, self._outputs = inputs, outputs
        self._step_size = points * grid.step_size
        self._write(step)

    def do_step(self, step: int) -> None:
        """Read the inputs of row ``step``, integrate the error over the step, write the effort to row ``step + 1``."""
        row = self._inputs.part("Float64")[step & self._inputs.mask].tolist()
        values = self._values
        values.update(zip(self._inputs.layout.names, row, strict=True))
        for name in _INPUTS:
            if not math.isfinite(values[name]):
                raise StepFailed(f"the input is {values[name]}", instance=self.name, variable=name)
        self._integral += (values["target"] - values["position"]) * self._step_size
        if values["i"] and values["integral_limit"]:
            self._integral = _limited(self._integral, values["integral_limit"] / abs(values["i"]))
        self._write(step + 1)

    def get_state(self) -> bytes:
        """The inputs, the gains and the integral."""
        return msgspec.json.encode((self._values, self._integral))

    def set_state(self, state: object) -> None:
        """Restore what `get_state` of this or another controller returned."""
        assert isinstance(state, bytes)
        self._values, self._integral = msgspec.json.decode(state, type=tuple[dict[str, float], float])

    def close(self) -> None:
        """Nothing to free."""

    def _effort(self) -> float:
        values = self._values
        error = values["target"] - values["position"]
        effort = values["p"] * error + values["i"] * self._integral - values["d"] * values["velocity"]
        return _limited(effort, values["effort_limit"]) if values["effort_limit"] else effort

    def _write(self, step: int) -> None:
        for ring in self._outputs:
            ring.part("Float64")[step & ring.mask] = self.get_values(ring.layout.names)


def _limited(value: float, most: float) -> float:
    return min(max(value, -most), most)
