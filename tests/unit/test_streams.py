"""Which variables of an instance have subscribers: found by the first letters of their keys, with few questions."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, Self, cast

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from fmu_mesh.node.streams import InstanceStreams
from fmu_mesh.rings.ring import Ring
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.layout import Layout
from fmu_mesh.wire.keys import Keys
from fmu_mesh.wire.session import Wiring, matches, open_session
from tests.helpers import DEADLINE_S, NUMBERS_OF_ZENOH, wait_until
from tests.scenarios.scenario import variable

ROOT = "fmu_mesh/lab/unit"


class Session:
    """Sessions of others have subscribed to these keys; this one counts how often it is asked."""

    def __init__(self, subscribed: list[str]) -> None:
        self.subscribed = [zenoh.KeyExpr(key) for key in subscribed]
        self.asked = 0

    def declare_keyexpr(self, key: str) -> zenoh.KeyExpr:
        return zenoh.KeyExpr(key)

    def declare_publisher(self, key: object, **_settings: object) -> Publisher:
        return Publisher(self, zenoh.KeyExpr(str(key)))


class Publisher:
    def __init__(self, session: Session, key: zenoh.KeyExpr) -> None:
        self._session = session
        self._key = key

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return

    def declare_matching_listener(self, _listener: object) -> None:
        return

    @property
    def matching_status(self) -> SimpleNamespace:
        self._session.asked += 1
        return SimpleNamespace(matching=any(self._key.intersects(key) for key in self._session.subscribed))


def streams_of(
    names: list[str], session: Session | zenoh.Session, causality: Literal["local", "input"] = "local"
) -> InstanceStreams:
    """The streams of an instance whose variables have these names."""
    variables = {name: variable(name, causality) for name in names}
    description = SimpleNamespace(variables=[*variables.values()], variable=variables.get)
    runner = SimpleNamespace(name="unit", instance=SimpleNamespace(description=description))
    return InstanceStreams(
        cast("Any", runner), cast("Any", session), Keys("fmu_mesh", "lab"), TimeGrid(0.0, 0.1, 10), lambda: None, {}
    )


NAMES = ["a", "ab", "abc", "b[1].x", "b[10].x", "b[1]", "der(a)", "a%b", "a/b", "ä", "x y", "@at"]


@given(
    st.lists(st.sampled_from(NAMES), unique=True, min_size=1),
    st.lists(
        st.sampled_from([*(Keys("fmu_mesh", "lab").variable("unit", "local", name) for name in NAMES)])
        | st.sampled_from([f"{ROOT}/**", f"{ROOT}/local/*", f"{ROOT}/local/a$*", f"{ROOT}/local/$*x", f"{ROOT}/out/*"]),
        max_size=4,
    ),
)
def test_exactly_the_variables_that_somebody_subscribes_to_are_found(names: list[str], subscribed: list[str]) -> None:
    streams = streams_of(names, Session(subscribed))
    keys = {name: zenoh.KeyExpr(Keys("fmu_mesh", "lab").variable("unit", "local", name)) for name in names}

    streams.look()

    wanted = {name for name, key in keys.items() if any(key.intersects(zenoh.KeyExpr(s)) for s in subscribed)}
    assert streams._wanted.keys() == wanted


@pytest.mark.parametrize("key", ["local/net[4711].x", "local/*", "**"])
def test_a_subscriber_among_many_variables_is_found_with_few_questions(key: str) -> None:
    session = Session([f"{ROOT}/{key}"])
    streams = streams_of([f"net[{number}].x" for number in range(10_000)], session)

    streams.look()

    assert len(streams._wanted) == (1 if key.endswith("x") else 10_000)
    assert session.asked < 100


def test_without_subscribers_one_question_is_enough() -> None:
    session = Session([])
    streams = streams_of([f"net[{number}].x" for number in range(1_000)], session)

    for _ in range(10):
        assert not streams.look(0.001)

    assert session.asked == 10


def test_when_the_last_subscriber_has_gone_no_variable_is_wanted() -> None:
    session = Session([f"{ROOT}/local/a"])
    streams = streams_of(["a", "b"], session)
    assert streams.look()

    session.subscribed.clear()

    assert streams.look(0.001)
    assert not streams._wanted


def test_more_questions_than_declared_keys_find_too_much_never_too_little() -> None:
    names = [f"{number}.x" for number in range(10_000)]
    session = Session([Keys("fmu_mesh", "lab").variable("unit", "local", name) for name in names[::2]])
    streams = streams_of(names, session)

    streams.look()

    assert {*names[::2]} <= streams._wanted.keys()
    assert len(streams._declared) == 4096


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    """The session of a node, and that of somebody who subscribes to one of its variables."""
    at = (f"unixsock-stream/{tmp_path}/node.sock",)
    with (
        open_session(Wiring(listen=at, publishes=f"{ROOT}/*/*")) as node,
        open_session(Wiring(mode="client", connect=at)) as tool,
    ):
        tool.declare_subscriber(f"{ROOT}/in/*", lambda _sample: None)
        yield node, tool


def test_no_value_for_an_input_is_lost_while_it_looks(pair: tuple[zenoh.Session, zenoh.Session]) -> None:
    node, tool = pair
    received: list[int] = []
    node.declare_subscriber(f"{ROOT}/in/*", lambda sample: received.append(int(sample.payload.to_bytes())))
    publisher = tool.declare_publisher(f"{ROOT}/in/u", congestion_control=zenoh.CongestionControl.BLOCK)
    wait_until(lambda: matches(publisher), "the input")
    streams, done = streams_of(["u"], node, "input"), threading.Event()
    wait_until(lambda: streams.is_followed, "the subscriber")

    def send() -> None:
        for number in range(20_000):
            publisher.put(str(number))
        done.set()

    sender = threading.Thread(target=send)
    sender.start()
    while not done.is_set():
        streams.look()
    sender.join(DEADLINE_S)

    wait_until(lambda: received[-1:] == [19_999], "the last value")
    assert received == [*range(20_000)]


def test_a_long_search_leaves_the_other_publishers_of_session_alone(pair: tuple[zenoh.Session, zenoh.Session]) -> None:
    node, tool = pair
    received: list[bytes] = []
    tool.declare_subscriber(f"{ROOT}/log", lambda sample: received.append(sample.payload.to_bytes()))
    log = node.declare_publisher(f"{ROOT}/log", congestion_control=zenoh.CongestionControl.BLOCK)
    streams = streams_of(["u"], node, "input")
    wait_until(lambda: matches(log) and streams.is_followed, "the subscribers")

    for _ in range(NUMBERS_OF_ZENOH + 100):
        streams.look()
    log.put(b"still there")

    assert streams.is_followed
    wait_until(lambda: received == [b"still there"], "the message")


def test_rows_that_were_overwritten_before_they_were_read_are_dropped() -> None:
    watched = variable("y", "output")
    outputs = Ring(Layout.of([watched]), 4)
    description = SimpleNamespace(variables=[watched], variable={"y": watched}.get)
    runner = SimpleNamespace(
        name="unit", outputs=outputs, watched=None, step=0, instance=SimpleNamespace(description=description)
    )
    keys, grid = Keys("fmu_mesh", "lab"), TimeGrid(0.0, 0.1, 100)
    session = Session([f"{ROOT}/out/y"])
    streams = InstanceStreams(cast("Any", runner), cast("Any", session), keys, grid, lambda: None, {})
    streams.look()
    streams.update()

    for row in range(10):
        outputs.put(row, "y", float(row))
    runner.step = 9
    batch = streams.collect(0)

    assert batch is not None
    assert batch.steps.tolist() == [6, 7, 8, 9]
    assert [values.ravel().tolist() for _, values in batch.blocks] == [[6.0, 7.0, 8.0, 9.0]]
    assert streams.take_dropped() == 6


def test_what_would_be_dropped_is_not_read() -> None:
    own, other = variable("y", "output"), variable("z", "output")
    outputs = Ring(Layout.of([own]), 4)
    description = SimpleNamespace(variables=[own, other], variable={"y": own, "z": other}.get)
    runner = SimpleNamespace(
        name="unit", outputs=outputs, watched=None, step=0, instance=SimpleNamespace(description=description)
    )

    def watch(names: Sequence[str]) -> None:
        runner.watched = Ring(Layout.of([other]), 4) if names else None
        if runner.watched is not None:
            runner.watched.put(runner.step, "z", 100.0 + runner.step)

    runner.watch = watch
    session = Session([f"{ROOT}/out/y", f"{ROOT}/out/z"])
    streams = InstanceStreams(
        cast("Any", runner), cast("Any", session), Keys("fmu_mesh", "lab"), TimeGrid(0.0, 0.1, 100), lambda: None, {}
    )
    streams.look()
    streams.update()
    assert runner.watched is not None

    full = streams.most_waiting + 1
    for runner.step in (1, 2):  # nobody has read the rows before
        outputs.put(runner.step, "y", float(runner.step))
        assert streams.collect(full) is None
        assert runner.watched is None
    runner.step = 3
    assert streams.collect(streams.backlog) is None  # from the next row on
    assert runner.watched is not None
    runner.step = 4
    outputs.put(4, "y", 4.0)
    runner.watched.put(4, "z", 104.0)
    batch = streams.collect(0)

    assert batch is not None
    assert batch.steps.tolist() == [4]
    assert [values.ravel().tolist() for _, values in batch.blocks] == [[4.0], [104.0]]
    assert streams.take_dropped() == 4
