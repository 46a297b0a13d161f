"""The services of `simulation_interfaces`, and the action SimulateSteps, as those of a node of rclpy."""

# Threads: the executor of rclpy calls `_answer`, and has to go on while a request waits for a long step. So `_answer`
# is a coroutine: one of `ServiceThreads` asks the mesh, and sets the result of a future. The executor would not notice;
# it wakes for the callback of the future. A service that is destroyed cannot respond, so that waits for the last
# response (`close`, ADR 0031).

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

from ...ros_wire.cdr import Message
from ...ros_wire.rclpy_profile import RosNode, ros_module
from ...ros_wire.ros_names import absolute, service_name
from ...ros_wire.simulation_types import SIMULATION_SERVICES, ResultCode
from ..gateway.service_threads import ServiceThreads
from ..gateway.simulation_services import SIMULATION_THREADS, SimulationServices

__all__ = ["SimulationServer"]

_ACTION = "SimulateSteps"


class SimulationServer:
    """Serves one mesh. Call `open` once, then `close`, both on the thread of the executor."""

    def __init__(self, node: RosNode, services: SimulationServices, namespace: str) -> None:
        self._node = node
        self._services = services
        self._namespace = namespace
        self._threads = ServiceThreads("simulation", SIMULATION_THREADS)
        self._working = ExitStack()
        self._entities = ExitStack()
        self._under_way = 0
        self._closed = False

    def open(self) -> None:
        """Create the services and the action.

        Raises:
            ConfigurationError: ROS does not have the package `simulation_interfaces`.
        """
        types = ros_module("simulation_interfaces.srv")
        action = ros_module("simulation_interfaces.action").SimulateSteps
        rclpy_action = ros_module("rclpy.action")
        # Others than those of the node: a request that waits lets no callback of its group run, unless it is reentrant.
        group = ros_module("rclpy.callback_groups").ReentrantCallbackGroup()
        for kind in SIMULATION_SERVICES:
            service = self._node.create_service(
                getattr(types, kind), self._name(kind), self._callback(kind, getattr(types, kind)), callback_group=group
            )
            self._entities.callback(self._node.destroy_service, service)
        server = rclpy_action.ActionServer(
            self._node,
            action,
            self._name(_ACTION),
            execute_callback=self._simulate,
            cancel_callback=lambda _goal: rclpy_action.CancelResponse.ACCEPT,
            callback_group=group,
        )
        self._entities.callback(server.destroy)
        self._working.enter_context(self._threads)

    def close(self) -> None:
        """Requests do not wait for the mesh any more; destroy the services once all of them are answered."""
        self._services.close()
        self._working.close()
        self._closed = True
        if not self._under_way:
            self._entities.close()

    def _name(self, kind: str) -> str:
        """The name of a service: in the namespace of the node, unless the configuration names one."""
        name = service_name(kind)
        return name if self._namespace == "/" else absolute(name, self._namespace)

    def _callback(self, kind: str, service: Any) -> Any:  # noqa: ANN401 types of rclpy
        serialization = ros_module("rclpy.serialization")
        request_codec, response_codec = self._services.codecs[kind]

        async def answer(request: object, _response: object) -> object:
            response = await self._answer(kind, request_codec.decode(serialization.serialize_message(request)))
            return serialization.deserialize_message(response_codec.encode(response), service.Response)

        return answer

    async def _answer(self, kind: str, request: Message) -> Message:
        if self._closed:  # it came before the end of the services
            return self._services.answer(kind, request)
        executor = self._node.executor
        future = ros_module("rclpy.task").Future(executor=executor)
        future.add_done_callback(lambda _done: None)
        self._under_way += 1
        self._threads.do(lambda: future.set_result(self._services.answer(kind, request)))
        try:
            response: Message = await future
        finally:
            self._under_way -= 1
            if self._closed and not self._under_way:
                executor.create_task(self._entities.close)
        return response

    async def _simulate(self, goal: Any) -> Any:  # noqa: ANN401 types of rclpy
        """Make the steps of a goal one by one, with feedback after each."""
        action = ros_module("simulation_interfaces.action").SimulateSteps
        outcome: Message = {"result": ResultCode.OK, "error_message": ""}
        done, steps = 0, goal.request.steps
        while done < steps and outcome["result"] == ResultCode.OK and not goal.is_cancel_requested:
            outcome = (await self._answer("StepSimulation", {"steps": 1}))["result"]
            if outcome["result"] == ResultCode.OK:
                done += 1
                goal.publish_feedback(action.Feedback(completed_steps=done, remaining_steps=steps - done))
        if done == steps:
            goal.succeed()
        elif goal.is_cancel_requested:
            outcome = {"result": ResultCode.OPERATION_FAILED, "error_message": f"cancelled after {done} steps"}
            goal.canceled()
        else:
            goal.abort()
        message = ros_module("simulation_interfaces.msg").Result
        return action.Result(result=message(result=int(outcome["result"]), error_message=outcome["error_message"]))
