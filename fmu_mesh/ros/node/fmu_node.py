"""One FMU as a ROS lifecycle node: its settings, parameters, topics and timer around an `FmuDriver`.

Where this module does not say otherwise, the node behaves as `fmi_adapter_node` (docs/ros-node.md).
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from ...errors import CallRefused, ConfigurationError, FmuMeshError
from ...ros_wire.definitions import CLOCK
from ...ros_wire.rclpy_profile import RosNode, message_class, ros_module
from ...ros_wire.topics import CLOCK_TOPIC, Topic
from ...variables.model_description import Value, Variable
from .driving import DriveSettings, FmuDriver, FmuThread, Update
from .node_topics import LOG_INTERVAL_S, FmuTopics, own_names, topics_of
from .rclpy_modules import RosTypes, steady_timer, time_message, watch_clock
from .variable_parameters import (
    declare_parameters,
    names_of,
    parameter_values,
    undeclared,
    value_of,
)

__all__ = ["PARAMETERS", "FmuNode"]

# Longer than an FMU needs to end; one that hangs is left behind, because its thread cannot be ended.
_FMU_END_S = 5.0

PARAMETERS: dict[str, tuple[Any, str]] = {
    "fmu_path": ("", "Path of the FMU."),
    "step_size": (0.0, "Communication step size in s; 0.0: that of the FMU's default experiment."),
    "update_period": (0.01, "How often the FMU catches up with time and publishes its outputs, in s of wall clock."),
    "stop_time": (0.0, "Simulated time in s after which the node deactivates itself; 0.0: never."),
    "max_steps": (1000, "How many steps one update may take to catch up."),
    "stamped": (False, "Whether every number has a second topic NAME_stamped (geometry_msgs/msg/PointStamped)."),
    "names": ([""], "Other ROS names of variables, each as 'VARIABLE: NAME'."),
    "messages": ([""], "Fields of messages, each as 'TOPIC: {type: TYPE, fields: {PATH: VARIABLE}, frame_id: NAME}'."),
    "publish_clock": (False, "Whether this node is the source of simulated time: it starts at 0 and goes to /clock."),
    "real_time_factor": (1.0, "With publish_clock: simulated over wall-clock time."),
    "config": ("", "Configuration of a running mesh, instead of an FMU: the node is its gateway."),
    "connect": ([""], "With config: Zenoh endpoints of the mesh; default: the meshes of this user on this host."),
    "autostart": (False, "Whether the node configures and activates itself."),
    "autostart_timeout": (60.0, "With autostart and config: how long to wait for the mesh, in s; 0.0: not at all."),
}
"""The parameters of the node itself, which it declares before it has an FMU: default and description."""

_RESERVED = frozenset({*PARAMETERS, "use_sim_time", "start_type_description_service"})
"""Names of the parameters that every node has, which a variable of an FMU cannot have."""


class FmuNode:
    """The behaviour of a lifecycle node that runs one FMU.

    The methods are the transitions of the node; one thread at a time calls them.

    Attributes:
        failure: the error with which the FMU failed; None again after `configure`.
    """

    def __init__(self, node: RosNode) -> None:
        self.failure: FmuMeshError | None = None
        self._node = node
        self._log = node.get_logger()
        self._driver: FmuDriver | None = None
        self._topics: FmuTopics | None = None
        self._variables: dict[str, Variable] = {}
        self._clock_publisher: Any = None
        self._configured = ExitStack()
        self._timer: Any = None
        self._update: Future[Update] | None = None
        self._paced = _PacedTime(1.0)
        self._thread = FmuThread()

    def configure(self) -> None:
        """Load the FMU, declare and read its parameters, and open its topics.

        Raises:
            FmuMeshError: something is wrong; everything that was done is undone.
        """
        self.failure = None
        try:
            self._configure()
        except BaseException:
            self.cleanup()
            raise

    def activate(self) -> None:
        """Start the FMU, or continue after a pause; restart it if the stop time was reached.

        Raises:
            FmuMeshError: the FMU does not start.
        """
        driver, topics = self._live()
        self._paced.resume()
        self._thread.call(driver.resume, self._now())
        topics.start()
        self._timer = steady_timer(self._node, _read_settings(self._node).update_period, self._tick)

    def deactivate(self) -> None:
        """Stop stepping; the FMU keeps its state.

        Raises:
            FmuMeshError: the FMU has failed.
        """
        self._stop_timer()
        self._paced.pause()
        update, self._update = self._update, None
        if update is not None and self.failure is None:
            self._thread.result(update)
        if self.failure is not None:
            raise self.failure

    def cleanup(self) -> None:
        """Close the FMU and its topics, and undeclare its parameters. Never raises."""
        self._stop_timer()
        driver, self._driver = self._driver, None
        topics, self._topics = self._topics, None
        if topics is not None:
            topics.close_inputs()
        if driver is not None:
            try:
                self._thread.submit(driver.close).result(_FMU_END_S)
            except FutureTimeout:
                self._log.error(f"the FMU did not return within {_FMU_END_S:g} s; it is left behind")
                driver.adapter.remove_files()
        if topics is not None:
            topics.close_outputs()
        self._configured.close()
        self._clock_publisher = self._update = None

    def close(self) -> bool:
        """Clean up and end the thread of the FMU; returns whether the last call of the FMU has returned."""
        self.cleanup()
        return self._thread.close()

    # --- the transitions in detail

    def _configure(self) -> None:
        settings = _read_settings(self._node)
        self._paced = _PacedTime(settings.real_time_factor)
        driver = self._driver = self._thread.call(FmuDriver, settings)
        description = driver.adapter.description
        names = names_of(description.variables, settings.names)
        taken = sorted(_RESERVED.intersection(names.values()))
        if taken:
            raise ConfigurationError(
                f"variables of the FMU have the names of parameters of this node: {', '.join(taken)}.",
                hint="Give them others, each as 'VARIABLE: NAME', in the parameter 'names'.",
            )
        topics = topics_of(description, settings.names, settings.messages, stamped=settings.stamped)
        before = [name for name in names.values() if self._node.has_parameter(name)]
        self._variables = declare_parameters(self._node, description, settings.names)
        for name in self._variables:
            if name not in before:  # another FMU can declare its own
                self._configured.callback(self._node.undeclare_parameter, name)
        self._set_values(driver, parameter_values(self._node, self._variables))
        opened = self._topics = FmuTopics(self._node, driver, self._thread, self._now)
        for topic in topics:
            opened.open(topic)
        if settings.publish_clock:
            publisher = self._clock_publisher = self._node.create_publisher(message_class(CLOCK), CLOCK_TOPIC, 10)
            self._configured.callback(self._node.destroy_publisher, publisher)
            self._configured.callback(watch_clock(self._node, "publish_clock: false"))
        self._node.add_on_set_parameters_callback(self._check_parameters)
        self._configured.callback(self._node.remove_on_set_parameters_callback, self._check_parameters)
        self._report(driver, settings, topics)

    def _report(self, driver: FmuDriver, settings: DriveSettings, topics: Sequence[Topic]) -> None:
        """Log what a user may want to know of this FMU."""
        for name, near in undeclared(self._node).items():
            hint = f"did you mean '{near}'?" if near is not None else "it is ignored"
            self._log.warning(f"the parameter '{name}' is set, but is no variable of the FMU; {hint}")
        description = driver.adapter.description
        if settings.step_size is None:
            self._log.info(f"no step_size is given; the FMU's own is used: {driver.adapter.step_size!r} s")
        proposed = description.default_experiment.stop_time
        if settings.stop_time is None and proposed is not None:
            self._log.info(f"the FMU proposes to stop at {proposed!r} s; set stop_time to end there")
        for topic in topics:
            for path in (port.path for port in topic.ports if port.direction == "in"):
                if (by_key := RosTypes().resolved(topic.message, path).by_key) != path:
                    what = f"'{path}' of '{topic.name}', whose elements may come in any order"
                    self._log.warning(f"{what}; expected a key: {by_key}")
        carried = {port.variable.name for topic in topics for port in topic.ports}
        for variable in description.with_causality("input", "output"):
            if variable.name not in carried:
                what = f"no message of std_msgs carries {variable.type_name}"
                self._log.warning(f"'{variable.name}' has no topic: {what}")
        for problem in description.problems:
            self._log.warning(f"{settings.fmu_path}: {problem}")

    def _set_values(self, driver: FmuDriver, values: dict[str, Value]) -> None:
        """Give the FMU the values of parameters; one error names all that are wrong."""
        refused = []
        for name, value in values.items():
            try:
                self._thread.call(driver.set_value, name, value)
            except CallRefused as error:
                refused.append(str(error))
            else:
                self._log.info(f"set initial value of variable '{name}' to {value!r}")
        if refused:
            raise ConfigurationError(" ".join(refused))

    # --- the timer and the parameters, on a thread of the executor

    def _tick(self) -> None:
        """Start an update on the thread of the FMU, unless the last update is not over yet."""
        if self._update is not None:
            if not self._update.done():
                self._log.warning(
                    "the FMU has not finished its last update; is update_period too short?",
                    throttle_duration_sec=LOG_INTERVAL_S,
                )
                return
            update, self._update = self._update, None
            if not self._finish(update):
                return
        now = self._now()
        if now == 0 and self._simulated_time():
            self._log.info("waiting for a first /clock", throttle_duration_sec=LOG_INTERVAL_S)
            return
        self._update = self._thread.submit(self._update_fmu, now, self._simulated_time())

    def _finish(self, done: Future[Update]) -> bool:
        """Log the result of an update, or fail with it; returns whether another update may follow."""
        try:
            update = self._thread.result(done)
        except FmuMeshError as error:
            self.failure = error
            self._log.error(str(error))
            self._node.trigger_deactivate()
            return False
        if update.jumped_back:
            what = "the FMU starts from the beginning" if self._simulated_time() else "the FMU goes on where it is"
            self._log.warning(f"time has jumped back by {update.jumped_back:.3f} s: {what}")
        if update.behind:
            self._log.warning(
                f"the FMU is {update.behind:.3f} s behind after {update.steps} steps in one update",
                throttle_duration_sec=LOG_INTERVAL_S,
            )
        if update.ended:
            self._log.info("the stop time is reached")
            self._node.trigger_deactivate()
        return not update.ended

    def _check_parameters(self, parameters: Sequence[Any]) -> Any:  # noqa: ANN401 types of rclpy
        """Refuse values that cannot be set now, with the reason; the FMU gets the others before its next step."""
        result = ros_module("rcl_interfaces.msg").SetParametersResult
        driver = self._driver
        if driver is None:  # it is being closed
            return result(successful=False, reason="the node has no FMU")
        accepted = []
        for parameter in parameters:
            variable = self._variables.get(parameter.name)
            if variable is None or parameter.value is None:
                continue
            try:
                accepted.append((variable.name, driver.check_value(variable.name, value_of(variable, parameter.value))))
            except CallRefused as error:
                return result(successful=False, reason=str(error))
        for name, value in accepted:
            self._thread.submit(self._set_value, name, value)
        return result(successful=True)

    # --- on the thread of the FMU

    def _update_fmu(self, now: int, restart: bool) -> Update:  # noqa: FBT001 passed through an executor
        driver, topics = self._live()
        update = driver.update(now, topics.outputs, restart=restart)
        if self._clock_publisher is not None:
            self._clock_publisher.publish(message_class(CLOCK)(clock=time_message(update.time)))
        topics.publish(update)
        return update

    def _set_value(self, name: str, value: Value) -> None:
        if self._driver is None:
            return
        try:
            self._driver.set_value(name, value)
        except FmuMeshError as error:
            self._log.error(str(error))

    # --- helpers

    def _now(self) -> int:
        """The time that the FMU follows, in ns."""
        if self._clock_publisher is not None:
            return self._paced.now()
        return int(self._node.get_clock().now().nanoseconds)

    def _simulated_time(self) -> bool:
        return self._clock_publisher is None and bool(self._node.get_clock().ros_time_is_active)

    def _live(self) -> tuple[FmuDriver, FmuTopics]:
        if self._driver is None or self._topics is None:
            raise ConfigurationError("the node has no FMU yet.", hint="Configure it first.")
        return self._driver, self._topics

    def _stop_timer(self) -> None:
        if self._topics is not None:
            self._topics.stop()
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None


class _NodeSettings(DriveSettings, frozen=True, kw_only=True):
    """The checked parameters of a node that runs an FMU; `PARAMETERS` describes them."""

    update_period: float
    stamped: bool
    names: dict[str, str]
    messages: tuple[str, ...]
    publish_clock: bool
    real_time_factor: float


def _read_settings(node: RosNode) -> _NodeSettings:
    """Read the parameters of a node that runs an FMU.

    Raises:
        ConfigurationError: a value is missing or out of range.
    """
    value = {name: node.get_parameter(name).value for name in (*PARAMETERS, "use_sim_time")}
    if not value["fmu_path"]:
        raise ConfigurationError("the parameter 'fmu_path' is not set.", hint="It is the path of the FMU.")
    for name in ("step_size", "stop_time"):
        if not (math.isfinite(value[name]) and value[name] >= 0.0):
            raise ConfigurationError(f"the parameter '{name}' is {value[name]!r}; expected a time of 0.0 s or more.")
    for name in ("update_period", "real_time_factor", "max_steps"):
        if not (math.isfinite(value[name]) and value[name] > 0):
            raise ConfigurationError(f"the parameter '{name}' is {value[name]!r}; expected a number above 0.")
    if value["publish_clock"] and value["use_sim_time"]:
        raise ConfigurationError(
            "this node cannot publish /clock and run by it.", hint="Set either publish_clock or use_sim_time."
        )
    return _NodeSettings(
        fmu_path=Path(value["fmu_path"]),
        step_size=value["step_size"] or None,
        stop_time=value["stop_time"] or None,
        max_steps=value["max_steps"],
        update_period=value["update_period"],
        stamped=value["stamped"],
        names=own_names(filter(None, value["names"])),
        messages=tuple(filter(None, value["messages"])),
        publish_clock=value["publish_clock"],
        real_time_factor=value["real_time_factor"],
    )


class _PacedTime:
    """Simulated time that starts at 0 and runs at a multiple of wall-clock time; it starts paused."""

    def __init__(self, factor: float) -> None:
        self._factor = factor
        self._before = 0
        self._since: int | None = None

    def now(self) -> int:
        """The time in ns."""
        running = 0 if self._since is None else time.monotonic_ns() - self._since
        return self._before + round(running * self._factor)

    def resume(self) -> None:
        """Start, or continue after a pause."""
        if self._since is None:
            self._since = time.monotonic_ns()

    def pause(self) -> None:
        """Stop the time until `resume`."""
        self._before, self._since = self.now(), None
