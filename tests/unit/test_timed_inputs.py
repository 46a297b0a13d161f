"""Inputs over time: which value a step uses, whenever it was sent."""

from __future__ import annotations

import random
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from fmu_mesh.errors import TerminationRequested
from fmu_mesh.instances.contract import Instance, LogMessage
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.co_simulation.fmi2 import Fmi2Instance
from fmu_mesh.instances.fmi.fmu_kind import FmuConfig
from fmu_mesh.node.inputs import TimedInputs, set_input
from fmu_mesh.node.stepping import Runner
from fmu_mesh.rings.host_memory import HostMemory
from fmu_mesh.rings.native import MemberTable
from fmu_mesh.rings.ring import Ring
from fmu_mesh.simtime import ENDLESS, TimeGrid
from fmu_mesh.system.input_timeouts import InputTimeout
from fmu_mesh.system.layout import Layout
from fmu_mesh.system.memory_map import MASTER, map_memory
from fmu_mesh.system.plan import InstancePlan
from fmu_mesh.wire.values import Origin, ValueRefused, decode_origin, encode_origin
from tests.helpers import FMUS

STEP_SIZE = 0.1


class Steps:
    """A gain of 1 whose input is not connected, from second 1 on in steps of a tenth."""

    def __init__(
        self,
        folder: Path,
        interpolation: Literal["hold", "linear"],
        *timeouts: InputTimeout,
        by_key: bool = False,
        in_row: bool = False,
    ) -> None:
        path = FMUS / "Gain.fmu"
        self.warnings: list[LogMessage] = []
        instance = Fmi2Instance(path, "gain", read_description(path), folder)
        keys = {"u": interpolation == "linear"} if by_key else {}
        self.inputs = TimedInputs(instance, interpolation, {}, timeouts, self.warnings.append, keys=keys)
        self.rings = Ring(Layout.of([("u", "Float64")] if in_row else []), 1), Ring(Layout.of([("y", "Float64")]), 64)
        self.inputs.enter_initialization(1.0, None, {"u": 5.0})
        self.inputs.exit_initialization()
        self.step = 0

    def bind(self) -> None:
        self.inputs.bind(self.rings[0], (self.rings[1],), TimeGrid(1.0, STEP_SIZE, 60), 1)

    def go(self, steps: int) -> list[float]:
        """Take some steps; what they used as input."""
        for step in range(self.step, self.step + steps):
            self.inputs.do_step(step)
        self.step += steps
        rows = np.arange(self.step - steps + 1, self.step + 1) & self.rings[1].mask
        values: list[float] = self.rings[1].part("Float64")[rows, 0].tolist()
        return values


@pytest.fixture
def linear(tmp_path: Path) -> Iterator[Steps]:
    steps = Steps(tmp_path, "linear")
    steps.bind()
    yield steps
    steps.inputs.close()


@pytest.fixture
def hold(tmp_path: Path) -> Iterator[Steps]:
    steps = Steps(tmp_path, "hold")
    steps.bind()
    yield steps
    steps.inputs.close()


def test_without_any_value_the_input_keeps_its_start_value(linear: Steps) -> None:
    assert linear.go(2) == [5.0, 5.0]


def test_a_value_without_a_time_holds_from_the_next_step_on(linear: Steps) -> None:
    linear.go(3)

    assert linear.inputs.add("u", 7.0, None) == 3
    assert linear.go(2) == [7.0, 7.0]


def test_a_value_ahead_of_time_is_gone_to_in_a_line(linear: Steps) -> None:
    assert linear.inputs.add("u", 9.0, 1.4) == 4

    assert linear.go(6) == pytest.approx([5.0, 6.0, 7.0, 8.0, 9.0, 9.0], rel=1e-15)  # the times are rounded


def test_with_hold_it_is_taken_when_its_time_has_come(hold: Steps) -> None:
    assert hold.inputs.add("u", 9.0, 1.3) == 3  # 1.0 + 3 * 0.1 is not 1.3, and means the same

    assert hold.go(5) == [5.0, 5.0, 5.0, 9.0, 9.0]


def test_a_value_that_holds_needs_python_in_its_own_step_only(hold: Steps) -> None:
    hold.go(1)

    hold.inputs.add("u", 9.0, 1.5)
    hold.inputs.add("u", 8.0, 1.3)

    assert hold.inputs.python_at == 3
    assert hold.go(2) == [5.0, 5.0]
    assert hold.inputs.python_at == 3
    assert hold.go(1) == [8.0]
    assert hold.inputs.python_at == 5
    hold.inputs.add("u", 7.0, None)
    assert hold.go(3) == [7.0, 9.0, 9.0]


def test_values_count_by_their_times_and_not_by_their_arrival(hold: Steps) -> None:
    hold.inputs.add("u", 3.0, 1.3)
    hold.inputs.add("u", 2.0, 1.15)
    hold.inputs.add("u", 1.0, 1.1)

    assert hold.go(5) == [5.0, 1.0, 2.0, 3.0, 3.0]


@pytest.mark.parametrize("interpolation", ["hold", "linear"])
def test_values_of_a_key_are_those_that_each_step_would_set(
    interpolation: Literal["hold", "linear"], tmp_path: Path
) -> None:
    """What has come for later steps is calculated ahead, for steps that Python does not take."""
    numbers, ahead, late = random.Random(40), 0, 0  # noqa: S311  no secret
    both = [Steps(tmp_path / str(in_row), interpolation, by_key=True, in_row=in_row) for in_row in (False, True)]
    for steps in both:
        steps.bind()

    for _ in range(200):
        now = both[0].step
        for time in sorted(1.0 + STEP_SIZE * (now + numbers.uniform(-3, 30)) for _ in range(numbers.randrange(4))):
            value = float(numbers.randrange(3))  # often the one before
            for steps in both:
                steps.inputs.add("u", value, time)
        count = numbers.randrange(1, 12)
        ahead += bool(both[1].inputs.tracks) and both[1].inputs.python_at > now
        late += bool(both[1].inputs.tracks) and both[1].inputs.python_at == now
        assert both[1].go(count) == both[0].go(count)

    assert ahead > 20
    assert late > 20
    for steps in both:
        steps.inputs.close()


def test_a_value_for_later_does_not_end_what_was_calculated_ahead(tmp_path: Path) -> None:
    steps = Steps(tmp_path, "hold", by_key=True, in_row=True)
    steps.bind()
    for number in range(20):
        steps.inputs.add("u", float(number), 1.0 + number * STEP_SIZE)
    steps.go(1)

    steps.inputs.add("u", 20.0, 1.0 + 20 * STEP_SIZE)
    assert (steps.inputs.tracks_from, steps.inputs.python_at) == (1, 19)
    steps.inputs.add("u", -5.0, 1.0 + 5 * STEP_SIZE)

    assert steps.inputs.python_at == 1
    assert steps.go(21) == [*map(float, range(1, 5)), -5.0, *map(float, range(6, 21)), 20.0]
    steps.inputs.close()


def test_value_whose_time_is_past_holds_unless_later_one_is_in_use(hold: Steps) -> None:
    hold.go(5)
    hold.inputs.add("u", 8.0, 1.2)
    assert hold.go(1) == [8.0]

    hold.inputs.add("u", 6.0, 1.1)
    assert hold.go(1) == [8.0]


@pytest.fixture
def quiet(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Steps]:
    """With a timeout of three steps, after which the input is 9."""
    steps = Steps(tmp_path, getattr(request, "param", "hold"), InputTimeout("gain", "u", 0.3, 3, 1, 9.0))
    steps.bind()
    yield steps
    steps.inputs.close()


def test_an_input_falls_back_once_and_takes_next_value(quiet: Steps) -> None:
    assert quiet.go(5) == [5.0, 5.0, 5.0, 9.0, 9.0]
    assert quiet.inputs.late == {"u": 0}
    assert [(own.instance, own.step) for own in quiet.warnings] == [("gain", 3)]
    assert (
        quiet.warnings[0].message == "input 'u' has had no value since point 0: it gets 9.0 after 0.3 s without a value"
    )

    assert quiet.inputs.add("u", 5.0, None) == 5
    assert quiet.go(4) == [5.0, 5.0, 5.0, 9.0]
    assert quiet.inputs.late == {"u": 5}
    assert len(quiet.warnings) == 1


def test_same_value_again_and_again_keeps_an_input(quiet: Steps) -> None:
    for _ in range(5):
        quiet.inputs.add("u", 4.0, None)
        assert quiet.go(2) == [4.0, 4.0]
    assert quiet.go(2) == [4.0, 9.0]


def test_a_value_whose_time_is_past_replaces_what_it_fell_back_to(quiet: Steps) -> None:
    quiet.go(3)
    quiet.inputs.add("u", 1.0, 1.9)
    assert quiet.go(2) == [9.0, 9.0]

    assert quiet.inputs.add("u", 7.0, 1.2) == 5
    assert quiet.go(5) == [7.0, 7.0, 7.0, 9.0, 1.0]


def test_value_ahead_of_time_is_no_value_until_then(quiet: Steps) -> None:
    assert quiet.inputs.add("u", 1.0, 1.55) == 6

    assert quiet.go(10) == [5.0, 5.0, 5.0, 9.0, 9.0, 9.0, 1.0, 1.0, 1.0, 9.0]


@pytest.mark.parametrize("quiet", ["linear"], indirect=True)
def test_a_line_to_a_later_value_is_a_value_in_each_step(quiet: Steps) -> None:
    quiet.go(1)
    quiet.inputs.add("u", 11.0, 1.7)

    assert quiet.go(10) == pytest.approx([5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 11.0, 11.0, 9.0])


@pytest.mark.parametrize("serialized", [False, True])
@pytest.mark.parametrize("quiet", ["hold", "linear"], indirect=True)
def test_a_state_has_what_was_sent_until_then_and_no_more(
    quiet: Steps,
    serialized: bool,  # noqa: FBT001 a parameter of tests
) -> None:
    inputs = quiet.inputs
    inputs.add("u", 3.0, 1.1)
    inputs.add("u", 7.0, 1.8)
    quiet.go(4)
    state = inputs.get_state()
    kept = inputs.deserialize_state(inputs.serialize_state(state)) if serialized else state
    expected = quiet.go(9)
    warned = len(quiet.warnings)
    inputs.add("u", 4.0, None)
    quiet.go(2)

    for _ in range(2):
        inputs.set_state(kept)
        quiet.step = 4
        assert quiet.go(9) == expected
    assert (expected[-1], warned, len(quiet.warnings)) == (9.0, 1, 3)
    for _ in range(2):  # what was set after the state was saved counts no more
        inputs.set_state(kept)
        quiet.step = 4
        inputs.add("u", 4.0, None)
        assert quiet.go(1) == [4.0]
    for own in {id(state): state, id(kept): kept}.values():
        inputs.free_state(own)


def test_an_input_that_says_stop_ends_the_run(tmp_path: Path) -> None:
    steps = Steps(tmp_path, "hold", InputTimeout("gain", "u", 0.3, 3, 1, stops=True))
    steps.bind()
    steps.go(2)
    steps.inputs.add("u", 1.0, None)
    steps.go(3)

    with pytest.raises(TerminationRequested, match="since point 2, and it ends the run") as ended:
        steps.go(1)
    assert (ended.value.instance, ended.value.variable) == ("gain", "u")
    steps.inputs.close()


def runner_of(instance: Instance, last_point: int = 60) -> tuple[Runner, MemberTable]:
    """A runner in the middle of a run, whose steps are a tenth of a second, and where it is."""
    outputs = Layout.of([("y", "Float64")])
    plan = InstancePlan("gain", "Gain.fmu", {}, 1, outputs, Layout(), (), (), {}, FmuConfig(fmu="Gain.fmu"))
    map_, places = map_memory(["gain", MASTER], {"gain": ("gain", 1, outputs, 64)})
    memory = HostMemory.private(map_, "gain")
    ring, counter = memory.ring(places["gain"]), memory.counter(places["gain"].counter)
    runner = Runner(plan, instance, TimeGrid(1.0, STEP_SIZE, last_point), ring, counter)
    position = MemberTable()
    runner.follow(position)
    runner.bind()
    return runner, position


def test_a_parameter_with_a_time_holds_from_it_and_otherwise_at_once(linear: Steps) -> None:
    runner, position = runner_of(linear.inputs)

    assert set_input(runner, "k", 2.0, None) == 0
    assert linear.inputs.get_values(["k"]) == [2.0]

    assert set_input(runner, "k", 4.0, 1.3) == 3
    used = []
    for step in range(5):
        runner.instance.do_step(step)
        position.step = step + 1
        used += runner.instance.get_values(["y"])
    assert used == [10.0, 10.0, 10.0, 20.0, 20.0]  # a parameter does not change in between, as inputs do here


def test_what_an_earlier_run_took_is_never_too_much(tmp_path: Path) -> None:
    """That run may have forgotten past values some steps earlier."""
    values = [("u", 0, 1.0 + number * 1e-4, float(number)) for number in range(70_000)]
    path = FMUS / "Gain.fmu"
    inputs = TimedInputs(Fmi2Instance(path, "gain", read_description(path), tmp_path), "hold", recorded=values)
    ring = Ring(Layout.of([("y", "Float64")]), 4)
    inputs.enter_initialization(1.0, None, {})
    inputs.exit_initialization()
    inputs.bind(Ring(Layout.of([]), 1), (ring,), TimeGrid(1.0, STEP_SIZE, 60), 1)

    inputs.do_step(0)
    inputs.do_step(1)

    assert [ring.value(row, "y") for row in (1, 2)] == [0.0, 1000.0]
    inputs.close()


def test_an_instance_follows_times_from_the_first_value_with_one_on(tmp_path: Path) -> None:
    path = FMUS / "Gain.fmu"
    instance = Fmi2Instance(path, "gain", read_description(path), tmp_path)
    instance.enter_initialization(1.0, None, {"u": 5.0})
    instance.exit_initialization()
    runner, position = runner_of(instance)
    used = []
    for step in range(6):
        runner.instance.do_step(step)
        position.step = step + 1
        used.append(runner.instance.get_values(["y"]))
        if step == 0:
            assert set_input(runner, "u", 6.0, None) == 1
            assert runner.instance is instance
        if step == 1:
            assert set_input(runner, "u", 7.0, 1.4) == 4

    assert used == [[5.0], [6.0], [6.0], [6.0], [7.0], [7.0]]
    runner.instance.close()


def test_so_many_values_may_wait_for_their_time_and_no_more(linear: Steps) -> None:
    for number in range((1 << 16) - 1):  # and the one that it began with
        linear.inputs.add("u", 0.0, 10.0 + number)

    with pytest.raises(ValueRefused, match="65536 values of 'u' wait for their time already"):
        linear.inputs.add("u", 0.0, 1e9)


@pytest.mark.parametrize(
    ("last_point", "time", "why"),
    [
        (60, 7.1, "the time 7.1 s is later than 7 s, the end of the simulation"),
        (ENDLESS, 1.7e9, "the time 1700000000 s is later than 1000001 s, 1e6 s ahead: is it a Unix time?"),
        (ENDLESS, 1e308, "1e6 s ahead: is it a Unix time?"),
    ],
)
def test_a_time_that_no_step_of_the_run_has_is_refused(linear: Steps, last_point: int, time: float, why: str) -> None:
    runner, _ = runner_of(linear.inputs, last_point)

    with pytest.raises(ValueRefused, match=re.escape(why)):
        set_input(runner, "u", 1.0, time)
    assert set_input(runner, "u", 1.0, 6.9) == 59


def test_a_stream_of_values_has_no_time_a_million_seconds_ahead() -> None:
    a_year, endless = TimeGrid(0.0, 900.0, 35040), TimeGrid(0.0, 0.01, ENDLESS)

    assert a_year.latest(4, streamed=False) == a_year.stop_time == 31_536_000.0
    assert a_year.latest(4, streamed=True) == 1_003_600.0
    assert a_year.latest(35000, streamed=True) == a_year.stop_time
    assert endless.latest(100, streamed=False) == endless.latest(100, streamed=True) == 1_000_001.0


def test_a_time_long_before_the_run_is_the_past(hold: Steps) -> None:
    assert hold.inputs.add("u", 1.0, -1e308) == 0
    assert hold.go(2) == [1.0, 1.0]


def test_the_time_of_a_value_is_that_of_its_attachment() -> None:
    assert decode_origin(b'{"time": 1.5}') == Origin(1.5)
    assert decode_origin(b'{"point": 3, "time": 2}') == Origin(2.0)
    assert decode_origin(b'{"who": "joystick"}') == Origin(None, "joystick")
    assert decode_origin(encode_origin(None, "w" * 300)) == Origin(None, "w" * 200)


@pytest.mark.parametrize("attachment", [b"", b"{}", b'{"time": "1"}', b"[1.5]", b"\xff\x00", b'{"time": null}'])
def test_an_attachment_that_says_nothing_is_refused(attachment: bytes) -> None:
    with pytest.raises(ValueRefused, match=r"its attachment (is not like|has neither)"):
        decode_origin(attachment)
