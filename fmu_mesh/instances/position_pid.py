"""The position controller of a joint: a PID whose derivative acts on the measured velocity.

``effort = p (target - position) + i ∫ (target - position) dt - d velocity``. Because the target's own jumps are not
differentiated, a new target gives no kick. The gains are tunable and the target is an input, so both can be set while a
mesh runs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import cast

import msgspec

from ..errors import StepFailed
from ..rings.ring import Ring
from ..simtime import TimeGrid
from ..variables.model_description import Causality, ModelDescription, Value, Variable

__all__ = ["PidInstance", "describe_pid"]

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


def describe_pid() -> ModelDescription:
    """The model description of the controller."""
    variables = [
        *(_variable(name, "parameter", text, start) for name, (start, text) in _PARAMETERS.items()),
        *(_variable(name, "input", text, 0.0) for name, text in _INPUTS.items()),
        _variable("effort", "output", "what the controller asks for, in N m or N"),
    ]
    numbered = tuple(msgspec.structs.replace(variable, value_reference=n) for n, variable in enumerate(variables))
    return ModelDescription(
        model_name="position_pid",
        model_identifier="position_pid",
        fmi_version="",
        kind="controller",
        guid="{position_pid}",
        variables=numbered,
        description="position controller of a joint",
        generation_tool="fmu_mesh",
        can_get_and_set_state=True,
        can_serialize_state=True,
    )


def _variable(name: str, causality: Causality, text: str, start: float | None = None) -> Variable:
    return Variable(
        name=name,
        value_reference=0,
        type="Float64",
        causality=causality,
        variability="tunable" if causality == "parameter" else "continuous",
        initial={"parameter": "exact", "output": "calculated"}.get(causality),  # type: ignore[arg-type]  # mypy sees str
        start=start,
        description=text,
        minimum=0.0 if name.endswith("_limit") else None,
        dependencies=tuple(_INPUTS) if causality == "output" else (),
    )


class PidInstance:
    """The controller as an `fmu_mesh.instances.contract.Instance`; see there for the call sequence."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._description = describe_pid()
        self._values = {v.name: float(v.start) for v in self._description.variables if isinstance(v.start, float)}
        self._integral = 0.0

    @property
    def description(self) -> ModelDescription:
        """The model description."""
        return self._description

    def enter_initialization(
        self,
        start_time: float,  # noqa: ARG002  as in the Protocol
        stop_time: float | None,  # noqa: ARG002  as in the Protocol
        start_values: Mapping[str, Value],
    ) -> None:
        """Set ``start_values``."""
        self.set_values(start_values)

    def exit_initialization(self) -> None:
        """Nothing is left to do."""

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set gains, limits and inputs by name."""
        for name, value in values.items():
            self._values[name] = float(cast("float", value))

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """Current values by name."""
        return [self._effort() if name == "effort" else self._values[name] for name in names]

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Let `do_step` work on these rings; write the current effort as row ``step``."""
        self._inputs, self._outputs = inputs, outputs
        self._step_size = points * grid.step_size
        self._write(step)

    def do_step(self, step: int) -> None:
        """Take the inputs of row ``step``, write the effort they ask for to row ``step + 1``, and integrate."""
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
        """All that the next steps depend on."""
        return msgspec.json.encode(_State(self._values, self._integral))

    def set_state(self, state: object) -> None:
        """Go back to what `get_state` of this or another controller returned."""
        assert isinstance(state, bytes)
        decoded = msgspec.json.decode(state, type=_State)
        self._values, self._integral = dict(decoded.values), decoded.integral

    def free_state(self, state: object) -> None:
        """Nothing to free: a state is bytes."""

    def serialize_state(self, state: object) -> bytes:
        """The state as bytes, which it is."""
        assert isinstance(state, bytes)
        return state

    def deserialize_state(self, data: bytes) -> object:
        """The state of these bytes, which they are."""
        return data

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


class _State(msgspec.Struct, frozen=True):
    """What a controller remembers between steps."""

    values: dict[str, float]
    integral: float


def _limited(value: float, most: float) -> float:
    return min(max(value, -most), most)
