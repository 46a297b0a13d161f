"""Ready shapes: one line in `ros: topics:` that stands for a usual message, such as `joint_states: world`.

Owns which variables go where in these messages. A shape becomes an ordinary topic with type, fields and constants
before the topics are resolved, so nobody else knows shapes. Joints and bodies are found by the ends of names that all
physics engines have here (`fmu_mesh.instances.world_variables`); every instance with such names has them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import msgspec

from ...config.findings import Findings
from ...config.mesh import RosTopicConfig
from ...ros_wire.fitting import TopicEntry
from ...ros_wire.topics import Descriptions
from ...text import listed, nearest
from ...variables.model_description import ModelDescription

__all__ = ["expanded"]

_WORLD = "world"
"""The frame of the poses and velocities of all bodies. They are in world axes, so no other body can be their parent."""
_JOINT = {"position": "position", "velocity": "velocity", "effort": "effort_applied"}
_TRANSFORM = {"translation": "position", "rotation": "orientation"}
_QUATERNIONS = ("orientation", "rotation")


class _Shape(msgspec.Struct, frozen=True):
    """The message of a shape, and the fields of its vectors; the end of a field is the part in the configuration."""

    topic: str
    message: str
    vectors: tuple[str, ...] = ()
    of_body: Mapping[str, str] = {}  # by part that a body has in the right axes: the end of its variables


_SHAPES = {
    "joint_states": _Shape("joint_states", "sensor_msgs/msg/JointState"),
    "tf": _Shape("tf", "tf2_msgs/msg/TFMessage"),
    "odometry": _Shape(
        "odom",
        "nav_msgs/msg/Odometry",
        ("pose.pose.position", "pose.pose.orientation", "twist.twist.linear", "twist.twist.angular"),
        {
            "position": "position",
            "orientation": "orientation",
            "linear": "body_linear_velocity",
            "angular": "body_angular_velocity",
        },
    ),
    "imu": _Shape(
        "imu",
        "sensor_msgs/msg/Imu",
        ("orientation", "angular_velocity", "linear_acceleration"),
        {"orientation": "orientation"},
    ),
    "wrench": _Shape(
        "wrench",
        "geometry_msgs/msg/WrenchStamped",
        ("wrench.force", "wrench.torque"),
        {"force": "force", "torque": "moment"},
    ),
    "twist": _Shape(
        "twist",
        "geometry_msgs/msg/TwistStamped",
        ("twist.linear", "twist.angular"),
        {"linear": "linear_velocity", "angular": "angular_velocity"},
    ),
}


def expanded(
    entry: TopicEntry, instances: Iterable[str], descriptions: Descriptions, findings: Findings
) -> TopicEntry | None:
    """The entry with fields instead of a ready shape; None after a finding, or if an instance could not be read."""
    item = entry.item
    chosen = [name for name in _SHAPES if getattr(item, name) is not None]
    if not chosen:
        return entry
    several = [*chosen, *(key for key in ("variable", "fields") if getattr(item, key))]
    if len(several) > 1:
        findings.add(entry.path, f"both `{several[0]}` and `{several[1]}`", "one of them")
        return None
    before = len(findings)
    made = _Expansion(entry, chosen[0], instances, descriptions, findings).made()
    if len(findings) > before or not made.fields:
        return None
    return msgspec.structs.replace(entry, item=made, shape=f"{entry.path}.{chosen[0]}")


class _Expansion:
    """One entry on its way from a shape to fields."""

    def __init__(
        self, entry: TopicEntry, name: str, instances: Iterable[str], descriptions: Descriptions, findings: Findings
    ) -> None:
        self._entry, self._item, self._name = entry, entry.item, name
        self._instances = list(instances)
        self._descriptions = descriptions
        self._findings = findings
        self._fields: dict[str, str] = {}
        self._constants: dict[str, str | float | int | bool] = {}
        self._frame = ""

    def made(self) -> RosTopicConfig:
        """The item with fields and constants; after a finding it is incomplete."""
        given, shape, name = getattr(self._item, self._name), _SHAPES[self._name], self._name
        message, plain = self._item.type or shape.message, shape.message.removesuffix("Stamped")
        if message not in (shape.message, plain):
            expected = shape.message if plain == shape.message else f"{shape.message} or {plain}"
            self._findings.add(f"{self._entry.path}.type", f"'{message}' for `{name}`", expected)
        if name in ("joint_states", "tf"):
            (self._joints if name == "joint_states" else self._transforms)([given] if isinstance(given, str) else given)
        else:
            # Without a header, the fields are those of the message itself.
            vectors = [field.removeprefix(f"{name}.") if message == plain else field for field in shape.vectors]
            fields = {field.rpartition(".")[2]: field for field in vectors}
            self._vectors(fields, shape.of_body, {"body": given} if isinstance(given, str) else given)
        return msgspec.structs.replace(
            self._item,
            topic=self._item.topic or shape.topic,
            type=message,
            fields=self._fields,
            constants=self._constants | self._item.constants,
            frame_id=self._item.frame_id or self._frame,
            **{name: None},
        )

    def _joints(self, references: Iterable[str]) -> None:
        for instance, joint, description in self._named(references, "joint", ".position"):
            for field, end in _JOINT.items():
                if description.variable(f"{joint}.{end}") is not None:
                    self._fields[f"{field}[name={_quoted(joint)}]"] = f"{instance}.{joint}.{end}"

    def _transforms(self, references: Iterable[str]) -> None:
        self._frame = _WORLD
        for instance, body, _ in self._named(references, "body", ".orientation_w"):
            for field, end in _TRANSFORM.items():
                place = f"transforms[child_frame_id={_quoted(body)}].transform.{field}"
                self._vector(place, f"{instance}.{body}.{end}")

    def _vectors(self, fields: Mapping[str, str], of_body: Mapping[str, str], given: Mapping[str, str]) -> None:
        apart = {key.partition(".")[0] for key in given}
        for key, reference in given.items():
            part, dot, component = key.partition(".")
            if key == "body":
                self._body(fields, {name: end for name, end in of_body.items() if name not in apart}, reference)
            elif part not in fields:
                names = ["body", *fields]
                self._add(f"the unknown part '{part}'", f"one of {listed(names)}", nearest(part, names))
            elif dot:
                self._fields[f"{fields[part]}.{component}"] = reference
            else:
                self._vector(fields[part], reference)
        missing = [part for part in fields if part not in apart and not ("body" in apart and part in of_body)]
        if not given:
            self._add("nothing", f"`instance.vector` by part: {listed(missing)}")
        elif self._name == "odometry" and missing:  # 0 would look like a robot that stands still
            found = f"no {' and no '.join(f'`{part}`' for part in missing)}"
            self._add(found, "a vector for each, of velocities in the axes of the body, such as the value of a sensor")
        elif self._name == "imu":  # -1 says in this message that a part is not measured
            self._constants |= {f"{part}_covariance[0]": -1.0 for part in missing}

    def _body(self, fields: Mapping[str, str], ends: Mapping[str, str], reference: str) -> None:
        bodies = list(self._named([reference], "body", ".orientation_w"))
        if len(bodies) > 1:
            names = [f"{instance}.{body}" for instance, body, _ in bodies]
            self._add(f"the {len(names)} bodies of '{reference}'", f"one of {listed(names)}")
        for instance, body, _ in bodies[:1]:
            self._frame = {"imu": body, "wrench": ""}.get(self._name, _WORLD)
            if self._name == "odometry":
                self._constants["child_frame_id"] = body
            for part, end in ends.items():
                self._vector(fields[part], f"{instance}.{body}.{end}")

    def _named(self, references: Iterable[str], what: str, end: str) -> Iterator[tuple[str, str, ModelDescription]]:
        """(instance, joint or body, description) of all that have an output with this ``end``, or of the one named."""
        seen: dict[str, str] = {}
        for reference in references:
            instance, dot, name = reference.partition(".")
            description = self._description(instance)
            if description is None:
                continue
            outputs = [own.name for own in description.with_causality("output")]
            names = [own.removesuffix(end) for own in outputs if own.endswith(end)]
            if not names:
                self._add(f"'{instance}', which has no {what}", f"an instance with variables `<{what}>{end}`")
            elif dot and name not in names:
                found = f"the unknown {what} '{name}' of instance '{instance}'"
                self._add(found, f"one of {listed(names)}", nearest(name, names))
            for own in names if not dot else {name} & {*names}:
                if seen.setdefault(own, instance) != instance:
                    self._add(f"the {what} '{own}' of '{seen[own]}' and of '{instance}'", "a topic for each instance")
                yield instance, own, description

    def _vector(self, field: str, reference: str) -> None:
        """Add the components of a vector: variables with the ends `_x`, `.x` or `[1]` and so on."""
        instance, _, name = reference.partition(".")
        description = self._description(instance)
        if description is None:
            return
        letters = "xyzw" if field.endswith(_QUATERNIONS) else "xyz"
        ends = [[f"{sign}{letter}" for letter in letters] for sign in "_."]
        if letters == "xyz":  # of a quaternion, the number says nothing: MuJoCo has w first, Modelica last
            ends.append(["[1]", "[2]", "[3]"])
        for own in ends:
            if all(description.variable(name + end) is not None for end in own):
                self._fields |= {f"{field}.{letter}": reference + end for letter, end in zip(letters, own, strict=True)}
                return
        names = {own.name: None for own in description.variables}
        stems = [own.removesuffix(last) for own in names for *_, last in ends if own.endswith(last)]
        near = nearest(name, [stem for stem in stems if any(all(stem + end in names for end in own) for own in ends)])
        part = field.rpartition(".")[2]
        expected = f"a name before {' or '.join(', '.join(end) for end in ends)}, or each component (`{part}.x: …`)"
        self._add(f"'{reference}', which is no such vector", expected, near)

    def _description(self, instance: str) -> ModelDescription | None:
        if instance not in self._instances:
            expected = f"one of the instances {listed(self._instances)}"
            self._add(f"the unknown instance '{instance}'", expected, nearest(instance, self._instances))
        return self._descriptions.get(instance)

    def _add(self, found: str, expected: str, suggestion: str | None = None) -> None:
        self._findings.add(f"{self._entry.path}.{self._name}", found, expected, suggestion)


def _quoted(text: str) -> str:
    """A key of a path; in quotes if a sign of it would end the key."""
    if "]" not in text and text[0] not in "\"'":
        return text
    return f"'{text}'" if '"' in text else f'"{text}"'
