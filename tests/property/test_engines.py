"""Engines on shared memory give the reference result of any system, in C and in Python; what is forged is found."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from fmu_mesh.errors import ProtocolBroken, TerminationRequested
from fmu_mesh.node.engine import Engine, PlainEngine
from fmu_mesh.node.stepping import Runner
from fmu_mesh.rings import native
from fmu_mesh.rings.host_memory import Counter, HostMemory
from fmu_mesh.system.plan import NodePlan, Plan
from tests.helpers import examples, wait_until
from tests.property.test_random_systems import (
    Drawn,
    Mixer,
    Pipe,
    bits,
    column,
    expected_of,
    planned,
    systems,
)
from tests.scenarios.engines import EngineMesh, MakeEngine, burst_engine, windows_of

needs_library = pytest.mark.skipif(native.library is None, reason="the library with the burst is not built here")


def plain_engine(plan: NodePlan, units: Sequence[Sequence[Runner]], memory: HostMemory) -> PlainEngine:
    return PlainEngine(plan, units, memory, windows_of(plan, memory))


def chain(count: int, last_point: int, window: int, *, closed: bool = False, recorded: bool = False) -> Drawn:
    """Instances on nodes of their own that feed one another; ``closed``: the last one feeds the first one."""
    pipes = [Pipe(i, "y", i + 1, real=True, factor=1.0, offset=0.0, delay=None) for i in range(count - 1)]
    if closed:
        pipes.append(Pipe(count - 1, "y", 0, real=True, factor=1.0, offset=0.0, delay=1))
    return Drawn(
        algorithm="gauss_seidel",
        last_point=last_point,
        window=window,
        steps=(1,) * count,
        groups=tuple(range(count)),
        feedthrough=(False,) * count,
        pipes=tuple(pipes),
        recorded=recorded,
        seed=0,
    )


def meshed(drawn: Drawn, make: MakeEngine, plan: Plan | None = None) -> tuple[EngineMesh, list[Mixer]]:
    plan = plan or planned(drawn)
    mixers = [Mixer(drawn, plan, number) for number in range(len(drawn.steps))]
    return EngineMesh(plan, lambda name: mixers[int(name[1:])], make), mixers


def assert_reference(drawn: Drawn, mesh: EngineMesh, mixers: list[Mixer], plan: Plan) -> None:
    expected = expected_of(drawn, plan)
    assert bits([mixer.rows for mixer in mixers]) == bits(expected)
    for name, rows in mesh.recorded.items():
        assert np.array_equal(column(rows), np.array([y for y, _ in expected[int(name[1:])]])), name


# --- any system


@pytest.mark.parametrize("make", [pytest.param(burst_engine, marks=needs_library), plain_engine])
@given(systems())
@settings(max_examples=examples(100), deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_any_system_gives_the_reference_result_on_one_memory(make: MakeEngine, drawn: Drawn) -> None:
    drawn = replace(drawn, feedthrough=(False,) * len(drawn.steps))
    plan = planned(drawn)
    mesh, mixers = meshed(drawn, make, plan)

    mesh.run(drawn.seed)

    assert_reference(drawn, mesh, mixers, plan)
    event("cycles" if plan.cycles else "no cycle")


@needs_library
@given(systems())
@settings(max_examples=examples(25), deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_any_system_gives_the_reference_result_in_threads(drawn: Drawn) -> None:
    drawn = replace(drawn, feedthrough=(False,) * len(drawn.steps))
    plan = planned(drawn)
    mesh, mixers = meshed(drawn, burst_engine, plan)

    mesh.run_in_threads()

    assert_reference(drawn, mesh, mixers, plan)


@needs_library
@pytest.mark.parametrize("window", [1, 3, 64])
@pytest.mark.parametrize("closed", [False, True])
def test_no_wake_up_is_lost_between_threads(window: int, closed: bool) -> None:  # noqa: FBT001 a parameter of a test
    """Every sleep may last a minute here, and so would the run."""
    drawn = chain(4, 2000, window, closed=closed, recorded=True)
    plan = planned(drawn)
    mesh, mixers = meshed(drawn, burst_engine, plan)

    mesh.run_in_threads()

    assert_reference(drawn, mesh, mixers, plan)


# --- one engine


class Scripted(Mixer):
    """A mixer that does something before some of its steps."""

    def __init__(self, drawn: Drawn, plan: Plan, number: int, script: dict[int, Callable[[], object]]) -> None:
        super().__init__(drawn, plan, number)
        self._script = script

    def do_step(self, step: int) -> None:
        self._script.get(step, lambda: None)()
        super().do_step(step)


def scripted(drawn: Drawn, make: MakeEngine, script: dict[int, Callable[[], object]]) -> EngineMesh:
    """A mesh whose first instance follows a script; all is granted."""
    plan = planned(drawn)

    def opened(name: str) -> Mixer:
        number = int(name[1:])
        return Scripted(drawn, plan, number, script) if number == 0 else Mixer(drawn, plan, number)

    mesh = EngineMesh(plan, opened, make)
    mesh.memory.grant.raise_to(drawn.last_point)
    return mesh


MAKERS = [pytest.param(burst_engine, marks=needs_library, id="C"), pytest.param(plain_engine, id="Python")]


@pytest.mark.parametrize("make", MAKERS)
def test_attention_ends_a_burst_after_the_step(make: MakeEngine) -> None:
    script: dict[int, Callable[[], object]] = {}
    mesh = scripted(chain(1, 1000, 64), make, script)
    [engine] = mesh.engines.values()
    [runner] = engine.runners
    while runner.step < 200:  # the bursts of the engine grow to what it steps in a slice
        engine.run(0.0, eager=False)
    asked = runner.step + 2
    script[asked] = engine.ring_bell

    while runner.step <= asked:
        assert engine.run(0.0, eager=False)

    assert runner.step == asked + 1


@pytest.mark.parametrize("make", MAKERS)
def test_a_burst_of_steps_in_python_ends_after_its_slice(make: MakeEngine) -> None:
    """After it, messages are handled and rows are sent; these steps take half a second in all."""
    mesh = scripted(chain(1, 50_000, 60_000), make, {})
    [engine] = mesh.engines.values()

    assert engine.run(0.0, eager=True)

    assert 0 < engine.covered < 50_000


@pytest.mark.parametrize("make", MAKERS)
@pytest.mark.parametrize("eager", [False, True])
def test_an_engine_that_cannot_step_sleeps_until_attention(make: MakeEngine, eager: bool) -> None:  # noqa: FBT001 a parameter of a test
    """Also where its rows go as frames: it has to wait, and not to ask again and again."""
    mesh, _ = meshed(chain(1, 10, 4), make)  # nothing is granted
    [engine] = mesh.engines.values()
    results: list[bool] = []
    enough = threading.Event()

    def run() -> None:
        while not enough.is_set():
            results.append(engine.run(30.0, eager=eager))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join(0.3)

    assert len(results) < 20  # it may return where a machine was too busy for it, and not thousands of times
    enough.set()
    engine.ring_bell()
    thread.join(10.0)
    assert not thread.is_alive()
    assert not any(results)


@needs_library
@pytest.mark.parametrize(("quiet", "least", "most"), [(False, 1, 1), (True, 2, 10)])
def test_only_a_quiet_engine_goes_on_after_a_wait(quiet: bool, least: int, most: int) -> None:  # noqa: FBT001 a parameter of a test
    mesh, _ = meshed(chain(1, 10, 4), burst_engine)
    [engine] = mesh.engines.values()
    [progress] = mesh.memory.progress.values()

    def grant() -> None:
        for point in range(1, 11):
            wait_until(lambda point=point: progress.value >= point, "the point before the next grant")  # type: ignore[misc]  # a default
            mesh.memory.grant.raise_to(point)

    thread = threading.Thread(target=grant)
    thread.start()
    assert engine.run(30.0, eager=False, quiet=quiet)

    assert least <= engine.covered <= most
    while engine.covered < 10:
        engine.run(30.0, eager=False)
    thread.join(10.0)


@needs_library
def test_who_lacks_a_grant_and_a_row_sleeps_for_the_row() -> None:
    """The row comes later, because its source steps with the grant, too: it wakes up once for both."""
    mesh, _ = meshed(chain(2, 10, 4), burst_engine)
    first, second = mesh.engines.values()
    [source] = second.runners[0].sources
    place = second._memory.place.own

    def need(counter: Counter) -> int:
        return ctypes.c_int64.from_address(counter.address + 64 + 8 * place).value

    thread = threading.Thread(target=lambda: second.run(30.0, eager=False))
    thread.start()
    wait_until(lambda: need(source.counter) == 2, "the sleep for the row of point 1")

    assert need(mesh.memory.grant) == 0
    mesh.memory.grant.raise_to(1)
    first.run(0.0, eager=False)
    thread.join(10.0)
    assert second.covered == 1


@needs_library
def test_a_grant_wakes_an_engine() -> None:
    mesh, _ = meshed(chain(1, 10, 4), burst_engine)
    [engine] = mesh.engines.values()

    def run() -> None:
        while engine.covered < 10:
            engine.run(30.0, eager=False)

    thread = threading.Thread(target=run)
    thread.start()

    mesh.memory.grant.raise_to(10)

    thread.join(10.0)
    assert not thread.is_alive()
    assert engine.covered == 10


@pytest.mark.parametrize("make", MAKERS)
def test_an_fmu_that_ends_the_simulation_steps_no_more_and_others_do(make: MakeEngine) -> None:
    def end() -> None:
        raise TerminationRequested("enough", instance="i0")

    mesh = scripted(replace(chain(2, 20, 64), pipes=(), groups=(0, 0)), make, {7: end})
    [engine] = mesh.engines.values()

    with pytest.raises(TerminationRequested):
        run_for_ever(engine)
    run_for_ever(engine)

    assert [mesh.runners[name].step for name in ("i0", "i1")] == [7, 20]


@pytest.mark.parametrize("make", MAKERS)
def test_an_engine_says_what_it_is_doing(make: MakeEngine) -> None:
    seen: list[Runner | None] = []
    script: dict[int, Callable[[], object]] = {}
    mesh = scripted(chain(2, 5, 64), make, script)
    engine = mesh.engines["node0"]
    script[3] = lambda: seen.append(engine.current)

    mesh.run()

    assert seen == [mesh.runners["i0"]]
    assert engine.current is None
    assert all(spent_s > 0.0 for spent_s in engine.spent_s)


# --- what somebody else writes into the memory


def stepped_first(drawn: Drawn, make: MakeEngine = burst_engine) -> tuple[EngineMesh, Engine, Engine]:
    """A chain of two whose first instance is at the last point, and the engines of both."""
    mesh, _ = meshed(drawn, make)
    mesh.memory.grant.raise_to(drawn.last_point)
    first, second = mesh.engines["node0"], mesh.engines["node1"]
    for _ in range(1000):
        if first.covered == drawn.last_point:
            break
        first.run(0.0, eager=False)
    return mesh, first, second


def run_for_ever(engine: Engine) -> None:
    for _ in range(1000):
        engine.run(0.0, eager=False)


@needs_library
@pytest.mark.parametrize("stamp", [0, 3, 2**62, -1])
def test_row_that_is_not_one_that_was_written_ends_run_with_names(stamp: int) -> None:
    mesh, _, second = stepped_first(chain(2, 12, 64))
    mesh.rings["i0"][0].stamps[9] = stamp

    with pytest.raises(ProtocolBroken, match="a row of 'i0' for 'i1' is not the one that was written") as caught:
        run_for_ever(second)

    assert (caught.value.instance, caught.value.point, caught.value.exit_code) == ("i1", 8, 4)
    assert mesh.runners["i1"].step == 8  # the steps before it are right, and stay


@needs_library
@pytest.mark.parametrize("forged", [8, 13, 2**62])
def test_a_counter_that_somebody_else_has_raised_gives_no_row(forged: int) -> None:
    mesh, _ = meshed(chain(2, 12, 64), burst_engine)
    mesh.memory.grant.raise_to(12)
    mesh.rings["i0"][1].raise_to(forged)

    with pytest.raises(ProtocolBroken, match="a row of 'i0' for 'i1'"):
        run_for_ever(mesh.engines["node1"])

    assert mesh.runners["i1"].step == 0


@needs_library
def test_a_grant_beyond_the_last_point_grants_the_last_point() -> None:
    mesh, mixers = meshed(drawn := chain(2, 12, 64), burst_engine)
    mesh.memory.grant.raise_to(2**62)

    mesh.run()

    assert_reference(drawn, mesh, mixers, planned(drawn))


@needs_library
def test_forged_progress_of_a_target_overwrites_rows_and_is_reported() -> None:
    """The window is what protects rows in use; who breaks it cannot make a wrong value of it."""
    mesh, _ = meshed(chain(2, 500, 4), burst_engine)
    mesh.memory.grant.raise_to(500)
    mesh.memory.progress["node1"].raise_to(2**62)

    run_for_ever(mesh.engines["node0"])
    with pytest.raises(ProtocolBroken, match="a row of 'i0' for 'i1' is not the one that was written"):
        run_for_ever(mesh.engines["node1"])

    assert mesh.runners["i0"].step == 500


@needs_library
def test_a_step_with_a_forged_row_can_be_taken_later() -> None:
    mesh, _, second = stepped_first(chain(2, 12, 64))
    ring = mesh.rings["i0"][0]
    stamps = ring.stamps.copy()

    ring.stamps[:] = 0
    with pytest.raises(ProtocolBroken):
        second.run(0.0, eager=False)
    ring.stamps[:] = stamps
    run_for_ever(second)

    assert second.covered == 12


@needs_library
@given(st.data())
@settings(max_examples=examples(30), deadline=None)
def test_forged_numbers_never_become_values(data: st.DataObject) -> None:
    """Whatever is written into counters and stamps: the steps that are taken are those of the reference."""
    drawn = chain(3, 60, data.draw(st.integers(1, 8)))
    plan = planned(drawn)
    mesh, mixers = meshed(drawn, burst_engine, plan)
    expected = expected_of(drawn, plan)
    mesh.memory.grant.raise_to(60)
    numbers = st.integers(0, 70) | st.sampled_from([2**31, 2**62])

    try:
        for _ in range(data.draw(st.integers(1, 40))):
            match data.draw(st.integers(0, 7)):
                case 0:
                    mesh.rings[f"i{data.draw(st.integers(0, 2))}"][1].raise_to(data.draw(numbers))
                case 1:
                    ring, _ = mesh.rings[f"i{data.draw(st.integers(0, 2))}"]
                    slot = data.draw(st.integers(0, ring.mask))
                    wrong = data.draw(numbers.filter(lambda stamp: stamp & ring.mask != (slot + 1) & ring.mask))  # noqa: B023 used at once
                    ring.stamps[slot] = wrong
                case 2:
                    mesh.memory.progress[f"node{data.draw(st.integers(0, 2))}"].raise_to(data.draw(numbers))
                case _:
                    mesh.engines[f"node{data.draw(st.integers(0, 2))}"].run(0.0, eager=False)
    except ProtocolBroken:
        event("found")

    for mixer, own in zip(mixers, expected, strict=True):
        assert bits([mixer.rows]) == bits([own[: len(mixer.rows)]])
