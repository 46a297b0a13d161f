"""The parameters of all instances as those of the ROS node of a mesh: the services by which ROS reads and sets them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import zenoh

from ...errors import FmuMeshError
from ...ros_wire.cdr import Codec, Message
from ...ros_wire.rmw_zenoh import RmwZenoh
from ...ros_wire.ros_names import absolute, service_name
from ...ros_wire.topics import NodeParameter, RosPlan
from ...system.start_values import why_not_settable
from ...variables.model_description import Value, Variable
from ...variables.value_types import is_float
from ...wire.keys import Keys
from ...wire.messages import decode_json
from ...wire.session import Question, ask
from ...wire.values import encode_origin, encode_value
from .service_threads import ServiceThreads

__all__ = ["SERVICES", "ParameterServices"]

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
        instance, name = parameter.instance, parameter.variable.name
        payload = encode_value(value) if value is not None else None
        key = self._keys.variable(instance, "param", name) if value is None else self._keys.setting(instance, name)
        question = Question(key, f"'{parameter.name}'", _ANSWER_S, payload, encode_origin(None, _WHO))
        try:
            return decode_json(ask(self._mesh, question), object), ""
        except FmuMeshError as error:
            return None, error.message


def _kind(variable: Variable) -> int:
    """The number of the parameter type in ROS (`rcl_interfaces/msg/ParameterType`)."""
    return _DOUBLE if is_float(variable.type) else {"Boolean": _BOOL, "String": _STRING}.get(variable.type, _INTEGER)
