"""A stand-in for `launch` and `launch_ros`, which are not on PyPI: it takes a launch file, and does what it asks for.

Only what the launch files of `examples/ros` use is here, with the parameters that the real classes have, so a misspelt
one fails. Processes, services and topics are real: a node gets the command line that launch_ros makes of it, events of
its lifecycle come from its own topic, and a change of its state is asked for by its own service.
"""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any, Self

import pytest
import yaml

from tests.helpers import DEADLINE_S
from tests.ros.ros_peer import Ros

__all__ = ["Launch", "described"]


@dataclass(frozen=True)
class LaunchConfiguration:
    """The value of an argument."""

    variable_name: str


@dataclass(frozen=True)
class DeclareLaunchArgument:
    """An argument of the launch file, needed if it has no default."""

    name: str
    default_value: str | None = None
    description: str | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class LifecycleNode:
    """A process with a managed node."""

    name: str
    namespace: str
    executable: str
    arguments: Sequence[str] = ()
    parameters: Sequence[Mapping[str, Any]] = ()
    remappings: Sequence[tuple[str, str]] = ()
    output: str = "log"

    @property
    def path(self) -> str:
        """Its name in ROS."""
        return f"/{self.namespace}/{self.name}" if self.namespace else f"/{self.name}"


@dataclass(frozen=True, kw_only=True)
class ChangeState:
    """A transition that the nodes which match are asked for."""

    lifecycle_node_matcher: Callable[[LifecycleNode], bool]
    transition_id: int


@dataclass(frozen=True, kw_only=True)
class EmitEvent:
    """An event that happens at once."""

    event: ChangeState


@dataclass(frozen=True, kw_only=True)
class OnStateTransition:
    """What is done when a node comes from one state to another."""

    target_lifecycle_node: LifecycleNode
    start_state: str
    goal_state: str
    entities: Sequence[EmitEvent]


@dataclass(frozen=True)
class RegisterEventHandler:
    """A handler that is there from now on."""

    event_handler: OnStateTransition


@dataclass(frozen=True)
class LaunchDescription:
    """All of a launch file, in its order."""

    entities: Sequence[object] = field(default_factory=list)


def _matches_action(action: LifecycleNode) -> Callable[[LifecycleNode], bool]:
    return lambda other: other is action


_MODULES: dict[str, dict[str, object]] = {
    "launch": {"LaunchDescription": LaunchDescription},
    "launch.actions": {
        "DeclareLaunchArgument": DeclareLaunchArgument,
        "EmitEvent": EmitEvent,
        "RegisterEventHandler": RegisterEventHandler,
    },
    "launch.events": {"matches_action": _matches_action},
    "launch.substitutions": {"LaunchConfiguration": LaunchConfiguration},
    "launch_ros": {},
    "launch_ros.actions": {"LifecycleNode": LifecycleNode},
    "launch_ros.event_handlers": {"OnStateTransition": OnStateTransition},
    "launch_ros.events": {},
    "launch_ros.events.lifecycle": {"ChangeState": ChangeState},
}


def described(file: Path, monkeypatch: pytest.MonkeyPatch) -> LaunchDescription:
    """What a launch file describes."""
    for name, members in _MODULES.items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
    found = runpy.run_path(str(file))["generate_launch_description"]()
    assert isinstance(found, LaunchDescription)
    return found


class Launch:
    """Runs a launch description; use it as a context manager.

    Attributes:
        transitions: (node, state it has come to), in the order in which they were told.
        commands: the command line of every node, by name.
    """

    def __init__(self, ros: Ros, folder: Path, description: LaunchDescription, **arguments: str) -> None:
        self.transitions: list[tuple[str, str]] = []
        self.commands: dict[str, list[str]] = {}
        self._ros = ros
        self._folder = folder
        self._description = description
        self._arguments = arguments
        self._peer = ros.peer("launch")
        self._handlers: list[OnStateTransition] = []
        self._nodes: dict[LifecycleNode, subprocess.Popen[str]] = {}
        self._subscriptions: dict[LifecycleNode, Any] = {}
        self._asked: list[ChangeState] = []

    def __enter__(self) -> Self:
        """Start everything in its order."""
        for entity in self._description.entities:
            match entity:
                case DeclareLaunchArgument(name, default_value):
                    assert name in self._arguments or default_value is not None
                case RegisterEventHandler(handler):
                    self._handlers.append(handler)
                case LifecycleNode():
                    self._start(entity)
                case EmitEvent(event=event):
                    self._asked.append(event)
                case _:
                    raise TypeError(f"the stand-in knows no {entity!r}")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in self._nodes.values():
            process.terminate()
        for process in self._nodes.values():
            try:
                process.communicate(timeout=DEADLINE_S)
            finally:
                process.kill()

    def until(self, transitions: Sequence[tuple[str, str]]) -> None:
        """Do what the description asks for, until these transitions have come."""
        while len(self.transitions) < len(transitions):
            while self._asked:
                self._change(self._asked.pop(0))
            done = partial(self._told, len(transitions))
            self._ros.until(done, f"{len(transitions)} transitions, but {self.transitions}")
        assert self.transitions == list(transitions)

    def _told(self, count: int) -> bool:
        return len(self.transitions) >= count or bool(self._asked)

    def _start(self, node: LifecycleNode) -> None:
        from lifecycle_msgs.msg import TransitionEvent  # noqa: PLC0415 only where ROS is installed

        def came(event: Any) -> None:  # noqa: ANN401 types of rclpy
            start, goal = event.start_state.label, event.goal_state.label
            if goal in ("inactive", "active"):
                self.transitions.append((node.name, goal))
            for handler in self._handlers:
                if handler.target_lifecycle_node is node and (handler.start_state, handler.goal_state) == (start, goal):
                    self._asked += [entity.event for entity in handler.entities]

        topic = f"{node.path}/transition_event"
        self._subscriptions[node] = self._peer.create_subscription(TransitionEvent, topic, came, 10)
        self.commands[node.name] = command = self._command(node)
        self._nodes[node] = subprocess.Popen(
            command, env={**os.environ, **self._ros.environment}, stderr=subprocess.PIPE, text=True
        )

    def _command(self, node: LifecycleNode) -> list[str]:
        """The command line as launch_ros makes it: names as remappings, parameters in a file."""
        command = [node.executable, *node.arguments, "--ros-args", "-r", f"__node:={node.name}"]
        if node.namespace:
            command += ["-r", f"__ns:=/{node.namespace}"]
        for number, parameters in enumerate(node.parameters):
            values = {name: self._value(value) for name, value in parameters.items()}
            file = self._folder / f"{node.name}.{number}.yaml"
            file.write_text(yaml.safe_dump({node.path: {"ros__parameters": values}}), encoding="utf-8")
            command += ["--params-file", str(file)]
        for source, target in node.remappings:
            command += ["-r", f"{source}:={target}"]
        return command

    def _value(self, value: object) -> object:
        return self._arguments[value.variable_name] if isinstance(value, LaunchConfiguration) else value

    def _change(self, change: ChangeState) -> None:
        from lifecycle_msgs.srv import ChangeState as Service  # noqa: PLC0415 only where ROS is installed

        for node in filter(change.lifecycle_node_matcher, self._nodes):
            client = self._peer.create_client(Service, f"{node.path}/change_state")
            self._ros.matched(self._subscriptions[node])
            self._ros.known_to(node.path, self._peer)
            request = Service.Request()
            request.transition.id = change.transition_id
            answer = self._ros.called(client, request, once=True)
            assert answer.success, f"{node.path} refused transition {change.transition_id}"
