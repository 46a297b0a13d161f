"""One FMU as a ROS lifecycle node: its parameters, topics and timer around an `FmuDriver`.

Owns the thread that calls the FMU, so that it is always the same one, whatever executor the node is in, and the node's
services answer while the FMU computes. What is not said here is as in `fmi_adapter_node` (docs/ros-node.md).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as FutureTimeout
from typing import Any, ParamSpec, TypeVar

from ...errors import CallRefused, ConfigurationError, DeadlineExceeded, FmuError, FmuMeshError
from ...variables.model_description import Value, Variable
from .clock_watch import CLOCK_TOPIC, ClockWatch
from .driving import DriveSettings, FmuDriver, Turn
from .node_parameters import (
    RosNode,
    declare_parameters,
    names_of,
    parameter_values,
    undeclare_parameters,
    undeclared,
    value_of,
)
from .node_settings import RESERVED, PacedTime, read_settings
from .node_topics import Topic, fill, message_time, topics_of, values_in
from .rclpy_modules import message_class, ros_module

__all__ = ["FmuNode"]

_DEPTH = 1000
_MAX_WAITING = 10_000
_ANSWER_S = 60.0
_CLOSE_S = 5.0
_COMPLAIN_S = 10.0

Result = TypeVar("Result")
Arguments = ParamSpec("Arguments")


class FmuNode:
    """What a lifecycle node does that runs one FMU.

    The methods are its transitions; they are called by one thread at a time.

    Args:
        node: the lifecycle node, with `PARAMETERS` declared.

    Attributes:
        failure: why the FMU failed, until it is configured again.
    """

    def __init__(self, node: RosNode) -> None:
        self.failure: FmuMeshError | None = None
        self._node = node
        self._log = node.get_logger()
        self._driver: FmuDriver | None = None
        self._variables: dict[str, Variable] = {}
        self._declared: list[str] = []
        self._publishers: list[tuple[Topic, Any, Any]] = []
        self._subscriptions: list[Any] = []
        self._clock_publisher: Any = None
        self._clock_watch: ClockWatch | None = None
        self._checking: Any = None
        self._timer: Any = None
        self._turn: Future[Turn] | None = None
        self._held: dict[str, tuple[Topic, Any, int]] = {}
        self._waiting = 0
        self._count = threading.Lock()
        self._paced = PacedTime(1.0)
        self._fmu_thread = ThreadPoolExecutor(1, thread_name_prefix="fmu")

    def configure(self) -> None:
        """Load the FMU, declare and read its parameters, and open its topics.

        Raises:
            FmuMeshError: something is wrong; nothing is left of this attempt.
        """
        self.failure = None
        try:
            self._configure()
        except BaseException:
            self.cleanup()
            raise

    def activate(self) -> None:
        """Start, or go on after a pause; from the beginning if the stop time was reached.

        Raises:
            FmuMeshError: the FMU does not start.
        """
        driver = self._live()
        self._paced.go_on()
        now = self._now()
        self._call(driver.resume, now)
        for topic, message, arrived in self._held.values():
            self._call(self._take, topic, message, arrived)
        self._held.clear()
        steady = ros_module("rclpy.clock").Clock(clock_type=ros_module("rclpy.clock").ClockType.STEADY_TIME)
        period = read_settings(self._node).update_period
        self._timer = self._node.create_timer(period, self._tick, clock=steady)

    def deactivate(self) -> None:
        """Stop stepping; the FMU stays where it is.

        Raises:
            FmuMeshError: the FMU has failed.
        """
        self._stop_timer()
        self._paced.pause()
        turn, self._turn = self._turn, None
        if turn is not None and self.failure is None:
            self._result(turn)
        if self.failure is not None:
            raise self.failure

    def cleanup(self) -> None:
        """Close the FMU and its topics, and take its parameters back. Never raises."""
        self._stop_timer()
        if self._checking is not None:
            self._node.remove_on_set_parameters_callback(self._checking)
            self._checking = None
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        driver, self._driver = self._driver, None
        if driver is not None:
            try:
                self._fmu_thread.submit(driver.close).result(_CLOSE_S)
            except FutureTimeout:
                self._log.error(f"the FMU did not return within {_CLOSE_S:g} s; it is left behind")
                driver.remove_files()
        for _, publisher, _ in self._publishers:
            self._node.destroy_publisher(publisher)
        if self._clock_watch is not None:
            self._clock_watch.close()
            self._clock_watch = None
        if self._clock_publisher is not None:
            self._node.destroy_publisher(self._clock_publisher)
        undeclare_parameters(self._node, self._declared)
        self._subscriptions, self._publishers, self._clock_publisher, self._declared = [], [], None, []
        self._turn = None
        self._held.clear()

    def close(self) -> bool:
        """`cleanup`, and end the thread; returns whether the FMU's last call has come back."""
        self.cleanup()
        self._fmu_thread.shutdown(wait=False, cancel_futures=True)
        return not any(thread.is_alive() for thread in _joined(self._fmu_thread))

    # --- the transitions in detail

    def _configure(self) -> None:
        settings = read_settings(self._node)
        self._paced = PacedTime(settings.real_time_factor)
        driver = self._driver = self._call(FmuDriver, settings.drive)
        description = driver.description
        names = names_of(description.variables, settings.names)
        taken = sorted(RESERVED.intersection(names.values()))
        if taken:
            raise ConfigurationError(
                f"variables of the FMU have the names of parameters of this node: {', '.join(taken)}.",
                hint="Give them others, each as 'VARIABLE: NAME', in the parameter 'names'.",
            )
        topics = topics_of(description, settings.names, settings.messages, stamped=settings.stamped)
        before = [name for name in names.values() if self._node.has_parameter(name)]
        self._variables = declare_parameters(self._node, description, settings.names)
        self._declared = [name for name in self._variables if name not in before]
        self._set_values(parameter_values(self._node, self._variables))
        for topic in topics:
            self._open(topic)
        if settings.publish_clock:
            kind = message_class("rosgraph_msgs/msg/Clock")
            self._clock_publisher = self._node.create_publisher(kind, CLOCK_TOPIC, 10)
            self._clock_watch = ClockWatch(self._node, "publish_clock: false")
        self._checking = self._check_parameters
        self._node.add_on_set_parameters_callback(self._checking)
        self._tell(driver, settings.drive, topics)

    def _tell(self, driver: FmuDriver, settings: DriveSettings, topics: Sequence[Topic]) -> None:
        """What a user may want to know of this FMU."""
        for name, near in undeclared(self._node).items():
            hint = f"did you mean '{near}'?" if near is not None else "it is ignored"
            self._log.warning(f"the parameter '{name}' is set, but is no variable of the FMU; {hint}")
        description = driver.description
        if settings.step_size is None:
            self._log.info(f"no step_size is given; the FMU's own is used: {driver.step_size!r} s")
        proposed = description.default_experiment.stop_time
        if settings.stop_time is None and proposed is not None:
            self._log.info(f"the FMU proposes to stop at {proposed!r} s; set stop_time to end there")
        carried = {variable for topic in topics for _, variable in topic.fields}
        for variable in description.with_causality("input", "output"):
            if variable.name not in carried:
                what = f"no message of std_msgs carries {variable.type_name}"
                self._log.warning(f"'{variable.name}' has no topic: {what}")
        for problem in description.problems:
            self._log.warning(f"{settings.fmu_path}: {problem}")

    def _set_values(self, values: dict[str, Value]) -> None:
        """Give the FMU the values of parameters; all that are wrong are told."""
        driver = self._live()
        refused = []
        for name, value in values.items():
            try:
                self._call(driver.set_value, name, value)
            except CallRefused as error:
                refused.append(str(error))
            else:
                self._log.info(f"set initial value of variable '{name}' to {value!r}")
        if refused:
            raise ConfigurationError(" ".join(refused))

    def _open(self, topic: Topic) -> None:
        kind = message_class(topic.message)
        overrides = ros_module("rclpy.qos_overriding_options").QoSOverridingOptions.with_default_policies()
        if topic.direction == "out":
            publisher = self._node.create_publisher(kind, topic.name, _DEPTH, qos_overriding_options=overrides)
            self._publishers.append((topic, publisher, kind))
        else:
            self._subscriptions.append(
                self._node.create_subscription(
                    kind,
                    topic.name,
                    lambda message: self._arrived(topic, message),
                    _DEPTH,
                    qos_overriding_options=overrides,
                )
            )

    # --- the timer and the topics, on a thread of the executor

    def _tick(self) -> None:
        """One turn of the FMU on its own thread, unless the last one is not over yet."""
        if self._turn is not None:
            if not self._turn.done():
                self._log.warning(
                    "the FMU has not finished its last update; is update_period too short?",
                    throttle_duration_sec=_COMPLAIN_S,
                )
                return
            turn, self._turn = self._turn, None
            if not self._look_at(turn):
                return
        now = self._now()
        if now == 0 and self._simulated_time():
            self._log.info("waiting for a first /clock", throttle_duration_sec=_COMPLAIN_S)
            return
        self._turn = self._fmu_thread.submit(self._do_turn, now, self._simulated_time())

    def _look_at(self, done: Future[Turn]) -> bool:
        """What came of a turn; whether the next one may follow."""
        try:
            turn = self._result(done)
        except FmuMeshError as error:
            self.failure = error
            self._log.error(str(error))
            self._node.trigger_deactivate()
            return False
        if turn.jumped_back:
            what = "the FMU starts from the beginning" if self._simulated_time() else "the FMU goes on where it is"
            self._log.warning(f"time has jumped back by {turn.jumped_back:.3f} s: {what}")
        if turn.behind:
            self._log.warning(
                f"the FMU is {turn.behind:.3f} s behind after {turn.steps} steps in one update",
                throttle_duration_sec=_COMPLAIN_S,
            )
        if turn.ended:
            self._log.info("the stop time is reached")
            self._node.trigger_deactivate()
        return not turn.ended

    def _arrived(self, topic: Topic, message: Any) -> None:  # noqa: ANN401 a ROS message
        """Take an input; while the FMU does not step only the last one of each topic counts."""
        arrived = self._now()
        if self._timer is None:
            self._held[topic.name] = (topic, message, arrived)
            return
        with self._count:
            self._waiting += 1
            full = self._waiting > _MAX_WAITING
            if full:
                self._waiting -= 1
        if full:
            self._log.error(
                f"{_MAX_WAITING} messages wait for the FMU; one on '{topic.name}' is lost",
                throttle_duration_sec=_COMPLAIN_S,
            )
            return
        self._fmu_thread.submit(self._take_waiting, topic, message, arrived)

    def _check_parameters(self, parameters: Sequence[Any]) -> Any:  # noqa: ANN401 types of rclpy
        """Refuse what cannot be set now, with the reason; what can is set at the FMU's next turn."""
        result = ros_module("rcl_interfaces.msg").SetParametersResult
        driver = self._live()
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
            self._fmu_thread.submit(self._set_value, name, value)
        return result(successful=True)

    # --- on the FMU's thread

    def _do_turn(self, now: int, restart: bool) -> Turn:  # noqa: FBT001 passed through an executor
        driver = self._live()
        variables = [variable for topic, _, _ in self._publishers for _, variable in topic.fields]
        turn = driver.turn(now, variables, restart=restart)
        if self._clock_publisher is not None:
            clock = message_class("rosgraph_msgs/msg/Clock")()
            clock.clock.sec, clock.clock.nanosec = divmod(turn.time, 1_000_000_000)
            self._clock_publisher.publish(clock)
        for topic, publisher, kind in self._publishers:
            message = kind()
            fill(topic, message, turn.values, turn.time)
            publisher.publish(message)
        return turn

    def _take_waiting(self, topic: Topic, message: Any, arrived: int) -> None:  # noqa: ANN401 a ROS message
        with self._count:
            self._waiting -= 1
        self._take(topic, message, arrived)

    def _take(self, topic: Topic, message: Any, arrived: int) -> None:  # noqa: ANN401 a ROS message
        driver = self._driver
        if driver is None:
            return
        try:
            for variable, value in values_in(topic, message).items():
                driver.set_input(variable, message_time(message, arrived), value)
        except (CallRefused, IndexError) as error:
            self._log.error(f"a message on '{topic.name}' was left out: {error}", throttle_duration_sec=_COMPLAIN_S)

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

    def _live(self) -> FmuDriver:
        if self._driver is None:
            raise ConfigurationError("the node has no FMU yet.", hint="Configure it first.")
        return self._driver

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None

    def _call(self, function: Callable[Arguments, Result], *args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        """Call something on the FMU's thread and wait for it."""
        return self._result(self._fmu_thread.submit(function, *args, **kwargs))

    def _result(self, future: Future[Result]) -> Result:
        try:
            return future.result(_ANSWER_S)
        except FutureTimeout as error:
            raise DeadlineExceeded(f"the FMU has not returned for {_ANSWER_S:g} s.") from error
        except FmuMeshError:
            raise
        except Exception as error:
            raise FmuError(f"the FMU's thread failed: {error!r}.") from error


def _joined(executor: ThreadPoolExecutor) -> list[threading.Thread]:
    """The threads of an executor that is shut down, after they were given time to end."""
    threads = list(executor._threads)  # noqa: SLF001 there is no public way to wait with a deadline
    for thread in threads:
        thread.join(_CLOSE_S)
    return threads
