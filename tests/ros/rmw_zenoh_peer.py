"""A node of an independent implementation of rmw_zenoh in Python, that listens and talks as its arguments say.

Arguments: `sdk` (zenoh-ros2-sdk) or `pyzeros`, and JSON: `port` of the router, `domain`, `subscribe` and `publish`
(message type by topic) and `count`. It prints one JSON line when it has declared its topics, publishes one sample of
each kind for each line that it reads, and prints one JSON line with all that it has received when every subscribed
topic has had `count` samples, more than a tenth of them different ones. Others are described at their functions.
"""

from __future__ import annotations

import asyncio
import dataclasses
import json
import re
import struct
import sys
import threading
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import zenoh

from fmu_mesh.ros.gateway.parameter_services import SERVICES
from fmu_mesh.ros_wire.definitions import MessageTypes
from fmu_mesh.ros_wire.ros_names import service_name
from fmu_mesh.ros_wire.simulation_types import SIMULATION_SERVICES, define_simulation_types


def say(**what: object) -> None:
    print(json.dumps(what), flush=True)  # noqa: T201 (it is the answer)


def plain(message: Any) -> Any:  # noqa: ANN401 any message
    """A message as what the tests compare."""
    if hasattr(message, "twist"):
        stamp = message.header.stamp
        frame = message.header.frame_id
        frame = frame.decode() if isinstance(frame, bytes) else frame
        return [message.twist.linear.x, message.twist.angular.z, int(stamp.sec), int(stamp.nanosec), frame]
    return message.data.decode() if isinstance(message.data, bytes) else message.data


class Collected:
    """What has arrived, told once it is enough."""

    def __init__(self, orders: dict[str, Any]) -> None:
        self.received: dict[str, list[Any]] = {topic: [] for topic in orders["subscribe"]}
        self._different: dict[str, set[str]] = {topic: set() for topic in self.received}
        self._count = orders["count"]
        self._told = False

    def take(self, topic: str, message: Any) -> None:  # noqa: ANN401 any message
        sample = plain(message)
        self.received[topic].append(sample)
        self._different[topic].add(repr(sample))
        enough = all(len(own) >= self._count for own in self.received.values())
        if not self._told and enough and all(len(own) > self._count // 10 for own in self._different.values()):
            self._told = True
            say(received=self.received)


def sdk(orders: dict[str, Any]) -> None:
    """Be a node of zenoh-ros2-sdk."""
    from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber  # noqa: PLC0415  only one of the two is used

    collected = Collected(orders)
    definitions = MessageTypes("kilted")
    # Of a message in messages it would fetch the definitions from the net to compute the hash: both are given.
    place = {"domain_id": orders["domain"], "router_ip": "127.0.0.1", "router_port": orders["port"]}
    subscribers = [
        ROS2Subscriber(
            topic,
            kind,
            lambda message, topic=topic: collected.take(topic, message),
            msg_definition=definitions.definition(kind),
            type_hash=ros_hash(kind),
            **place,
        )
        for topic, kind in orders["subscribe"].items()
    ]
    publishers = {
        kind: ROS2Publisher(topic, kind, msg_definition=definitions.definition(kind), type_hash=ros_hash(kind), **place)
        for topic, kind in orders["publish"].items()
    }
    types = publishers and next(iter(publishers.values())).session_mgr.store.types
    say(declared=len(subscribers) + len(publishers))
    for number, _line in enumerate(sys.stdin, start=1):
        for kind, publisher in publishers.items():
            if kind.endswith("TwistStamped"):
                vector, twist = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Twist"]
                header, time = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
                publisher.publish(
                    header=header(stamp=time(sec=0, nanosec=0), frame_id="sdk"),
                    twist=twist(linear=vector(x=0.5 * number, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=-number)),
                )
            else:
                publisher.publish(data=f"text {number}" if kind.endswith("String") else 0.1 * number)


def ros_hash(kind: str) -> str | None:
    """The hash that ROS itself has computed; None where the peer can do that without the net."""
    if kind.startswith("std_msgs/"):
        return None
    data = json.loads((Path(sys.prefix) / "share" / f"{kind}.json").read_text())
    found: str = data["type_hashes"][0]["hash_string"]
    return found


def message_class(kind: str) -> Any:  # noqa: ANN401 a class
    """A message of ros2_pyterfaces, the types of pyzeros."""
    from ros2_pyterfaces.cyclone import all_msgs  # noqa: PLC0415  only one of the two is used

    return getattr(all_msgs, kind.rpartition("/")[2])


def message(kind: str, number: int) -> Any:  # noqa: ANN401 any message
    """A message of pyzeros."""
    made = message_class(kind)()
    if kind.endswith("TwistStamped"):
        made.twist.linear.x, made.twist.angular.z, made.header.frame_id = 0.5 * number, -float(number), "zeros"
    else:
        made.data = f"text {number}" if kind.endswith("String") else 0.1 * number
    return made


def lyrical(orders: dict[str, Any]) -> None:
    """Be a node of Lyrical's rmw_zenoh, whose types with uint8[] have tokens of 14 parts and keys of their own.

    Written after its source (0.10.5 and later): such a publisher uses the usual key only while somebody subscribes
    whose token has 13 parts; without a subscriber it would send nothing, here it uses its own key. A subscriber has
    both. For each line that it reads it sends ``data`` and prints where, and what came last.
    """
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415  only needed here

    store, domain = get_typestore(Stores.ROS2_KILTED), orders["domain"]
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{orders["port"]}"]')
    received: dict[str, list[int]] = {}
    others: set[str] = set()

    def token_changed(sample: zenoh.Sample) -> None:
        (others.add if sample.kind == zenoh.SampleKind.PUT else others.discard)(str(sample.key_expr))

    with zenoh.open(config) as session:
        place, alive = f"@ros2_lv/{domain}/{session.zid()}/0", session.liveliness()
        kept: list[Any] = []

        def declare(number: int, word: str, topic: str, kind: str) -> str:
            typed = f"{kind.replace('/msg/', '::msg::dds_::')}_/{ros_hash(kind)}"
            own = f"{place}/{number}/{word}/%/%/lyrical/{topic.replace('/', '%')}/{typed}/::,10:,:,:,,/backends:cpu"
            assert len(own.split("/")) == 14
            kept.append(alive.declare_token(own))
            return f"{domain}{topic}/{typed}"

        kept.append(alive.declare_token(f"{place}/0/NN/%/%/lyrical"))
        kept.append(alive.declare_subscriber(f"@ros2_lv/{domain}/*/*/*/MS/**", token_changed, history=True))
        for number, (topic, kind) in enumerate(orders["subscribe"].items(), start=1):
            key = declare(number, "MS", topic, kind)

            def arrived(sample: zenoh.Sample, topic: str = topic, kind: str = kind) -> None:
                made: Any = store.deserialize_cdr(sample.payload.to_bytes(), kind)
                received[topic] = made.data.tolist()

            kept += [session.declare_subscriber(own, arrived) for own in (key, f"{key}/_buf_cpu")]
        keys = {
            topic: declare(number, "MP", topic, kind)
            for number, (topic, kind) in enumerate(orders["publish"].items(), start=100)
        }
        say(declared=len(orders["subscribe"]) + len(keys))
        for number, _line in enumerate(sys.stdin, start=1):
            sent = {}
            for topic, key in keys.items():
                tokens = [token.split("/") for token in others]
                is_usual = any(chunks[9] == topic.replace("/", "%") and len(chunks) == 13 for chunks in tokens)
                attachment = struct.pack("<qqB16s", number, 0, 16, bytes(16))
                data = image(store, orders["data"], orders["publish"][topic])
                session.put(key if is_usual else f"{key}/_buf_cpu", data, attachment=attachment)
                sent[topic] = "usual" if is_usual else "_buf_cpu"
            say(sent=sent, received=dict(received))
        for own in kept:
            own.undeclare()


def image(store: Any, data: list[int], kind: str) -> bytes:  # noqa: ANN401 a store of rosbags
    """An image with this data, as rosbags writes it."""
    header, time = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    head, array = header(stamp=time(sec=0, nanosec=0), frame_id=""), np.array(data, np.uint8)
    made = store.types[kind](head, 1, len(data), "mono8", 0, len(data), array)
    return bytes(store.serialize_cdr(made, kind))


def lines_of(stream: TextIO) -> asyncio.Queue[str | None]:
    """The lines of a stream for the loop that runs, and None at its end."""
    lines: asyncio.Queue[str | None] = asyncio.Queue()
    loop = asyncio.get_running_loop()

    def read() -> None:
        for line in stream:
            loop.call_soon_threadsafe(lines.put_nowait, line)
        loop.call_soon_threadsafe(lines.put_nowait, None)

    threading.Thread(target=read, daemon=True).start()
    return lines


def pyzeros(orders: dict[str, Any]) -> None:
    """Be a node of pyzeros."""
    import asyncio_for_robotics as robotics  # noqa: PLC0415  only one of the two is used
    import pyzeros as zeros  # noqa: PLC0415  likewise
    from pyzeros.builtin_msgs import Attachment  # noqa: PLC0415  likewise

    # Its own code for the attachment is compiled at the first use, for a minute; the other peer's is left as it is.
    Attachment.serialize = lambda own: (
        bytes(4)
        + struct.pack("<qqB16s", int(own.sequence_number), int(own.source_timestamp), 16, bytes(own.source_gid))
    )
    collected = Collected(orders)

    async def listen(topic: str, subscriber: Any) -> None:  # noqa: ANN401 a subscriber of pyzeros
        async for own in subscriber.listen_reliable(queue_size=10_000):
            collected.take(topic, own)

    @robotics.scoped  # type: ignore[untyped-decorator]  # pyzeros is not always there, so mypy leaves it out
    async def talk() -> None:
        group = robotics.Scope.current().task_group
        for topic, kind in orders["subscribe"].items():
            group.create_task(listen(topic, zeros.Sub(message_class(kind), topic)))
        publishers = {kind: zeros.Pub(message_class(kind), topic) for topic, kind in orders["publish"].items()}
        lines = lines_of(sys.stdin)
        say(declared=len(orders["subscribe"]) + len(publishers))
        number = 0
        while await lines.get() is not None:
            number += 1
            for kind, publisher in publishers.items():
                publisher.publish(message(kind, number))
        robotics.Scope.current().cancel()

    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{orders["port"]}"]')
    with (
        zenoh.open(config) as session,
        zeros.auto_context(node="zeros", zenoh_session=session, domain_id=orders["domain"]),
    ):
        asyncio.run(talk())


def parameters(orders: dict[str, Any]) -> None:
    """Get, set and list parameters of a node as a client of zenoh-ros2-sdk; prints the answers."""
    from zenoh_ros2_sdk import ROS2ServiceClient  # noqa: PLC0415  only one of the two is used
    from zenoh_ros2_sdk.session import ZenohSession  # noqa: PLC0415  likewise

    types = MessageTypes("kilted")
    store = ZenohSession.get_instance("127.0.0.1", orders["port"])
    for name in ("rcl_interfaces/msg/Parameter", "rcl_interfaces/msg/SetParametersResult"):
        store.register_message_type(types.definition(name), name)
    value, parameter = (store.store.types[f"rcl_interfaces/msg/{name}"] for name in ("ParameterValue", "Parameter"))

    def client(service: str) -> Any:  # noqa: ANN401 a client
        camel = "".join(word.capitalize() for word in service.split("_"))
        kind = f"rcl_interfaces/srv/{camel}"
        file = Path(sys.prefix) / "share" / f"{kind}.json"
        hashes = {own["type_name"]: own["hash_string"] for own in json.loads(file.read_text())["type_hashes"]}
        return ROS2ServiceClient(
            f"{orders['node']}/{service}",
            kind,
            request_definition=SERVICES[camel][0],
            response_definition=SERVICES[camel][1],
            domain_id=orders["domain"],
            router_ip="127.0.0.1",
            router_port=orders["port"],
            type_hash=hashes[kind],
        )

    def double(number: float) -> Any:  # noqa: ANN401 a message
        no = False
        return value(3, no, 0, number, "", *(np.zeros(0, kind) for kind in ("u1", "?", "i8", "f8")), [])

    def get(*names: str) -> list[tuple[int, float]]:
        answer = getter.call(names=list(names))
        return [(int(own.type), float(own.double_value)) for own in answer.values]

    def set_(name: str, number: float) -> tuple[bool, str]:
        answer = setter.call(parameters=[parameter(name=name, value=double(number))])
        return bool(answer.results[0].successful), str(answer.results[0].reason)

    getter, setter = client("get_parameters"), client("set_parameters")
    say(declared=True)
    for line in sys.stdin:
        order = json.loads(line)["order"]
        say(answer=get(*order["get"]) if "get" in order else set_(*order["set"]))


def simulation(orders: dict[str, Any]) -> None:
    """Call services of simulation_interfaces; ``types`` is the folder of what ROS's generator has built."""
    from zenoh_ros2_sdk import ROS2ServiceClient  # noqa: PLC0415  only one of the two is used
    from zenoh_ros2_sdk.session import ZenohSession  # noqa: PLC0415  likewise

    types = MessageTypes("kilted")
    define_simulation_types(types)
    store = ZenohSession.get_instance("127.0.0.1", orders["port"])
    own = [name for name in types.store.fielddefs if name.startswith("simulation_interfaces/msg/")]
    for name in own:
        store.register_message_type(types.definition(name), name)
    names = "|".join(name.rpartition("/")[2] for name in own)

    def definition(text: str) -> str:
        text = re.sub(rf"^({names})\b", r"simulation_interfaces/\1", text, flags=re.MULTILINE)
        return text or "uint8 structure_needs_at_least_one_member\n"

    def client(kind: str) -> Any:  # noqa: ANN401 a client
        file = Path(orders["types"]) / f"{kind}.json"
        hashes = {entry["type_name"]: entry["hash_string"] for entry in json.loads(file.read_text())["type_hashes"]}
        request, response = SIMULATION_SERVICES[kind]
        return ROS2ServiceClient(
            f"{orders['namespace']}/{service_name(kind)}",
            f"simulation_interfaces/srv/{kind}",
            request_definition=definition(request),
            response_definition=definition(response),
            domain_id=orders["domain"],
            router_ip="127.0.0.1",
            router_port=orders["port"],
            type_hash=hashes[f"simulation_interfaces/srv/{kind}"],
            timeout=30.0,
        )

    clients = {kind: client(kind) for kind in orders["services"]}
    say(declared=True)
    for line in sys.stdin:
        kind, fields = json.loads(line)["order"]
        if kind == "SetSimulationState":
            fields = {"state": store.store.types["simulation_interfaces/msg/SimulationState"](fields["state"])}
        elif not fields:
            fields = {"structure_needs_at_least_one_member": 0}
        answer = dataclasses.asdict(clients[kind].call(**fields))
        print(json.dumps({"answer": answer}, default=lambda array: array.tolist()), flush=True)  # noqa: T201 (the answer)


if __name__ == "__main__":
    kinds = {"sdk": sdk, "pyzeros": pyzeros, "lyrical": lyrical, "parameters": parameters, "simulation": simulation}
    kinds[sys.argv[1]](json.loads(sys.argv[2]))
