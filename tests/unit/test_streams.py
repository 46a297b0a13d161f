"""Which variables of an instance have subscribers: found by the first letters of their keys, with few questions."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, Self, cast

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from fmu_mesh.node.streams import InstanceStreams
from fmu_mesh.rings.ring import Ring
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.layout import Layout
from fmu_mesh.wire.keys import Keys
from tests.scenarios.scenario import variable

ROOT = "fmu_mesh/lab/unit"


class Session:
    """Sessions of others have subscribed to these keys; this one counts how often it is asked."""

    def __init__(self, subscribed: list[str]) -> None:
        self.subscribed = [zenoh.KeyExpr(key) for key in subscribed]
        self.asked = 0

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


def streams_of(names: list[str], session: Session) -> InstanceStreams:
    """The streams of an instance whose local variables have these names."""
    variables = {name: variable(name, "local") for name in names}
    description = SimpleNamespace(variables=[*variables.values()], variable=variables.get)
    runner = SimpleNamespace(name="unit", instance=SimpleNamespace(description=description))
    return InstanceStreams(
        cast("Any", runner), cast("Any", session), Keys("fmu_mesh", "lab"), TimeGrid(0.0, 0.1, 10), lambda: None
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


def test_rows_that_were_overwritten_before_they_were_read_are_dropped() -> None:
    watched = variable("y", "output")
    outputs = Ring(Layout.of([watched]), 4)
    description = SimpleNamespace(variables=[watched], variable={"y": watched}.get)
    runner = SimpleNamespace(
        name="unit", outputs=outputs, watched=None, step=0, instance=SimpleNamespace(description=description)
    )
    keys, grid = Keys("fmu_mesh", "lab"), TimeGrid(0.0, 0.1, 100)
    session = Session([f"{ROOT}/out/y"])
    streams = InstanceStreams(cast("Any", runner), cast("Any", session), keys, grid, lambda: None)
    streams.look()
    streams.update()

    for row in range(10):
        outputs.put(row, "y", float(row))
    runner.step = 9
    batch = streams.collect(0)

    assert batch is not None
    assert batch[1].tolist() == [6, 7, 8, 9]
    assert [values.ravel().tolist() for _, values in batch[2]] == [[6.0, 7.0, 8.0, 9.0]]
    assert streams.take_dropped() == 6
