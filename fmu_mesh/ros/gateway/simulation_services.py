"""The services of `simulation_interfaces`: how programs of ROS pause, step, reset and stop a mesh, and see its bodies.

Owns what each request means for the mesh. `answer` takes and returns plain messages, so it does not matter how they
come: here as queries of Zenoh, in `fmu_mesh.ros.node.simulation_server` through rclpy.
"""

# Threads: requests are answered on several threads at once, because one of them may wait for a long step while others
# ask for the state, or pause. Two steps at once would add up to another one than either asked for, so the second is
# refused (`_stepping`). The mesh itself decides on everything else, and its answer is the result (ADR 0030).
#
# `Settling`: `sent` is called on the thread of the gateway, `__call__` on that of a service. It lets the gateway do a
# job: all messages before it are carried then. A node takes what is put and answers queries in the order in which they
# come, so its answer says that it has all values (ADR 78).

from __future__ import annotations

import math
import queue
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from itertools import chain
from typing import Any

import zenoh

from ... import __version__
from ...config.ros_section import SimulationInterfacesConfig
from ...errors import DeadlineExceeded, FmuMeshError
from ...ros_wire.cdr import Codec, Message
from ...ros_wire.definitions import MessageTypes
from ...ros_wire.rmw_zenoh import RmwZenoh
from ...ros_wire.ros_names import absolute, service_name
from ...ros_wire.simulation_types import (
    SIMULATION_SERVICES,
    ResultCode,
    SimulationStates,
    SimulatorFeature,
    define_simulation_types,
)
from ...ros_wire.stamp import to_stamp
from ...text import EXPRESSION, matched
from ...wire.client.mesh_client import MeshClient
from ...wire.client.readings import Reading, Target
from ...wire.client.waiting import begun_again
from ...wire.keys import Keys
from ...wire.session import Question, ask
from ...wire.views import Command, MeshState
from .service_threads import ServiceThreads

__all__ = ["SIMULATION_THREADS", "Settling", "SimulationServices"]

SIMULATION_THREADS = 4
"""Requests that are answered at once: one step, and others meanwhile."""

_ANSWER_S = 10.0
_CARRIED_S = 10.0
_LONGEST_STEP_S = 3600.0
_LOOKS = 20
_FLAGS = re.compile(r"\(\?[aiLmsux]+\)")
_TIME_AND_STATE = 1 | 2
"""Bits of SCOPE_TIME and SCOPE_STATE; SCOPE_ALL has them, too, and SCOPE_DEFAULT is 0."""
_STATES: dict[MeshState, SimulationStates] = {
    "starting": SimulationStates.LOADING_WORLD,
    "initializing": SimulationStates.LOADING_WORLD,
    "restarting": SimulationStates.LOADING_WORLD,
    "running": SimulationStates.PLAYING,
    "paused": SimulationStates.PLAYING,  # in a step
}
_VECTORS = {"position": "xyz", "orientation": "wxyz", "linear_velocity": "xyz", "angular_velocity": "xyz"}
"""What a body of a world has as outputs (`fmu_mesh.instances.world_variables`), in world axes; the order of a state."""
_SETS = ("state", "pose", "twist")
"""The parameters that set a free body: arrays of numbers in this order."""
_WORLD = "world"


class _Refusal(Exception):
    """A request is answered with this code and text."""

    def __init__(self, code: ResultCode, text: str) -> None:
        super().__init__(text)
        self.code = code


class SimulationServices:
    """Answers requests for one mesh. ``action`` says whether there is the action SimulateSteps, too.

    ``settle`` waits until the mesh has all values that came before a step.
    """

    def __init__(  # noqa: PLR0913  one mesh, and what it offers
        self,
        section: SimulationInterfacesConfig,
        types: MessageTypes,
        mesh: zenoh.Session,
        keys: Keys,
        settle: Callable[[], None],
        *,
        action: bool = False,
    ) -> None:
        define_simulation_types(types)
        self.codecs = {
            kind: tuple(Codec(types, f"simulation_interfaces/srv/{kind}_{part}") for part in ("Request", "Response"))
            for kind in SIMULATION_SERVICES
        }
        self._section = section
        self._action = action
        self._settle = settle
        self._closed = threading.Event()
        self._client = MeshClient(mesh, keys, (), _ANSWER_S, self._closed.is_set)
        self._stepping = threading.Lock()
        self._is_stopped = False
        self._known: dict[str, list[Target]] | None = None
        self._free: dict[str, dict[int, Target]] = {}  # by the size of what they set
        answers = (
            self._features,
            self._get_state,
            self._set_state,
            self._step,
            self._reset,
            self._entities,
            self._get_entity,
            self._set_entity,
        )
        self._answers: dict[str, Callable[[Message], Message]] = dict(zip(SIMULATION_SERVICES, answers, strict=True))

    @contextmanager
    def served_by(self, node: RmwZenoh, namespace: str) -> Iterator[None]:
        """Offer the services of ``node`` within the context."""
        with ServiceThreads("simulation", SIMULATION_THREADS) as threads, closing(self):
            for kind in SIMULATION_SERVICES:
                answer = threads.service(partial(self.answer, kind))
                node.serve(absolute(service_name(kind), namespace), f"simulation_interfaces/srv/{kind}", answer)
            yield

    def close(self) -> None:
        """Requests that wait for the mesh do not wait any more."""
        self._closed.set()

    def answer(self, kind: str, request: Message) -> Message:
        """The response to a request of a service; a failure is its result. On any thread."""
        response = self.codecs[kind][1].empty()
        code, text = ResultCode.OPERATION_FAILED, "the gateway to ROS ends"
        try:
            if not self._closed.is_set():
                response.update(self._answers[kind](request))
                code, text = ResultCode.OK, ""
        except _Refusal as refusal:
            code, text = refusal.code, str(refusal)
        except (FmuMeshError, zenoh.ZError) as error:  # Zenoh: the session is closed
            failed = ResultCode.STATE_TRANSITION_ERROR, ResultCode.OPERATION_FAILED
            code, text = failed[kind != "SetSimulationState"], str(error)
        if "result" in response:
            response["result"] = {"result": code, "error_message": text}
        return response

    # --- the simulation

    def _features(self, _request: Message) -> Message:
        features = {*SimulatorFeature}
        if not self._action:
            features.discard(SimulatorFeature.STEP_SIMULATION_ACTION)
        about = f"mesh '{self._client.keys.mesh}' of fmu_mesh {__version__}"
        return {"features": {"features": sorted(features), "spawn_formats": [], "custom_info": about}}

    def _get_state(self, _request: Message) -> Message:
        return {"state": {"state": self._state()}}

    def _state(self) -> SimulationStates:
        status = self._client.status()
        if status.state != "paused" or self._stepping.locked():
            return _STATES.get(status.state, SimulationStates.QUITTING)
        was_stopped = self._is_stopped and status.point == 0  # another program may have let it run since
        return SimulationStates.STOPPED if was_stopped else SimulationStates.PAUSED

    def _set_state(self, request: Message) -> Message:
        target, now = request["state"]["state"], self._state()
        if target == now:
            raise _Refusal(ResultCode.ALREADY_IN_TARGET_STATE, f"the simulation is {now.name.lower()} already")
        match target:
            case SimulationStates.PLAYING:
                self._client.command(Command("resume"))
            case SimulationStates.PAUSED:
                if now != SimulationStates.STOPPED:  # otherwise it rests at its first point
                    self._client.rest(Command("pause"))
            case SimulationStates.STOPPED:
                if now == SimulationStates.PLAYING:
                    self._client.rest(Command("pause"))
                begun_again(self._client, Command("reset"))
            case SimulationStates.QUITTING:
                self._client.command(Command("stop"))
            case _:
                raise _Refusal(ResultCode.INCORRECT_TRANSITION, f"a mesh cannot be set to state {target}")
        self._is_stopped = target == SimulationStates.STOPPED
        return {}

    def _step(self, request: Message) -> Message:
        if (state := self._state()) != SimulationStates.PAUSED or not self._stepping.acquire(blocking=False):
            text = f"the simulation is {state.name.lower()} or steps already: only a paused one can be stepped"
            raise _Refusal(ResultCode.OPERATION_FAILED, text)
        try:
            self._settle()
            if request["steps"]:
                self._client.rest(Command("step", request["steps"], paced=self._section.paced), _LONGEST_STEP_S)
        finally:
            self._stepping.release()
        return {}

    def _reset(self, request: Message) -> Message:
        if request["scope"] and request["scope"] & _TIME_AND_STATE != _TIME_AND_STATE:
            text = "time and state are reset together: the scope has to be SCOPE_ALL, or SCOPE_TIME and SCOPE_STATE"
            raise _Refusal(ResultCode.FEATURE_UNSUPPORTED, text)
        begun_again(self._client, Command("reset"))
        return {}

    # --- the bodies of worlds

    def _entities(self, request: Message) -> Message:
        filters = request["filters"]
        if filters["categories"] or filters["tags"]["tags"] or filters["bounds"]["type"]:
            text = "bodies have no categories, tags and bounds: only the filter by name can be used"
            raise _Refusal(ResultCode.FEATURE_UNSUPPORTED, text)
        bodies, wanted = self._bodies(), filters["filter"]
        flags = first.group() if (first := _FLAGS.match(wanted)) else ""  # Python wants them at the beginning
        try:
            found = matched(f"{EXPRESSION}{flags}.*(?:{wanted[len(flags) :]}).*", bodies) if wanted else bodies
        except ValueError as error:
            text = f"the filter '{wanted}' is no regular expression: {error}"
            raise _Refusal(ResultCode.OPERATION_FAILED, text) from error
        return {"entities": [name for name in bodies if name in found]}

    def _get_entity(self, request: Message) -> Message:
        readings = self._at_one_point(self._body(request["entity"]))
        values = [reading.value if isinstance(reading.value, list) else [reading.value] for reading in readings]
        numbers = chain.from_iterable(values)
        vectors = {what: {axis: next(numbers) for axis in letters} for what, letters in _VECTORS.items()}
        state: dict[str, Any] = self.codecs["GetEntityState"][1].empty()["state"]
        return {
            "state": {
                **state,
                "header": {"stamp": to_stamp(readings[0].time), "frame_id": _WORLD},
                "pose": {"position": vectors["position"], "orientation": vectors["orientation"]},
                "twist": {"linear": vectors["linear_velocity"], "angular": vectors["angular_velocity"]},
            }
        }

    def _set_entity(self, request: Message) -> Message:
        entity, state = request["entity"], request["state"]
        self._body(entity)
        if (free := self._free.get(entity)) is None:
            text = f"'{entity}' has no free joint of MuJoCo: it moves by what acts on it in the mesh, and cannot be set"
            raise _Refusal(ResultCode.OPERATION_FAILED, text)
        if (frame := state["header"]["frame_id"]) not in ("", _WORLD):
            raise _Refusal(ResultCode.OPERATION_FAILED, f"the frame '{frame}': a state is set in the frame '{_WORLD}'")
        position, orientation = state["pose"]["position"], state["pose"]["orientation"]
        pose = [*(position[axis] for axis in "xyz"), *(orientation[axis] for axis in "wxyz")]
        twist = [state["twist"][part][axis] for part in ("linear", "angular") for axis in "xyz"]
        if request["set_pose"] and not (all(map(math.isfinite, pose)) and any(pose[3:])):
            raise _Refusal(ResultCode.INVALID_POSE, f"the pose {pose} (x, y, z; w, x, y, z) is none")
        numbers = [*(pose if request["set_pose"] else ()), *(twist if request["set_twist"] else ())]
        if numbers:  # in one message, so all hold from the same point on
            self._client.set(free[len(numbers)], numbers)
        return {}

    def _body(self, entity: str) -> list[Target]:
        bodies = self._bodies()
        if entity not in bodies:
            raise _Refusal(ResultCode.NOT_FOUND, f"there is no entity '{entity}'")
        return bodies[entity]

    def _bodies(self) -> dict[str, list[Target]]:
        """What has the state of each body of each world, by `instance.body`; asked for once in a run."""
        if self._known is None:
            found: dict[str, list[Target]] = {}
            for instance in self._client.info().instances:
                if self._client.instance_info(instance).kind != "physics_engine":
                    continue
                targets = {target.name: target for target in self._client.targets(f"{instance}.*")}
                for body in (
                    name.removesuffix(".orientation_w") for name in targets if name.endswith(".orientation_w")
                ):
                    found[body] = [targets[f"{body}.{what}_{axis}"] for what in _VECTORS for axis in _VECTORS[what]]
                    own = [targets[name] for what in _SETS if (name := f"{body}.{what}") in targets]
                    if len(own) == len(_SETS):
                        found[body] = own[:1]  # one message has all, also what has been set since this point
                        self._free[body] = {target.variable.shape[0]: target for target in own}
            self._known = found
        return self._known

    def _at_one_point(self, targets: list[Target]) -> list[Reading]:
        """The values of variables of an instance at the same point.

        Outputs that are recorded or connected are in its memory, the others are read at the next point: while the mesh
        runs, an answer may have values of two points.
        """
        for _ in range(_LOOKS):
            readings = self._client.get(targets)
            if len(readings) == len(targets) and len({reading.point for reading in readings}) == 1:
                return readings
        text = f"the outputs of '{targets[0].name.rpartition('.')[0]}' were not read at one point: pause the simulation"
        raise _Refusal(ResultCode.OPERATION_FAILED, f"{text}, or record all of them")


class Settling:
    """Called without arguments, it waits until the nodes have all values of earlier messages.

    Args:
        mesh: a session that reaches the mesh.
        post: lets the gateway do a job after all that it has to do already.

    Raises:
        DeadlineExceeded: (the call) they do not have them in time.
    """

    def __init__(self, mesh: zenoh.Session, post: Callable[[Callable[[], None]], None]) -> None:
        self._mesh = mesh
        self._post = post
        self._keys: dict[str, str] = {}

    def sent(self, key: str) -> None:
        """Note that a value was sent for an instance; a question for ``key``, of one of its variables, comes later."""
        self._keys[key.rpartition("/")[0]] = key  # one question for each instance is enough

    def __call__(self) -> None:
        """See the class."""
        carried: queue.SimpleQueue[list[str]] = queue.SimpleQueue()

        def take() -> None:
            keys, self._keys = self._keys, {}
            carried.put(list(keys.values()))

        self._post(take)
        try:
            keys = carried.get(timeout=_CARRIED_S)
        except queue.Empty:
            raise DeadlineExceeded("the gateway to ROS is too busy to carry the messages before this step") from None
        for key in keys:
            ask(self._mesh, Question(key, f"the instance of '{key}'", _CARRIED_S))
