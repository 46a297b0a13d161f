"""A simulator in ROS behind the `Instance` Protocol.

One own step from n to n + 1, in pseudocode::

    inputs of row n: one message for each topic of inputs
    StepSimulation, with so many steps of the simulator as an own step has; its response
    of each topic of outputs the message that belongs to the new time
    outputs into row n + 1

The simulator is paused between two steps. Its state cannot be kept, so this instance has none to get and set.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress

from ...errors import ConfigurationError, FmuError, InitializationFailed, LoadFailed, MeshLost, StepFailed
from ...rings.ring import Ring
from ...ros_wire.assembling import Assembler
from ...ros_wire.cdr import CdrError, Message
from ...ros_wire.profile import Put
from ...ros_wire.rmw_zenoh import Call
from ...ros_wire.ros_names import absolute, ros_name, service_name
from ...ros_wire.simulation_types import ResultCode, SimulationStates, SimulatorFeature
from ...simtime import TimeGrid, steps_between
from ...text import listed
from ...variables.model_description import Value
from ..contract import LogMessage, Opening
from .output_topic import OutputTopic, SimulatorTime, WrongMessage
from .simulator_connection import RclpyConnection, SimulatorConnection, ZenohConnection
from .simulator_section import RosSimulatorConfig
from .simulator_topics import SimulatorTopics

__all__ = ["RosSimulatorInstance"]

_HEARD_S = 2.0
"""How long a subscriber of an input may take to appear, before a warning says that there is none."""
_LOOK_S = 0.1
_PAUSE_S = 2.0

_FEATURES = "GetSimulatorFeatures"


class RosSimulatorInstance:
    """One simulator; see `fmu_mesh.instances.contract.Instance` for the call sequence."""

    def __init__(self, opening: Opening[RosSimulatorConfig]) -> None:
        self.name = opening.name
        self.description = opening.description
        self._own = own = opening.section.ros_simulator
        self._log = opening.log
        self._topics = SimulatorTopics.of(opening.section)
        self._time = SimulatorTime(own.step)
        self._values: dict[str, Value] = {
            variable.name: variable.start for variable in self.description.variables if variable.start is not None
        }
        self._stepping = False
        self._inputs: list[tuple[Assembler, Put, list[str]]] = []
        self._outputs: list[OutputTopic] = []
        self._open = ExitStack()
        try:
            self._connect()
        except BaseException as error:
            self.close()
            if isinstance(error, ConfigurationError):  # no router; no ROS here, or one that lacks a type
                raise LoadFailed(error.message, instance=self.name, hint=error.hint or self._hint) from error
            raise

    def enter_initialization(
        self, start_time: float, stop_time: float | None, start_values: Mapping[str, Value]
    ) -> None:
        """Pause the simulator at its first point, and wait for a message of each topic without start values."""
        self._values.update(start_values)
        paused = {"state": {"state": SimulationStates.PAUSED}}
        accepted = ResultCode.OK, ResultCode.ALREADY_IN_TARGET_STATE
        self._ask("SetSimulationState", paused, InitializationFailed, accepted)
        for topic in self._outputs:
            topic.begin(silent=start_values.keys() >= {*topic.variables})
        self._time.begin(self._own.start_time if self._own.start_time is not None else 0.0 if self._resets else None)
        if self._resets:
            self._ask("ResetSimulation", {"scope": 0}, InitializationFailed)
        self._take_outputs(0, InitializationFailed)
        missing = [name for topic in self._outputs for name in topic.variables if name not in self._values]
        if missing:
            text = "the first message of the simulator has no value for this output"
            hint = "Give it a start value, or see whether its field is right."
            raise InitializationFailed(text, instance=self.name, variable=missing[0], hint=hint)

    def exit_initialization(self) -> None:
        """Warn of topics of inputs to which nobody subscribes."""
        end = time.monotonic() + _HEARD_S
        while (unheard := self._connection.unheard()) and (left := end - time.monotonic()) > 0:
            self._connection.wait(min(left, _LOOK_S))
        if unheard:
            text = f"nobody subscribes to {listed(unheard)}: these inputs have no effect"
            self._log(LogMessage(self.name, "Warning", "topics", text, -1))

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set inputs by name; they are published at the start of the next step."""
        self._values.update(values)

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """Current values by name."""
        return [self._values[name] for name in names]

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Choose the rings of `do_step`, and write the current outputs to row ``step``."""
        per_step = steps_between(0.0, points * grid.step_size, self._own.step)
        assert per_step  # the section was checked
        self._per_step = per_step
        self._taken = inputs
        self._given = outputs
        self._write(step)

    def do_step(self, step: int) -> None:
        """Publish the inputs of row ``step``, step the simulator, write the outputs to row ``step + 1``."""
        for name in self._taken.layout.names:
            self._values[name] = self._taken.value(step, name)
        begin = step * self._per_step
        for assembler, put, names in self._inputs:
            now = self._time.at(begin)
            try:
                put(assembler.make([self._values[name] for name in names], now), now)
            except CdrError as error:
                text = f"the inputs do not fit into a message on '{assembler.topic.name}': {error}"
                raise StepFailed(text, instance=self.name) from error
        self._stepping = True
        for steps in [self._per_step] if self._multiple else [1] * self._per_step:
            self._ask("StepSimulation", {"steps": steps}, StepFailed)
        self._stepping = False
        self._take_outputs(begin + self._per_step, StepFailed)
        self._write(step + 1)

    def close(self) -> None:
        """Leave the simulator paused, and undeclare everything. Never raises; may be called twice."""
        if self._stepping:
            self._stepping = False
            with suppress(MeshLost):  # it does not answer
                self._calls["SetSimulationState"]({"state": {"state": SimulationStates.PAUSED}}, _PAUSE_S)
        self._open.close()

    # --- the connection

    def _connect(self) -> None:
        """Declare everything, and ask what the simulator can do.

        Raises:
            LoadFailed: there is none, or it cannot be paused and stepped.
        """
        kind = RclpyConnection if self._own.profile == "rclpy" else ZenohConnection
        self._connection: SimulatorConnection = kind(self._own, self._topics.types, ros_name(self.name))
        self._open.callback(self._connection.close)
        for topic, own in self._topics.topics:
            if own.inputs:
                put, names = self._connection.publish(topic), [port.variable.name for port in topic.ports]
                self._inputs.append((Assembler(topic, self._topics.types), put, names))
            else:
                output = OutputTopic(topic, own, self._topics.types, self._time)
                self._connection.subscribe(topic, output.take)
                self._outputs.append(output)
        # The last client asks first: with DDS, whoever answers it has heard of all that was declared before.
        self._calls: dict[str, Call] = {}
        for service in ("SetSimulationState", "StepSimulation", "ResetSimulation", _FEATURES):
            name, type_ = absolute(service_name(service), self._own.namespace), f"simulation_interfaces/srv/{service}"
            self._calls[service] = self._connection.client(name, type_, repeats=service == _FEATURES)
        offered = {int(number) for number in self._ask(_FEATURES, {}, LoadFailed)["features"]["features"]}
        self._multiple = SimulatorFeature.STEP_SIMULATION_MULTIPLE in offered
        self._resets = SimulatorFeature.SIMULATION_RESET in offered
        step = SimulatorFeature.STEP_SIMULATION_MULTIPLE if self._multiple else SimulatorFeature.STEP_SIMULATION_SINGLE
        needed = (SimulatorFeature.SIMULATION_STATE_PAUSE, step)
        if lacking := [feature.name for feature in needed if feature not in offered]:
            text = f"{self._own} does not offer {listed(lacking)}, so it cannot be stepped at communication points"
            raise LoadFailed(text, instance=self.name)

    @property
    def _hint(self) -> str:
        services = absolute("step_simulation", self._own.namespace)
        where = f" through the router at {', '.join(self._own.connect)}" if self._own.profile == "rmw_zenoh" else ""
        return f"Start the simulator, which has to offer '{services}'{where}."

    def _ask(
        self,
        kind: str,
        request: Message,
        failure: type[FmuError],
        accepted: tuple[ResultCode, ...] = (ResultCode.OK,),
    ) -> Message:
        """The response of a service; ``failure`` if there is none, or if its result is not one of these."""
        try:
            response = self._calls[kind](request, self._own.timeout)
        except MeshLost as error:
            raise failure(error.message, instance=self.name, hint=self._hint) from error
        result = response.get("result", {"result": ResultCode.OK})
        if result["result"] not in accepted:
            reason = result["error_message"] or "it gives no reason"
            text = f"the simulator has refused '{service_name(kind)}' (result {result['result']}): {reason}"
            raise failure(text, instance=self.name)
        return response

    # --- outputs

    def _take_outputs(self, step: int, failure: type[FmuError]) -> None:
        """Wait until the values of all outputs are those of ``step``, counted in steps of the simulator."""
        end = time.monotonic() + self._own.timeout
        for topic in self._outputs:
            try:
                while not topic.is_at(step):
                    if (left := end - time.monotonic()) <= 0:
                        raise self._late(topic, step, failure)
                    self._connection.wait(left)
            except WrongMessage as error:
                raise failure(str(error), instance=self.name) from error
            self._values.update(topic.values)

    def _late(self, topic: OutputTopic, step: int, failure: type[FmuError]) -> FmuError:
        text = f"{topic.missing()}; waited {self._own.timeout:g} s for that at {self._time.at(step):.9g} s"
        hint = "Does it publish there at every point? `every` and `match` of the topic say when."
        if step == 0:
            hint = f"Does it publish there while it is paused? Otherwise give {listed(topic.variables)} start values."
        return failure(text, instance=self.name, hint=hint)

    def _write(self, step: int) -> None:
        for ring in self._given:
            for name in ring.layout.names:
                ring.put(step, name, self._values[name])
