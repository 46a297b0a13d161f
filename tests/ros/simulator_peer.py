"""A simulator with a mass on a spring, as others are: services of simulation_interfaces, and topics.

Arguments: `rmw_zenoh` (by zenoh-ros2-sdk) or `rclpy`, and JSON: `namespace`, `step` in s, `features`, and for rmw_zenoh
`port` of the router and `domain`. It publishes `state` (TwistStamped) and `speed` (Float64) after each step and after a
reset, `slow` (TwistStamped) every third step, and nothing else at the start. The force comes as `force` (Float64), or
as `push` (TwistStamped), for which a step waits that begins at its stamp. It prints a JSON line when it can be found.
Orders: `refuse_at` answers the step to this one with a failure, `end_at` ends the process in it, `late` publishes after
the response, from another thread, and `silent` publishes nothing after a reset.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from collections.abc import Callable
from typing import Any

from fmu_mesh.ros_wire.definitions import MessageTypes
from fmu_mesh.ros_wire.ros_names import service_name
from fmu_mesh.ros_wire.simulation_types import (
    SIMULATION_SERVICES,
    ResultCode,
    SimulationStates,
    define_simulation_types,
)

FLOAT, TWIST = "std_msgs/msg/Float64", "geometry_msgs/msg/TwistStamped"
KINDS = ("GetSimulatorFeatures", "SetSimulationState", "StepSimulation", "ResetSimulation")
DEADLINE_S = 60.0


def say(**what: object) -> None:
    print(json.dumps(what), flush=True)  # noqa: T201 (it is the answer)


class Simulator:
    """The world. ``publish`` takes a topic, the step and numbers; a number alone has no stamp."""

    def __init__(self, orders: dict[str, Any], publish: Callable[[str, int, list[float]], None]) -> None:
        self.orders = orders
        self.publish = publish
        self.state = SimulationStates.PLAYING
        self.force = 0.1
        self.pushes: dict[int, float] = {}
        self.changed = threading.Condition()
        self.begin()

    def begin(self) -> None:
        self.steps, self.position, self.velocity = 0, 1.0, 0.0
        self.pushes.clear()

    def push(self, step: int, force: float) -> None:
        with self.changed:
            self.pushes[step] = force
            self.changed.notify_all()

    def step(self) -> None:
        if self.orders.get("push"):
            with self.changed:
                assert self.changed.wait_for(lambda: self.steps in self.pushes, DEADLINE_S)
                self.force = self.pushes[self.steps]
        self.velocity += (self.force - self.position) * self.orders["step"]
        self.position += self.velocity * self.orders["step"]
        self.steps += 1

    def show(self) -> list[tuple[str, int, list[float]]]:
        shown = [("state", self.steps, [self.position, self.velocity]), ("speed", self.steps, [self.velocity])]
        return shown + ([("slow", self.steps, [self.position, 0.0])] if self.steps % 3 == 0 else [])

    def tell(self, shown: list[tuple[str, int, list[float]]]) -> None:
        def all_of_it() -> None:
            for topic, step, numbers in shown:
                self.publish(topic, step, numbers)

        if self.orders.get("late"):
            threading.Timer(0.02, all_of_it).start()
        else:
            all_of_it()

    def answer(self, kind: str, number: int) -> tuple[int, str]:
        """The result of a request; ``number`` is the state, or the number of steps."""
        match kind:
            case "SetSimulationState":
                if self.state == number:
                    return ResultCode.ALREADY_IN_TARGET_STATE, "it is in this state"
                self.state = SimulationStates(number)
            case "ResetSimulation":
                self.begin()
                if not self.orders.get("silent"):
                    self.tell(self.show())
            case "StepSimulation":
                if self.state != SimulationStates.PAUSED:
                    return ResultCode.OPERATION_FAILED, "it is playing"
                shown: list[tuple[str, int, list[float]]] = []
                for _ in range(number):
                    if self.steps + 1 == self.orders.get("end_at"):
                        os._exit(1)
                    if self.steps + 1 == self.orders.get("refuse_at"):
                        return ResultCode.OPERATION_FAILED, "the solver has diverged"
                    self.step()
                    shown += self.show()
                self.tell(shown)
        return ResultCode.OK, ""


def stamp_of(step: int, orders: dict[str, Any]) -> tuple[int, int]:
    step_ns = float(orders["step"]) * 1e9
    return divmod(round(step * step_ns), 10**9)


def step_of(stamp: Any, orders: dict[str, Any]) -> int:  # noqa: ANN401 a message
    return round((int(stamp.sec) + int(stamp.nanosec) * 1e-9) / float(orders["step"]))


def sdk(orders: dict[str, Any]) -> None:
    """Be a node of zenoh-ros2-sdk."""
    from zenoh_ros2_sdk import ROS2Publisher, ROS2ServiceServer, ROS2Subscriber  # noqa: PLC0415  only one is used
    from zenoh_ros2_sdk.session import ZenohSession  # noqa: PLC0415  likewise

    types = MessageTypes("kilted")
    define_simulation_types(types)
    place = {"domain_id": orders["domain"], "router_ip": "127.0.0.1", "router_port": orders["port"]}
    session = ZenohSession.get_instance("127.0.0.1", orders["port"])
    for name in (f"simulation_interfaces/msg/{own}" for own in ("Result", "SimulationState", "SimulatorFeatures")):
        session.register_message_type(types.definition(name), name)
    space = orders["namespace"]

    def topic(made: Any, name: str, kind: str, *more: Any) -> Any:  # noqa: ANN401 classes of the SDK
        definition = {"msg_definition": types.definition(kind), "type_hash": types.type_hash(kind)}
        return made(f"{space}/{name}", kind, *more, **definition, **place)

    publishers = {name: topic(ROS2Publisher, name, TWIST) for name in ("state", "slow")}
    publishers["speed"] = topic(ROS2Publisher, "speed", FLOAT)
    known = session.store.types

    def publish(name: str, step: int, numbers: list[float]) -> None:
        if name == "speed":
            publishers[name].publish(data=numbers[0])
            return
        vector, twist = known["geometry_msgs/msg/Vector3"], known["geometry_msgs/msg/Twist"]
        header, time = known["std_msgs/msg/Header"], known["builtin_interfaces/msg/Time"]
        sec, nanosec = stamp_of(step, orders)
        linear, angular = vector(x=numbers[0], y=0.0, z=0.0), vector(x=0.0, y=0.0, z=numbers[1])
        publishers[name].publish(
            header=header(stamp=time(sec=sec, nanosec=nanosec), frame_id=""),
            twist=twist(linear=linear, angular=angular),
        )

    simulator = Simulator(orders, publish)
    topic(
        ROS2Subscriber,
        "push",
        TWIST,
        lambda message: simulator.push(step_of(message.header.stamp, orders), float(message.twist.linear.x)),
    )

    def serve(kind: str) -> None:
        name = f"simulation_interfaces/srv/{kind}"

        def answer(request: Any) -> Any:  # noqa: ANN401 messages of the SDK
            response = server.response_msg_class
            if kind == "GetSimulatorFeatures":
                import numpy as np  # noqa: PLC0415  as rosbags wants it

                offered = np.array(orders["features"], np.uint16)
                return response(features=known["simulation_interfaces/msg/SimulatorFeatures"](offered, [], "a spring"))
            number = request.state.state if kind == "SetSimulationState" else getattr(request, "steps", 0)
            code, text = simulator.answer(kind, int(number))
            return response(result=known["simulation_interfaces/msg/Result"](int(code), text))

        request, response = (
            "\n".join(f"simulation_interfaces/{line}" if line[:1].isupper() else line for line in text.splitlines())
            or "uint8 structure_needs_at_least_one_member\n"
            for text in SIMULATION_SERVICES[kind]
        )
        server = ROS2ServiceServer(
            f"{space}/{service_name(kind)}",
            name,
            answer,
            request_definition=request,
            response_definition=response,
            type_hash=types.type_hash(name),
            **place,
        )

    for kind in KINDS:
        serve(kind)
    say(declared=True)
    sys.stdin.read()


def rclpy(orders: dict[str, Any]) -> None:
    """Be a node of rclpy, with ROS's own types."""
    import rclpy as ros  # noqa: PLC0415  only one is used
    import simulation_interfaces.srv as services  # noqa: PLC0415  likewise
    from geometry_msgs.msg import TwistStamped  # noqa: PLC0415  likewise
    from std_msgs.msg import Float64  # noqa: PLC0415  likewise

    ros.init()
    node = ros.create_node("spring", namespace=orders["namespace"])
    publishers = {name: node.create_publisher(TwistStamped, name, 100) for name in ("state", "slow")}
    publishers["speed"] = node.create_publisher(Float64, "speed", 100)

    def publish(name: str, step: int, numbers: list[float]) -> None:
        if name == "speed":
            publishers[name].publish(Float64(data=numbers[0]))
            return
        message = TwistStamped()
        message.header.stamp.sec, message.header.stamp.nanosec = stamp_of(step, orders)
        message.twist.linear.x, message.twist.angular.z = numbers
        publishers[name].publish(message)

    simulator = Simulator(orders, publish)

    def take(message: Float64) -> None:
        simulator.force = message.data

    def serve(kind: str) -> None:
        def answer(request: Any, response: Any) -> Any:  # noqa: ANN401 messages of ROS
            if kind == "GetSimulatorFeatures":
                response.features.features = orders["features"]
                return response
            number = request.state.state if kind == "SetSimulationState" else getattr(request, "steps", 0)
            code, response.result.error_message = simulator.answer(kind, number)
            response.result.result = int(code)
            return response

        node.create_service(getattr(services, kind), service_name(kind), answer)

    node.create_subscription(Float64, "force", take, 100)
    for kind in KINDS:
        serve(kind)
    threading.Thread(target=lambda: (sys.stdin.read(), os._exit(0)), daemon=True).start()
    say(declared=True)
    ros.spin(node)


if __name__ == "__main__":
    {"rmw_zenoh": sdk, "rclpy": rclpy}[sys.argv[1]](json.loads(sys.argv[2]))
