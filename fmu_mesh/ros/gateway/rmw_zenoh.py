"""The profile of rmw_zenoh: the mesh is one ROS node with publishers, subscribers and services, without a bridge.

Keys are `<domain>/<name>/<type in DDS>/<hash>`. Tokens are
`@ros2_lv/<domain>/<zid>/<node>/<entity>/<kind>/<enclave>/<namespace>/<node name>/<name>/<type>/<hash>/<qos>` with `%`
for every slash within a part. Every sample, request and response has an attachment: sequence number, time in ns, and
the 16 bytes that identify its sender (rmw_zenoh, docs/design.md).

Services of this node are how ROS reads and sets the parameters of all instances.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import zenoh

from ...config.mesh import Qos
from ...errors import FmuMeshError
from ...installing import importing
from ...system.start_values import why_not_settable
from ...variables.model_description import Value, Variable
from ...variables.value_types import is_float
from ...wire.keys import Keys
from ...wire.messages import decode_json
from ...wire.session import Question, ask
from ...wire.values import encode_origin, encode_value
from ..messages.cdr import CdrError, Codec, Message
from ..messages.ros_names import absolute, dds_type, service_name
from ..messages.stamp import nanoseconds
from ..messages.topics import NodeParameter, RosPlan
from .profile import ZenohProfile
from .service_threads import Service, ServiceThreads

__all__ = ["SERVICES", "ParameterServices", "RmwZenoh", "decode_attachment"]

_ATTACHMENT = struct.Struct("<qqB16s")
_SHORT_ATTACHMENT = struct.Struct("<qq16s")
_GID_SIZE = 16
_RELIABILITY, _DURABILITY, _KEEP_LAST = {"reliable": 1, "best_effort": 2}, {"volatile": 2, "transient_local": 1}, 1
_NO_HASH = "TypeHashNotSupported"

SERVICES = {
    "GetParameters": ("string[] names\n", "rcl_interfaces/ParameterValue[] values\n"),
    "GetParameterTypes": ("string[] names\n", "uint8[] types\n"),
    "SetParameters": ("rcl_interfaces/Parameter[] parameters\n", "rcl_interfaces/SetParametersResult[] results\n"),
    "ListParameters": ("string[] prefixes\nuint64 depth\n", "rcl_interfaces/ListParametersResult result\n"),
    "DescribeParameters": ("string[] names\n", "rcl_interfaces/ParameterDescriptor[] descriptors\n"),
}
"""Request and response of each service (package rcl_interfaces)."""

_ANSWER_S = 2.0
_WHO = "ros set_parameters"
_NOT_SET, _BOOL, _INTEGER, _DOUBLE, _STRING = range(5)
_VALUE_FIELDS = {_BOOL: "bool_value", _INTEGER: "integer_value", _DOUBLE: "double_value", _STRING: "string_value"}


class RmwZenoh(ZenohProfile):
    """One ROS node on Zenoh; the source time of a sample is its simulation time."""

    def __init__(self, session: zenoh.Session, plan: RosPlan, domain: int) -> None:
        super().__init__(session, plan.types)
        self._domain = domain
        self._entities = itertools.count(1)
        self._node = f"%/{_mangled(plan.namespace)}/{plan.node}"
        node = f"@ros2_lv/{domain}/{session.zid()}/0/0/NN/{self._node}"
        self._tokens.append(session.liveliness().declare_token(node))

    def serve(self, name: str, kind: str, service: Service) -> None:
        """Declare the server of the service ``name``; its type ``kind`` has to be defined in the message types."""
        key = self._key(name, kind)
        request_codec = Codec(self._types, f"{kind}_Request")
        response_codec = Codec(self._types, f"{kind}_Response")

        def answer(query: zenoh.Query) -> None:
            try:
                sequence, time_ns, gid = decode_attachment(query.attachment)
                request = request_codec.decode(query.payload.to_bytes() if query.payload is not None else b"")
            except CdrError as error:
                query.reply_err(f"'{name}': {error}")
                query.drop()
                return

            def reply(response: Message) -> None:
                own = _ATTACHMENT.pack(sequence, time_ns, _GID_SIZE, gid)
                query.reply(key, response_codec.encode(response), attachment=own)
                query.drop()

            service(request, reply)

        self._others.append(self._session.declare_queryable(key, answer, complete=True))
        self._announce("SS", name, kind, Qos())

    def _key(self, name: str, message: str) -> str:
        return f"{self._domain}/{name.strip('/')}/{dds_type(message)}/{self._hash(message)}"

    def _token(self, kind: str, name: str, message: str, qos: Qos) -> str:
        deadline = "{},{}".format(*divmod(nanoseconds(qos.deadline), 10**9)) if qos.deadline is not None else ","
        words = (
            f"{_RELIABILITY[qos.reliability]}:{_DURABILITY[qos.durability]}:{_KEEP_LAST},{qos.depth}:{deadline}:,:,,"
        )
        own = f"{_mangled(name)}/{dds_type(message)}/{self._hash(message)}/{words}"
        return f"@ros2_lv/{self._domain}/{self._session.zid()}/0/{next(self._entities)}/{kind}/{self._node}/{own}"

    def _attached(self, token: str) -> Callable[[float], bytes | None]:
        with importing("xxhash", "topics of rmw_zenoh"):
            import xxhash  # noqa: PLC0415  an optional dependency

        number = xxhash.xxh3_128_intdigest(token.encode())
        gid = struct.pack("<QQ", number & (1 << 64) - 1, number >> 64)
        sequence = itertools.count(1)
        return lambda time: _ATTACHMENT.pack(next(sequence), nanoseconds(time), _GID_SIZE, gid)

    def _hash(self, message: str) -> str:
        return _NO_HASH if self._types.distribution == "humble" else self._types.type_hash(message)


def decode_attachment(attachment: zenoh.ZBytes | None) -> tuple[int, int, bytes]:
    """Sequence number, time in ns and sender of an attachment, with or without the length of the sender.

    Raises:
        CdrError: it is not an attachment of rmw_zenoh.
    """
    data = attachment.to_bytes() if attachment is not None else b""
    if len(data) == _ATTACHMENT.size and data[_ATTACHMENT.size - _GID_SIZE - 1] == _GID_SIZE:
        sequence, time_ns, _size, gid = _ATTACHMENT.unpack(data)
    elif len(data) == _SHORT_ATTACHMENT.size:
        sequence, time_ns, gid = _SHORT_ATTACHMENT.unpack(data)
    else:
        raise CdrError(f"an attachment of {len(data)} bytes where sequence number, time and sender should be")
    return sequence, time_ns, gid


def _mangled(name: str) -> str:
    return name.replace("/", "%")


class ParameterServices:
    """Answers for the parameters of one mesh.

    A parameter is named `<instance>.<variable>`. If the mesh refuses a value (a fixed parameter, a value out of range),
    the service answers with the same reason.

    The messages of the services are added to the types of the plan. The caller closes the session.
    """

    def __init__(self, plan: RosPlan, mesh: zenoh.Session, keys: Keys) -> None:
        self._plan = plan
        self._mesh = mesh
        self._keys = keys
        self._parameters = {parameter.name: parameter for parameter in plan.parameters}
        for name, (request, response) in SERVICES.items():
            plan.types.define_service(f"rcl_interfaces/srv/{name}", request, response)
        self._no_value = Codec(plan.types, "rcl_interfaces/msg/ParameterValue").empty()
        self._no_descriptor = Codec(plan.types, "rcl_interfaces/msg/ParameterDescriptor").empty()

    @contextmanager
    def served_by(self, node: RmwZenoh) -> Iterator[None]:
        """Offer the services of ``node`` within the context."""
        answers = self._get, self._get_types, self._set, self._list, self._describe
        with ServiceThreads("parameters") as threads:
            for kind, answer in zip(SERVICES, answers, strict=True):
                full_name = absolute(f"{self._plan.node}/{service_name(kind)}", self._plan.namespace)
                node.serve(full_name, f"rcl_interfaces/srv/{kind}", threads.service(answer))
            yield

    # --- the services

    def _get(self, request: Message) -> Message:
        return {"values": [self._value(name) for name in request["names"]]}

    def _get_types(self, request: Message) -> Message:
        kinds = [self._parameters.get(name) for name in request["names"]]
        return {"types": [_kind(own.variable) if own is not None else _NOT_SET for own in kinds]}

    def _set(self, request: Message) -> Message:
        results = [self._set_one(own["name"], own["value"]) for own in request["parameters"]]
        return {"results": [{"successful": not reason, "reason": reason} for reason in results]}

    def _list(self, request: Message) -> Message:
        wanted = [
            name
            for name in self._parameters
            if not request["prefixes"] or any(name == p or name.startswith(f"{p}.") for p in request["prefixes"])
        ]
        return {"result": {"names": wanted, "prefixes": sorted({name.partition(".")[0] for name in wanted})}}

    def _describe(self, request: Message) -> Message:
        return {"descriptors": [self._descriptor(name) for name in request["names"]]}

    def _descriptor(self, name: str) -> Message:
        parameter = self._parameters.get(name)
        if parameter is None:
            return {**self._no_descriptor, "name": name, "read_only": True}
        variable = parameter.variable
        ranges: list[Message] = []
        if variable.minimum is not None and variable.maximum is not None:
            ranges = [{"from_value": variable.minimum, "to_value": variable.maximum, "step": 0.0}]
        double = _kind(variable) == _DOUBLE
        return {
            "name": name,
            "type": _kind(variable),
            "description": variable.description or "",
            "additional_constraints": f"unit: {variable.unit}" if variable.unit else "",
            "read_only": why_not_settable(variable, None) is not None,
            "dynamic_typing": False,
            "floating_point_range": ranges if double else [],
            "integer_range": [] if double else [{name: int(limit) for name, limit in own.items()} for own in ranges],
        }

    # --- the mesh

    def _value(self, name: str) -> Message:
        parameter = self._parameters.get(name)
        value = self._ask(parameter)[0] if parameter is not None else None
        if parameter is None or value is None:
            return self._no_value
        kind = _kind(parameter.variable)
        return {**self._no_value, "type": kind, _VALUE_FIELDS[kind]: float(value) if kind == _DOUBLE else value}

    def _set_one(self, name: str, value: Message) -> str:
        """Set one parameter; returns why it was refused, or an empty text."""
        parameter = self._parameters.get(name)
        if parameter is None:
            return f"there is no parameter '{name}'"
        field = _VALUE_FIELDS.get(value["type"])
        if field is None:
            return f"'{name}' takes one value, a {parameter.variable.type}"
        return self._ask(parameter, value[field])[1]

    def _ask(self, parameter: NodeParameter, value: Value | None = None) -> tuple[Any, str]:
        """Get the value, or set a new one; returns the answer of the mesh, and why it refused or an empty text."""
        key = self._keys.variable(parameter.instance, "param", parameter.variable.name)
        payload = encode_value(value) if value is not None else None
        question = Question(key, f"'{parameter.name}'", _ANSWER_S, payload, encode_origin(None, _WHO))
        try:
            return decode_json(ask(self._mesh, question), object), ""
        except FmuMeshError as error:
            return None, error.message


def _kind(variable: Variable) -> int:
    """The number of the parameter type in ROS (`rcl_interfaces/msg/ParameterType`)."""
    return _DOUBLE if is_float(variable.type) else {"Boolean": _BOOL, "String": _STRING}.get(variable.type, _INTEGER)
