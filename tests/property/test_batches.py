"""Copies of a batch are systems that are opened one by one: every float, every point and every end is the same."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

import fmu_mesh
from fmu_mesh.errors import ConfigurationError
from fmu_mesh.rings import native
from fmu_mesh.run import preparing, resetting
from fmu_mesh.run.run_plan import RunPlan
from tests.helpers import FMUS, examples

H = 0.01
COPIES = 3

NATIVE: dict[str, Any] = {
    "instances": {
        "slow": {"fmu": "Integrator", "start_values": {"k": -2.0}, "step_size": 3 * H},
        "fast": {"fmu": "Integrator", "start_values": {"y": 1.0}},
        "delayed": {"fmu": "TransportDelay", "start_values": {"d": 0.055}, "step_size": 2 * H},
        "sum": {"fmu": "Adder"},
        "free": {"fmu": "Gain"},
        "cart": {"fmu": "CartPole"},
    },
    "connections": [
        "slow.y -> fast.u",
        "fast.y -> slow.u",
        {"from": "fast.y", "to": "delayed.x", "factor": 2.0},
        "delayed.y -> sum.u1",
        "slow.y -> sum.u2",
    ],
}
MIXED: dict[str, Any] = {
    "instances": {
        "fast": {"fmu": "Integrator", "start_values": {"y": 1.0}},
        "oscillator": {"event": ("Oscillator", 2), "kind": "model_exchange"},
        "stairs": {"event": ("Stairs", 3), "start_values": {"period": 0.07}},
        "free": {"fmu": "Gain"},
        "pid": {"controller": "position_pid", "start_values": {"p": 3.0, "i": 2.0}},
    },
    "connections": ["oscillator.x -> fast.u", "fast.y -> pid.position"],
}
STEPPED = {"free.u": 1.0, "free.k": 1.0, "fast.k": 1.0}
SETTINGS = {
    "native": [*STEPPED, "cart.force"],
    "mixed": [*STEPPED, "pid.target", "oscillator.u"],
}
STARTS = {"native": ["fast.y", "cart.theta", "free.k"], "mixed": ["fast.y", "free.k", "stairs.period"]}
READ = {
    "native": ["slow.y", "fast.y", "delayed.y", "sum.y", "free.y", "cart.x", "cart.der(theta)", "slow.u", "fast.k"],
    "mixed": ["fast.y", "oscillator.x", "stairs.counter", "stairs.last_stair", "free.y", "pid.effort", "oscillator.y"],
}

Action = tuple[str, Any]


class OverTime(NamedTuple):
    """What a scenario prescribes for variables, and the timeouts of inputs."""

    values: dict[str, dict[str, Any]]
    timeouts: dict[str, dict[str, Any]]


class Pair(NamedTuple):
    """A mesh and a batch of it."""

    kind: str
    mesh: fmu_mesh.Mesh
    batch: fmu_mesh.Batch


def mesh_of(
    kind: str, folder: Path, event_fmu: Callable[..., Path], over_time: OverTime | None = None
) -> fmu_mesh.Mesh:
    content = {"native": NATIVE, "mixed": MIXED}[kind]
    instances: dict[str, dict[str, Any]] = {name: dict(own) for name, own in content["instances"].items()}
    if over_time is not None:
        content = {**content, "scenario": {"values": over_time.values}}
        for name, timeout in over_time.timeouts.items():
            instance, variable = name.split(".")
            instances[instance]["inputs"] = {variable: {"timeout": timeout}}
    for own in instances.values():
        if "event" in own:
            own["fmu"] = str(event_fmu(*own.pop("event")))
        elif "fmu" in own:
            own["fmu"] = str(FMUS / f"{own['fmu']}.fmu")
    config = folder / f"{kind}.yaml"
    whole = {"mesh": kind, "simulation": {"stop_time": None, "step_size": H}, **content, "instances": instances}
    config.write_text(yaml.safe_dump(whole), encoding="utf-8")
    return fmu_mesh.load(config)


WAYS: dict[str, dict[str, Any]] = {"alone": {}, "threads": {"threads": 2}, "processes": {"processes": 2}}
"""Where copies are."""


@pytest.fixture(
    scope="module",
    params=[
        ("native", "alone"),
        ("mixed", "alone"),
        ("native", "threads"),
        ("native", "processes"),
        ("mixed", "processes"),
    ],
    ids=" ".join,
)
def pair(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, event_fmu: Callable[..., Path]
) -> Iterator[Pair]:
    kind, way = request.param
    mesh = mesh_of(kind, tmp_path_factory.mktemp("batches"), event_fmu)
    with mesh.batch(COPIES, **WAYS[way]) as batch:
        yield Pair(kind, mesh, batch)


def actions(kind: str) -> st.SearchStrategy[list[Action]]:
    values = st.lists(st.floats(-0.2, 0.2), min_size=COPIES, max_size=COPIES)
    truths = st.lists(st.booleans(), min_size=COPIES, max_size=COPIES)
    starts = st.lists(st.floats(0.01, 0.3), min_size=COPIES, max_size=COPIES)
    return st.lists(
        st.one_of(
            st.tuples(st.just("step"), st.integers(1, 9)),
            st.tuples(st.just("set"), st.tuples(st.sampled_from(SETTINGS[kind]), values)),
            st.tuples(st.just("reset"), truths),
            st.tuples(st.just("start"), st.tuples(truths, st.sampled_from(STARTS[kind]), starts)),
            st.tuples(st.just("save"), st.none()),
            st.tuples(st.just("restore"), st.tuples(st.integers(0, 3), truths)),
        ),
        max_size=14,
    )


def over_times(kind: str) -> st.SearchStrategy[OverTime]:
    """Lines and values that hold; a parameter has no lines."""
    times = st.lists(st.integers(1, 90), min_size=1, max_size=8, unique=True)
    course = st.tuples(times.map(sorted), st.sampled_from(["hold", "linear"]), st.floats(-0.2, 0.2))
    inputs = [name for name in SETTINGS[kind] if not name.endswith(".k")]
    timeout = st.fixed_dictionaries(
        {"after": st.integers(1, 30).map(lambda steps: steps * H), "then": st.sampled_from(["hold", 0.07, -0.05])}
    )

    def values(courses: dict[str, tuple[list[int], str, float]]) -> dict[str, dict[str, Any]]:
        return {
            name: {
                "times": [H * time for time in points],
                "values": [first * (1 + 0.1 * number) for number in range(len(points))],
                "interpolation": way if name in inputs else "hold",
            }
            for name, (points, way, first) in courses.items()
        }

    courses = st.dictionaries(st.sampled_from(SETTINGS[kind]), course, max_size=4).map(values)
    return st.builds(OverTime, courses, st.dictionaries(st.sampled_from(inputs), timeout, max_size=2))


class Driven:
    """A batch and systems of their own, to which the same is done."""

    def __init__(self, pair: Pair, stack: ExitStack) -> None:
        self._kind, self._mesh, self._batch = pair.kind, pair.mesh, pair.batch
        self._stack = stack
        self._saved: list[tuple[fmu_mesh.BatchState, list[fmu_mesh.SystemState], list[fmu_mesh.System]]] = []
        start = dict.fromkeys(STARTS[pair.kind], 0.1)
        self._batch.reset(start_values=start)
        self._systems = [self._opened(start) for _ in range(COPIES)]

    def _opened(self, start: Mapping[str, float]) -> fmu_mesh.System:
        return self._stack.enter_context(self._mesh.open(dict(start)))

    def step(self, points: int) -> None:
        self._batch.step(points)
        for own in self._systems:
            own.step(points)

    def set(self, argument: tuple[str, list[float]]) -> None:
        name, values = argument
        self._batch.set(name, values)
        for own, value in zip(self._systems, values, strict=True):
            own.set(name, value)

    def save(self, _: None) -> None:
        self._saved.append((self._batch.save(), [own.save() for own in self._systems], list(self._systems)))

    def restore(self, argument: tuple[int, list[bool]]) -> None:
        if self._saved:
            state, states, whose = self._saved[argument[0] % len(self._saved)]
            same = [own is before for own, before in zip(self._systems, whose, strict=True)]
            mask = np.array(argument[1]) & np.array(same)  # a copy that was reset is another system here
            self._batch.restore(state, mask)
            for number in np.flatnonzero(mask):
                self._systems[number].restore(states[number])

    def reset(self, mask: list[bool]) -> None:
        self._batch.reset(np.array(mask))
        for number in np.flatnonzero(mask):
            self._systems[number] = self._opened({})

    def start(self, argument: tuple[list[bool], str, list[float]]) -> None:
        mask, name, values = argument
        self._batch.reset(np.array(mask), {name: values})
        for number in np.flatnonzero(mask):
            self._systems[number] = self._opened({name: values[number]})

    def check(self) -> None:
        """Every float is the same, as text: shortest numbers."""
        batch, names = self._batch, READ[self._kind]
        columns = [batch.point, batch.time, *(batch.get(name) for name in names)]
        found = [repr(row) for row in zip(*(column.tolist() for column in columns), strict=True)]
        assert found == [repr((own.point, own.time, *map(own.get, names))) for own in self._systems]


@given(st.data())
@settings(max_examples=examples(15), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_copies_equal_systems_whatever_is_done_with_them(pair: Pair, data: st.DataObject) -> None:
    drawn = data.draw(actions(pair.kind))
    with ExitStack() as stack:
        driven = Driven(pair, stack)
        driven.check()
        for action, argument in [*drawn, ("step", 7)]:
            getattr(driven, action)(argument)
            driven.check()
        event(f"{len(drawn) // 5 * 5} actions or more")


@pytest.mark.parametrize("kind", ["native", "mixed"])
@pytest.mark.parametrize(("way", "most"), [("alone", 12), ("threads", 4), ("processes", 3)])
def test_inputs_over_time_go_on_after_any_restore(
    kind: str, way: str, most: int, tmp_path: Path, event_fmu: Callable[..., Path]
) -> None:
    @given(over_times(kind), st.data())
    @settings(max_examples=examples(most), deadline=None)
    def equal(over_time: OverTime, data: st.DataObject) -> None:
        mesh = mesh_of(kind, tmp_path, event_fmu, over_time)
        with ExitStack() as stack:
            batch = stack.enter_context(mesh.batch(COPIES, **WAYS[way]))
            driven = Driven(Pair(kind, mesh, batch), stack)
            given = ("set", (data.draw(st.sampled_from(SETTINGS[kind])), [0.11, 0.12, 0.13]))
            before = [("step", 4), ("save", None), ("step", 3), given, ("step", 6), ("save", None), ("step", 12)]
            after = [("restore", (number, [True] * COPIES)) for number in (0, 1)]
            for action, argument in [*before, *data.draw(actions(kind)), *after]:
                getattr(driven, action)(argument)
                driven.check()
                for points in (1, 1, 8, 5, 5, 5, 20) if (action, argument) in after else ():
                    driven.step(points)
                    driven.check()

    if (kind, way) == ("mixed", "threads"):
        pytest.skip("components in Python do not step on several threads")
    equal()


COMPONENT = """
import fmu_mesh

class Turning(fmu_mesh.Component):
    u = fmu_mesh.Input([1.0, 0.0, 0.0], shape=3)
    gain = fmu_mesh.Parameter(0.9, tunable=True)
    y = fmu_mesh.Output([0.0, 0.0, 0.0], shape=3)
    word = fmu_mesh.Output("none", type="String")
    count = fmu_mesh.Output(0, type="Int32")

    def step(self, time, step_size):
        self.y = self.gain * self.y + step_size * (self.u[[1, 2, 0]] + time)
        self.count += 1
        self.word = f"{self.y[0]:.3g}"
"""


def step_equally(batch: fmu_mesh.Batch, systems: list[fmu_mesh.System], names: list[str], points: int) -> None:
    batch.step(points)
    for own in systems:
        own.step(points)
    for name in names:
        expected = [np.array(own.get(name)).tolist() for own in systems]
        assert batch.get(name).tolist() == expected, (name, points)


@pytest.mark.parametrize(("library", "processes"), [(True, 1), (False, 1), (True, 2)], ids=["C", "Python", "processes"])
def test_components_arrays_texts_and_scenarios_are_the_same(
    library: bool,  # noqa: FBT001 a parameter of tests
    processes: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if not library:
        monkeypatch.setattr(native, "library", None)
    (tmp_path / "turning.py").write_text(COMPONENT)
    content = {
        "mesh": "turning",
        "simulation": {"stop_time": 2.0, "step_size": H},
        "instances": {
            "turning": {"python": "turning.py:Turning"},
            "gain": {"fmu": str(FMUS / "Gain.fmu"), "inputs": {"u": {"timeout": {"after": 0.2, "then": 0.5}}}},
            "fast": {"fmu": str(FMUS / "Integrator.fmu")},
            "cart": {"fmu": str(FMUS / "CartPole.fmu")},
        },
        "connections": ["turning.y[1] -> fast.u"],
        "scenario": {
            "values": {"cart.force": {"times": [0.1, 0.5, 1.0], "values": [0.0, 0.5, 0.2], "interpolation": "linear"}},
            "events": [{"at": 0.3, "set": {"turning.gain": 0.5}}, {"at": 0.9, "set": {"turning.gain": 0.7}}],
        },
    }
    config = tmp_path / "turning.yaml"
    config.write_text(yaml.safe_dump(content), encoding="utf-8")
    mesh = fmu_mesh.load(config)
    names = ["turning.y", "turning.word", "turning.count", "gain.y", "fast.y", "turning.u", "cart.x", "cart.force"]
    inputs = np.arange(6.0).reshape(2, 3)
    with mesh.batch(2, processes=processes) as batch, mesh.open() as first, mesh.open() as second:
        systems = [first, second]
        for points in (1, 9, 30):
            step_equally(batch, systems, names, points)
            if points == 9:
                batch.set({"turning.u": inputs, "gain.u": [3.0, 4.0]})
                for number, own in enumerate(systems):
                    own.set_many({"turning.u": inputs[number], "gain.u": 3.0 + number})
        state, states = batch.save(), [own.save() for own in systems]
        for points in (50, 25):
            step_equally(batch, systems, names, points)
        with pytest.raises(fmu_mesh.CallRefused, match="cannot be stepped by several threads, where both use"):
            mesh.batch(2, threads=2)
        batch.restore(state)
        for own, kept in zip(systems, states, strict=True):
            own.restore(kept)
        for points in (2, 40, 31):
            step_equally(batch, systems, names, points)
        batch.reset(np.array([False, True]))
        batch.step(10)
        with mesh.open() as again:
            again.step(10)
            assert batch.get("turning.y")[1].tolist() == again.get("turning.y").tolist()
    assert batch.point.tolist() == [123, 10]


@pytest.mark.parametrize("way", WAYS)
def test_ctrl_c_ends_a_call_with_all_copies_at_one_point(way: str) -> None:
    mesh = fmu_mesh.Mesh("m", step_size=H, stop_time=None)
    mesh.add("cart", fmu=str(FMUS / "CartPole.fmu"))
    with mesh.batch(3, **WAYS[way]) as batch:
        batch.step(10)
        threading.Timer(0.3, signal.raise_signal, [signal.SIGINT]).start()
        with pytest.raises(KeyboardInterrupt):
            batch.step(2**40)
        assert len({*batch.point.tolist()}) == 1
        assert batch.point[0] > 10
        batch.step(10)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize(
    ("library", "way"),
    [(True, {}), (False, {}), (True, {"threads": 3}), (True, {"processes": 3})],
    ids=["C", "Python", "threads", "processes"],
)
def test_each_copy_ends_where_a_single_system_ends(
    library: bool,  # noqa: FBT001 a parameter of tests
    way: dict[str, Any],
    faulty: Path,
    event_fmu: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Some fail, some ask to end, one gets to the end; those that go on are not touched."""
    if not library:
        monkeypatch.setattr(native, "library", None)
    mesh = fmu_mesh.Mesh("ends", step_size=H, stop_time=1.0)
    mesh.add("first", fmu=str(FMUS / "Integrator.fmu"), start_values={"y": 1.0})
    mesh.add("stairs", fmu=str(event_fmu("Stairs", 2)), kind="co_simulation", start_values={"period": 0.1})
    mesh.add("faulty", fmu=str(faulty))
    mesh.add("last", fmu=str(FMUS / "Integrator.fmu"), step_size=2 * H)
    mesh.connect("first.y", "faulty.u")
    mesh.connect("faulty.y", "last.u")
    fail_at = [1e300, 0.42, 1e300, 0.55, 0.07]
    end = [1000, 1000, 3, 2, 1000]
    with mesh.batch(5, **way) as batch:
        batch.reset(start_values={"faulty.fail_at": fail_at, "stairs.end": end})
        for points in (1, 6, 13, 30, 60):
            batch.step(points)

        found = [(point, reason) for point, reason in zip(batch.point, map(batch.reasons.get, range(5)), strict=True)]
        outputs = batch.get(["first.y", "last.y"]).tolist()
        assert batch.done.all()
        batch.reset(np.array([False, True, True, False, False]), {"faulty.fail_at": 1e300, "stairs.end": 1000})
        batch.step(100)
        assert [*batch.reasons] == [3, 4]
        again = batch.get(["first.y", "last.y"]).tolist()

    for number in range(5):
        with mesh.open({"faulty.fail_at": fail_at[number], "stairs.end": end[number]}) as system:
            reason = None
            try:
                system.step(100)
                reason = str(system.ended_by) if system.ended_by is not None else None
            except fmu_mesh.FmuError as error:
                reason = str(error)
            assert found[number][0] == system.point, number
            assert (found[number][1] is None) == (reason is None)
            if reason is not None and system.ended_by is None:
                assert found[number][1] == reason
            elif number != 4:
                assert outputs[number] == [system.get("first.y"), system.get("last.y")]
    assert again[1] == again[2] == outputs[0]


@pytest.mark.parametrize(("copies", "words"), [(0, "1 or more"), (-1, "1 or more"), (True, "int"), ("3", "int")])
def test_number_of_copies_is_one_or_more(copies: Any, words: str) -> None:  # noqa: ANN401  anything
    mesh = fmu_mesh.Mesh("m", step_size=H, stop_time=1.0)
    mesh.add("gain", fmu=str(FMUS / "Gain.fmu"))

    with pytest.raises(fmu_mesh.CallRefused, match=words):
        mesh.batch(copies)


def test_a_state_of_instances_that_have_failed_is_refused(faulty: Path) -> None:
    mesh = fmu_mesh.Mesh("m", step_size=H, stop_time=1.0)
    mesh.add("faulty", fmu=str(faulty))
    with mesh.batch(2) as batch:
        batch.reset(start_values={"faulty.fail_at": [0.055, 1e300]})
        state = batch.save()
        batch.step(10)
        batch.reset([True, False], {"faulty.fail_at": 1e300})
        batch.step(3)

        with pytest.raises(fmu_mesh.CallRefused, match="a state that was saved before belongs to the others"):
            batch.restore(state, [True, False])
        batch.restore(state, [False, True])
        batch.step(20)
        assert batch.point.tolist() == [23, 20]


@pytest.mark.parametrize("how", ["closed", "dropped_elsewhere"])
def test_threads_end_with_their_batch(how: str) -> None:
    before = {*threading.enumerate()}
    mesh = fmu_mesh.Mesh("m", step_size=H, stop_time=1.0)
    mesh.add("gain", fmu=str(FMUS / "Gain.fmu"))
    batches = [mesh.batch(4, threads=3)]
    batches[0].step()
    assert len({*threading.enumerate()} - before) == 2

    if how == "closed":
        batches.pop().close()
    else:
        other = threading.Thread(target=batches.clear)
        other.start()
        other.join()

    assert {*threading.enumerate()} <= before


def test_a_batch_that_is_left_open_lets_the_interpreter_end() -> None:
    text = "import fmu_mesh; mesh = fmu_mesh.Mesh('m', step_size=0.1, stop_time=1.0)"
    text += f"; mesh.add('gain', fmu='{FMUS}/Gain.fmu'); batch = mesh.batch(4, threads=2)"
    program = f"{text}; batch.step(); print(batch.point.tolist())"

    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=100)

    assert (done.returncode, done.stdout, done.stderr) == (0, "[1, 1, 1, 1]\n", "")


@pytest.fixture
def gains() -> Iterator[fmu_mesh.Batch]:
    mesh = fmu_mesh.Mesh("m", step_size=H, stop_time=1.0)
    mesh.add("gain", fmu=str(FMUS / "Gain.fmu"))
    with mesh.batch(2) as batch:
        yield batch


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("gain.v", 1.0, "there is no variable 'v'"),
        ("gian.u", 1.0, "there is no instance 'gian'"),
        ("gain.u", [1.0, 2.0, 3.0], r"values of shape \(3,\); expected \(2,\), or \(\) for all copies"),
        ("gain.u", [1.0, np.nan], "not finite"),
        ("gain.u", ["a", "b"], "expected"),
        ("gain.y", 1.0, "is no input and no parameter"),
    ],
)
def test_wrong_values_are_refused_and_none_is_set(gains: fmu_mesh.Batch, name: str, values: Any, words: str) -> None:  # noqa: ANN401  anything
    with pytest.raises(fmu_mesh.CallRefused, match=words):
        gains.set({"gain.k": [5.0, 6.0], name: values})
    gains.set("gain.u", 1.0)
    gains.step()

    assert gains.get("gain.y").tolist() == [1.0, 1.0]


def test_start_values_of_other_copies_are_ignored(gains: fmu_mesh.Batch) -> None:
    gains.step(3)
    gains.reset([False, True], {"gain.k": [np.nan, 4.0]})

    assert gains.get("gain.k").tolist() == [1.0, 4.0]
    assert gains.point.tolist() == [3, 0]


def test_a_batch_is_planned_once_for_the_same_start_values(
    gains: fmu_mesh.Batch, monkeypatch: pytest.MonkeyPatch
) -> None:
    planned, original = list[object](), preparing.planned

    def counting(*given: Any, **named: Any) -> RunPlan:  # noqa: ANN401  those of the function
        planned.append(given)
        return original(*given, **named)

    monkeypatch.setattr(resetting, "planned", counting)
    for value in (1.0, 2.0, 3.0):
        gains.reset(start_values={"gain.k": [value, -value]})
        assert gains.get("gain.k").tolist() == [value, -value]
    assert len(planned) == 1
    gains.reset(start_values={"gain.k": 4.0, "gain.u": 5.0})
    assert len(planned) == 2

    for _ in range(2):  # what is wrong is planned, which says why
        with pytest.raises(ConfigurationError, match="'NaN' for the Real 'k'; expected a finite number"):
            gains.reset(start_values={"gain.k": np.nan})
    assert len(planned) == 4
    assert gains.get("gain.k").tolist() == [4.0, 4.0]


def test_results_go_into_given_arrays(gains: fmu_mesh.Batch) -> None:
    gains.set({"gain.u": [1.0, 2.0]})
    gains.step()
    out, wide = np.empty(2), np.zeros((2, 5))

    assert gains.get("gain.y", out=out) is out
    assert gains.get(["gain.y", "gain.u"], out=wide[:, 1:3]).tolist() == [[1.0, 1.0], [2.0, 2.0]]
    assert wide[:, [0, 3, 4]].sum() == 0.0
    for wrong in (np.empty(3), np.empty(2, np.float32), np.empty((2, 2))):
        with pytest.raises(fmu_mesh.CallRefused, match="`out` has shape"):
            gains.get("gain.y", out=wrong)
    with pytest.raises(fmu_mesh.CallRefused, match="not contiguous"):
        gains.get(["gain.y", "gain.u"], out=np.empty((2, 4))[:, ::2])


def test_a_closed_batch_says_so(gains: fmu_mesh.Batch) -> None:
    state = gains.save()
    gains.close()
    gains.close()

    for call in (gains.step, gains.save, lambda: gains.get("gain.y"), lambda: gains.restore(state)):
        with pytest.raises(fmu_mesh.CallRefused, match="the batch is closed"):
            call()
