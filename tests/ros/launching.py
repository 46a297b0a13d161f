"""A stand-in for `launch` and `launch_ros`, which are not on PyPI: it takes a launch file, and does what it asks for.

Only what the launch files of `examples/ros` and of the package `fmu_mesh_ros` use is here, with the parameters that the
real classes have, so a misspelt one fails. Processes, services and topics are real: a node gets the command line that
launch_ros makes of it, events of its lifecycle come from its own topic, and a change of its state is asked for by its
own service.
"""

from __future__ import annotations

import os
import runpy
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any, Self

import pytest
import yaml

from tests.helpers import DEADLINE_S
from tests.ros.ros_peer import Ros

__all__ = ["Launch", "LaunchDescription", "described", "stand_in"]

_INTERVAL_S = 0.02


class LaunchDescriptionEntity:
    """What a launch file may list."""


class Event:
    """What handlers are asked about."""


class EventHandler:
    """What is done at events that match."""

    def __init__(
        self, *, matcher: Callable[[Event], bool], entities: Iterable[LaunchDescriptionEntity] | None = None
    ) -> None:
        self.matches = matcher
        self.entities = entities

    def handle(self, event: Event, context: Launch) -> Iterable[LaunchDescriptionEntity] | None:
        """What is done at this event."""
        del event, context
        return self.entities


@dataclass(frozen=True)
class LaunchConfiguration:
    """The value of an argument."""

    variable_name: str


@dataclass(frozen=True)
class DeclareLaunchArgument(LaunchDescriptionEntity):
    """An argument of the launch file, needed if it has no default."""

    name: str
    default_value: str | None = None
    description: str | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Node(LaunchDescriptionEntity):
    """A process with a node: a program by its path, or an executable of a package."""

    executable: str
    name: str | LaunchConfiguration
    namespace: str | LaunchConfiguration = ""
    package: str | None = None
    arguments: Sequence[str] = ()
    parameters: Sequence[Mapping[str, Any]] = ()
    remappings: Sequence[tuple[str, str]] = ()
    output: str = "log"


@dataclass(frozen=True, eq=False, kw_only=True)
class LifecycleNode(Node):
    """A process with a managed node."""

    name: str
    namespace: str

    @property
    def path(self) -> str:
        """Its name in ROS."""
        return f"/{self.namespace}/{self.name}" if self.namespace else f"/{self.name}"


class ExecuteProcess(LaunchDescriptionEntity):
    """A process."""

    def __init__(
        self,
        *,
        cmd: Sequence[str | LaunchConfiguration],
        name: str,
        output: str = "log",
        on_exit: OnExit | None = None,
    ) -> None:
        del output
        self.cmd = cmd
        self.name = name
        self.on_exit = on_exit

    def execute(self, context: Launch) -> list[LaunchDescriptionEntity] | None:
        """Start it."""
        if self.on_exit is not None:
            context.do(RegisterEventHandler(OnProcessExit(target_action=self, on_exit=self.on_exit)))
        context.start(self, [str(context.value(part)) for part in self.cmd])
        return None


@dataclass(frozen=True)
class ProcessExited(Event):
    """A process is over."""

    action: ExecuteProcess
    returncode: int


OnExit = (
    Sequence[LaunchDescriptionEntity] | Callable[[ProcessExited, "Launch"], Iterable[LaunchDescriptionEntity] | None]
)


class OnProcessExit(EventHandler):
    """What is done when a process is over."""

    def __init__(self, *, target_action: ExecuteProcess, on_exit: OnExit) -> None:
        super().__init__(matcher=lambda event: isinstance(event, ProcessExited) and event.action is target_action)
        self._on_exit = on_exit

    def handle(self, event: Event, context: Launch) -> Iterable[LaunchDescriptionEntity] | None:
        """What is done at this event."""
        assert isinstance(event, ProcessExited)
        return self._on_exit(event, context) if callable(self._on_exit) else self._on_exit


@dataclass(frozen=True, kw_only=True)
class ShutdownProcess(Event):
    """The processes that match are asked to end."""

    process_matcher: Callable[[ExecuteProcess], bool]


@dataclass(frozen=True, kw_only=True)
class Shutdown(LaunchDescriptionEntity):
    """The end of all."""

    reason: str


@dataclass(frozen=True, kw_only=True)
class ChangeState:
    """A transition that the nodes which match are asked for."""

    lifecycle_node_matcher: Callable[[LifecycleNode], bool]
    transition_id: int


@dataclass(frozen=True, kw_only=True)
class EmitEvent(LaunchDescriptionEntity):
    """An event that happens at once."""

    event: ChangeState | Event


@dataclass(frozen=True, kw_only=True)
class OnStateTransition:
    """What is done when a node comes from one state to another."""

    target_lifecycle_node: LifecycleNode
    start_state: str
    goal_state: str
    entities: Sequence[EmitEvent]


@dataclass(frozen=True)
class RegisterEventHandler(LaunchDescriptionEntity):
    """A handler that is there from now on."""

    event_handler: OnStateTransition | EventHandler


@dataclass(frozen=True)
class LaunchDescription:
    """All of a launch file, in its order."""

    entities: Sequence[LaunchDescriptionEntity] = field(default_factory=list)


def _matches_action(action: object) -> Callable[[object], bool]:
    return lambda other: other is action


_MODULES: dict[str, dict[str, object]] = {
    "launch": {
        "Event": Event,
        "EventHandler": EventHandler,
        "LaunchContext": object,
        "LaunchDescription": LaunchDescription,
        "LaunchDescriptionEntity": LaunchDescriptionEntity,
        "SomeSubstitutionsType": object,
    },
    "launch.actions": {
        "DeclareLaunchArgument": DeclareLaunchArgument,
        "EmitEvent": EmitEvent,
        "ExecuteProcess": ExecuteProcess,
        "RegisterEventHandler": RegisterEventHandler,
        "Shutdown": Shutdown,
    },
    "launch.event_handlers": {"OnProcessExit": OnProcessExit},
    "launch.events": {"matches_action": _matches_action},
    "launch.events.process": {"ProcessExited": ProcessExited, "ShutdownProcess": ShutdownProcess},
    "launch.substitutions": {"LaunchConfiguration": LaunchConfiguration},
    "launch_ros": {},
    "launch_ros.actions": {"LifecycleNode": LifecycleNode, "Node": Node},
    "launch_ros.event_handlers": {"OnStateTransition": OnStateTransition},
    "launch_ros.events": {},
    "launch_ros.events.lifecycle": {"ChangeState": ChangeState},
}


def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `import launch` and `import launch_ros` find what is here."""
    for name, members in _MODULES.items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)


def described(file: Path, monkeypatch: pytest.MonkeyPatch) -> LaunchDescription:
    """What a launch file describes."""
    stand_in(monkeypatch)
    found = runpy.run_path(str(file))["generate_launch_description"]()
    assert isinstance(found, LaunchDescription)
    return found


class Launch:
    """Runs a launch description; use it as a context manager.

    Attributes:
        transitions: (node, state it has come to), in the order in which they were told.
        exits: (process, exit code), in the order in which they were seen.
        commands: the command line of every node, by name.
        shut_down: why it was shut down, if it was.
    """

    def __init__(self, ros: Ros, folder: Path, description: LaunchDescription, **arguments: str) -> None:
        self.transitions: list[tuple[str, str]] = []
        self.exits: list[tuple[str, int]] = []
        self.shut_down: str | None = None
        self.commands: dict[str, list[str]] = {}
        self._ros = ros
        self._folder = folder
        self._description = description
        self._arguments = dict(arguments)
        self._peer = ros.peer("launch")
        self._handlers: list[OnStateTransition | EventHandler] = []
        self._processes: dict[Node | ExecuteProcess, subprocess.Popen[str]] = {}
        self._subscriptions: dict[LifecycleNode, Any] = {}
        self._asked: list[ChangeState] = []

    def __enter__(self) -> Self:
        """Start everything in its order."""
        try:
            for entity in self._description.entities:
                self.do(entity)
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in self._processes.values():
            process.terminate()
        for process in self._processes.values():
            try:
                process.communicate(timeout=DEADLINE_S)
            finally:
                process.kill()

    def do(self, entity: LaunchDescriptionEntity) -> None:
        """Do what one entity says."""
        match entity:
            case DeclareLaunchArgument(name, default_value):
                assert name in self._arguments or default_value is not None
                self._arguments.setdefault(name, str(default_value))
            case RegisterEventHandler(handler):
                self._handlers.append(handler)
            case Node():
                self._start_node(entity)
            case ExecuteProcess():
                for more in entity.execute(self) or []:
                    self.do(more)
            case EmitEvent(event=ChangeState() as event):
                self._asked.append(event)
            case EmitEvent(event=Event() as event):
                self._happens(event)
            case Shutdown(reason=reason):
                self.shut_down = reason
                for process in self._processes.values():
                    process.send_signal(signal.SIGINT)
            case _:
                raise TypeError(f"the stand-in knows no {entity!r}")

    def start(self, action: Node | ExecuteProcess, command: list[str]) -> None:
        """Start the process of an action."""
        self._processes[action] = subprocess.Popen(
            command, env={**os.environ, **self._ros.environment}, stderr=subprocess.PIPE, text=True
        )

    def value(self, part: object) -> object:
        """The value of an argument; anything else is itself."""
        return self._arguments[part.variable_name] if isinstance(part, LaunchConfiguration) else part

    def until_over(self) -> None:
        """Do what the description asks for, until every process has ended."""
        end = time.monotonic() + DEADLINE_S
        over: set[ExecuteProcess | Node] = set()
        while len(over) < len(self._processes):
            assert time.monotonic() < end, f"processes are left after {DEADLINE_S:g} s; ended: {self.exits}"
            self._ros.turn(_INTERVAL_S)
            for action, process in list(self._processes.items()):
                if action not in over and (code := process.poll()) is not None:
                    over.add(action)
                    self.exits.append((str(self.value(action.name)), code))
                    if isinstance(action, ExecuteProcess):
                        self._happens(ProcessExited(action, code))

    def _happens(self, event: Event) -> None:
        if isinstance(event, ShutdownProcess):
            for action, process in self._processes.items():
                if isinstance(action, ExecuteProcess) and event.process_matcher(action):
                    process.send_signal(signal.SIGINT)
        for handler in list(self._handlers):
            if isinstance(handler, EventHandler) and handler.matches(event):
                for entity in handler.handle(event, self) or []:
                    self.do(entity)

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

    def _start_node(self, node: Node) -> None:
        if isinstance(node, LifecycleNode):
            self._listen(node)
        name = str(self.value(node.name))
        self.commands[name] = command = self._command(node, name)
        self.start(node, command)

    def _listen(self, node: LifecycleNode) -> None:
        from lifecycle_msgs.msg import TransitionEvent  # noqa: PLC0415 only where ROS is installed

        def came(event: Any) -> None:  # noqa: ANN401 types of rclpy
            start, goal = event.start_state.label, event.goal_state.label
            if goal in ("inactive", "active"):
                self.transitions.append((node.name, goal))
            for handler in self._handlers:
                if (
                    isinstance(handler, OnStateTransition)
                    and handler.target_lifecycle_node is node
                    and (handler.start_state, handler.goal_state) == (start, goal)
                ):
                    for entity in handler.entities:
                        self.do(entity)

        topic = f"{node.path}/transition_event"
        self._subscriptions[node] = self._peer.create_subscription(TransitionEvent, topic, came, 10)

    def _command(self, node: Node, name: str) -> list[str]:
        """The command line as launch_ros makes it: names as remappings, parameters in a file."""
        from ament_index_python.packages import get_package_prefix  # noqa: PLC0415 only where ROS is installed

        program = node.executable
        if node.package is not None:
            program = str(Path(get_package_prefix(node.package)) / "lib" / node.package / program)
        command = [program, *node.arguments, "--ros-args", "-r", f"__node:={name}"]
        namespace = str(self.value(node.namespace))
        if namespace:
            command += ["-r", f"__ns:=/{namespace}"]
        for number, parameters in enumerate(node.parameters):
            values = {key: self.value(value) for key, value in parameters.items()}
            file = self._folder / f"{name}.{number}.yaml"
            path = f"/{namespace}/{name}" if namespace else f"/{name}"
            file.write_text(yaml.safe_dump({path: {"ros__parameters": values}}), encoding="utf-8")
            command += ["--params-file", str(file)]
        for source, target in node.remappings:
            command += ["-r", f"{source}:={target}"]
        return command

    def _change(self, change: ChangeState) -> None:
        from lifecycle_msgs.srv import ChangeState as Service  # noqa: PLC0415 only where ROS is installed

        for node in filter(change.lifecycle_node_matcher, self._subscriptions):
            client = self._peer.create_client(Service, f"{node.path}/change_state")
            self._ros.matched(self._subscriptions[node])
            self._ros.known_to(node.path, self._peer)
            request = Service.Request()
            request.transition.id = change.transition_id
            answer = self._ros.called(client, request, once=True)
            assert answer.success, f"{node.path} refused transition {change.transition_id}"
