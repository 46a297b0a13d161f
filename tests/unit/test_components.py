"""Components in Python without a mesh: their variables, values, states, and where their class is."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, assert_type

import numpy as np
import pytest
import threadpoolctl
from numpy.typing import NDArray

import fmu_mesh
from fmu_mesh import Component, Input, Output, Parameter, component
from fmu_mesh.config.mesh import LimitsConfig
from fmu_mesh.errors import CallRefused, ConfigurationError, FmuError, InitializationFailed, StepFailed
from fmu_mesh.instances.contract import Opening
from fmu_mesh.instances.python.importing import component_section, description_of
from fmu_mesh.instances.python.python_instance import PythonInstance
from fmu_mesh.instances.python.python_kind import KIND_OF_COMPONENTS
from fmu_mesh.instances.python.python_section import PythonConfig, class_place_of, importing
from fmu_mesh.instances.python.unit_names import base_unit_of
from fmu_mesh.rings.ring import Ring
from fmu_mesh.run.threads import one_thread_meanwhile
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.layout import Layout
from fmu_mesh.variables.units import BaseUnit, conversion


class Everything(Component):
    """One variable of each kind.

    More about it.
    """

    gain = Parameter(2.0, tunable=True, min=0.0)
    order = Parameter(3)
    table = Parameter([[1.0, 2.0], [3.0, 4.0]])
    name = Parameter("x")
    u = Input(unit="rad")
    n = Input(7, type="Int32", max=9)
    on = Input(type="Boolean")
    v = Input(shape=3)
    y = Output(depends_on=("u",), description="what comes out")
    mode = Output("on", type="Enumeration", items={"off": 0, "on": 1})
    m = Output(shape=(2, 2))

    def initialize(self) -> None:
        self.y = self.u

    def step(self, time: float, step_size: float) -> None:
        self.y = self.gain * self.u + time * step_size
        self.m = self.table


def test_type_checker_sees_types_of_values_and_component_has_its_start_values() -> None:
    own = Everything()

    assert_type(own.gain, float)
    assert_type(own.order, int)
    assert_type(own.name, str)
    assert_type(own.u, float)
    assert_type(own.n, int)
    assert_type(own.on, bool)
    assert_type(own.v, NDArray[Any])
    assert_type(own.y, float)
    assert_type(own.mode, int)
    assert (own.gain, own.order, own.name, own.u, own.n, own.on, own.y, own.mode) == (
        2.0,
        3,
        "x",
        0.0,
        7,
        False,
        0.0,
        1,
    )
    assert [(array.dtype.name, array.shape) for array in (own.table, own.v)] == [("float64", (2, 2)), ("float64", (3,))]


def test_two_components_share_no_values() -> None:
    one, two = Everything(), Everything()

    one.v[0] = 1.0
    one.table[0, 0] = 5.0

    assert two.v[0] == 0.0
    assert two.table[0, 0] == 1.0


def test_the_description_has_what_the_class_declares() -> None:
    description = description_of(Everything, "abc")
    of = {variable.name: variable for variable in description.variables}

    assert (description.model_name, description.description) == ("Everything", "One variable of each kind.")
    assert [variable.value_reference for variable in description.variables] == list(range(11))
    assert (of["gain"].variability, of["order"].variability) == ("tunable", "fixed")
    assert (of["order"].type, of["table"].type, of["name"].type) == ("Int64", "Float64", "String")
    assert (of["n"].start, of["n"].maximum, of["n"].variability) == (7, 9.0, "discrete")
    assert of["u"].base_unit == BaseUnit(rad=1)
    assert of["y"].dependencies == ("u",)
    assert of["m"].dependencies == ("u", "n", "on", "v")  # it is initialized, and does not say from what
    assert of["mode"].items == (("off", 0), ("on", 1))


def test_an_output_that_is_not_initialized_depends_on_nothing() -> None:
    class Plain(Component):
        u = Input()
        y = Output()

        def step(self, time: float, step_size: float) -> None: ...

    [_, y] = description_of(Plain, "").variables
    assert y.dependencies == ()


def test_a_class_inherits_variables_and_may_replace_them() -> None:
    class Special(Everything):
        gain = Parameter(9.0)
        more = Input()

    names = [variable.name for variable in description_of(Special, "").variables]

    assert names == [*(v.name for v in description_of(Everything, "").variables), "more"]
    assert Special().gain == 9.0


UNTYPED_INPUT: Any = Input
UNTYPED_PARAMETER: Any = Parameter


@pytest.mark.parametrize(
    ("declare", "message"),
    [
        (lambda: UNTYPED_INPUT("much"), "the start value 'much' is wrong: a number"),
        (lambda: UNTYPED_INPUT(type="Float"), "'Float' is no type of a variable"),
        (lambda: UNTYPED_INPUT(shape=0), "an array cannot have the shape"),
        (lambda: UNTYPED_INPUT([1.0], shape=2), "a list of 2 values"),
        (lambda: UNTYPED_INPUT(units="m"), "a variable has no 'units'"),
        (lambda: UNTYPED_INPUT(5.0, max=1.0), "the start value 5.0 is wrong"),
        (lambda: UNTYPED_PARAMETER(None), "the default value None of a parameter has no type of FMI"),
        (lambda: component(y=Output())(lambda *u: u), "has no name that can be connected"),
        (lambda: component(z=Input(), y=Output())(lambda u: u), "'z' does not fit the function"),
        (lambda: component()(lambda u: u), "there is no output"),
        (lambda: component(u=Output())(lambda u: u), "'u' does not fit the function"),
    ],
)
def test_a_wrong_declaration_is_refused_where_it_stands(declare: Callable[[], object], message: str) -> None:
    with pytest.raises(CallRefused, match=r"(?s).*") as caught:
        declare()

    assert message in str(caught.value)


def test_a_variable_cannot_have_the_name_of_a_method() -> None:
    class Wrong(Component):
        close = Input()  # type: ignore[assignment]  # which a type checker refuses, too

        def step(self, time: float, step_size: float) -> None: ...

    with pytest.raises(CallRefused, match="'close' of 'Wrong' has the name of something that every component has"):
        description_of(Wrong, "")


def test_a_function_with_two_outputs_returns_a_tuple() -> None:
    @component(n=Input(type="Int32"), y=Output(), half=Output())
    def split(time: float, step_size: float, n: int, k: float = 2.0) -> object:
        return (k * n + time, 5 * step_size * n) if n < 3 else n

    assert [v.name for v in description_of(split, "").variables] == ["n", "k", "y", "half"]
    own: Any = split()
    own.n = 2
    own.step(1.0, 0.1)
    assert (own.y, own.half) == (5.0, 1.0)
    own.n = 3
    with pytest.raises(ValueError, match="the function returned a value of the type int, expected a tuple of 2"):
        own.step(1.0, 0.1)


@pytest.mark.parametrize(
    ("unit", "in_base_units"),
    [
        ("N.m", BaseUnit(kg=1, m=2, s=-2)),
        ("m/s2", BaseUnit(m=1, s=-2)),
        ("kg/(m.s2)", BaseUnit(kg=1, m=-1, s=-2)),
        ("mm", BaseUnit(m=1, factor=1e-3)),
        ("km/h", BaseUnit(m=1, s=-1, factor=1e3 / 3600.0)),
        ("kW.h", BaseUnit(kg=1, m=2, s=-2, factor=1e3 * 3600.0)),
        ("1/s", BaseUnit(s=-1)),
        ("m.s-1", BaseUnit(m=1, s=-1)),
        ("mV", BaseUnit(kg=1, m=2, s=-3, A=-1, factor=1e-3)),
        ("furlong", None),
        ("degC/s", None),
        ("mdeg", None),
        ("m/", BaseUnit(m=1)),
        ("", None),
    ],
)
def test_a_unit_is_known_by_its_usual_name(unit: str, in_base_units: BaseUnit | None) -> None:
    assert base_unit_of(unit) == in_base_units


def test_degrees_become_kelvin() -> None:
    celsius, kelvin = base_unit_of("degC"), base_unit_of("K")
    assert celsius is not None
    assert kelvin is not None
    change = conversion(celsius, kelvin)
    assert change is not None
    assert (change.factor, change.offset) == (1.0, 273.15)


# --- an instance on rings

SOURCE = """\
import threading
import numpy as np
import fmu_mesh
from fmu_mesh import Input, Output, Parameter

class Sum(fmu_mesh.Component):
    value = None
    k = Parameter(1.0, tunable=True)
    u = Input()
    y = Output(0.0)

    def __init__(self):
        self.seen = []

    def initialize(self):
        self.seen.append(self.u)
        self.y = self.k * sum(self.seen)

    def step(self, time, step_size):
        self.seen.append(self.u)
        self.y = self.k * sum(self.seen)

class Locked(Sum):
    def __init__(self):
        self.seen = []
        self.lock = threading.Lock()

class Own(Locked):
    def get_state(self):
        return list(self.seen)

    def set_state(self, state):
        self.seen = list(state)

class Anything(fmu_mesh.Component):
    f = Output(0.0)
    s = Output(0.0, type="Float32")
    n = Output(0, type="Int8")
    b = Output(False, type="Boolean")
    t = Output("", type="String")
    x = Output(b"", type="Binary")
    e = Output("off", type="Enumeration", items={"off": 0, "on": 2})
    a = Output([0, 0], shape=2)
    i = Output([0, 0], shape=2, type="Int8")
    c = Output([["", ""]], shape=(1, 2), type="String")

    def step(self, time, step_size):
        vars(self).update(next(self.values))
"""


class Bench:
    """One component of `SOURCE` on rings, with steps of 0.5 s."""

    def __init__(self, folder: Path, name: str, **start_values: Any) -> None:  # noqa: ANN401 of any type
        path = folder / "parts.py"
        path.write_text(SOURCE, encoding="utf-8")
        section = PythonConfig(python=f"parts.py:{name}")
        description = KIND_OF_COMPONENTS.describe(path, section, LimitsConfig(), lambda _text: None)
        self.instance = PythonInstance(
            Opening(name="c", path=path, section=section, description=description, folder=folder)
        )
        self.instance.enter_initialization(10.0, None, start_values)
        of = description.variables
        self.inputs = Ring(Layout.of([v for v in of if v.causality == "input"]), 4)
        self.outputs = Ring(Layout.of([v for v in of if v.causality == "output"]), 4)

    def start(self) -> None:
        self.instance.exit_initialization()
        self.instance.bind(self.inputs, [self.outputs], TimeGrid(start_time=10.0, step_size=0.5, last_point=100), 1)

    def step(self, step: int, **inputs: float) -> Any:  # noqa: ANN401 of any type
        for name, value in inputs.items():
            self.inputs.put(step, name, value)
        self.instance.do_step(step)
        return self.outputs.value(step + 1, "y")

    def assign(self, name: str, value: object) -> Any:  # noqa: ANN401 of any type
        """What is in the row after a step that assigns this value."""
        vars(self.instance._component)["values"] = iter([{name: value}])
        self.instance.do_step(0)
        return self.outputs.value(1, name)


def test_initialize_gives_the_same_however_often_it_is_called(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "Sum", k=2.0)
    values = []
    for u in (1.0, 5.0, 5.0, 1.0):
        bench.instance.set_values({"u": u})
        values += bench.instance.get_values(["y"])
    bench.start()

    assert values == [2.0, 10.0, 10.0, 2.0]
    assert [bench.outputs.value(0, "y"), bench.step(0, u=3.0)] == [2.0, 8.0]


def test_a_state_is_restored_as_often_as_needed(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "Sum")
    bench.start()
    bench.step(0, u=1.0)
    state = bench.instance.get_state()
    after = [bench.step(1, u=2.0), bench.step(2, u=3.0)]

    for _ in range(2):
        bench.instance.set_state(state)
        assert [bench.step(1, u=2.0), bench.step(2, u=3.0)] == after == [3.0, 6.0]


def test_a_component_whose_attributes_cannot_be_copied_is_refused_or_helps_itself(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "Locked")
    bench.start()
    with pytest.raises(FmuError, match=r"instance c.*TypeError: cannot pickle"):
        bench.instance.get_state()

    own = Bench(tmp_path, "Own")
    own.start()
    own.step(0, u=1.0)
    state = own.instance.get_state()
    first = own.step(1, u=2.0)
    own.instance.set_state(state)
    assert own.instance.get_values(["y"]) == [1.0]
    assert own.step(1, u=2.0) == first == 3.0


@pytest.mark.parametrize(
    ("name", "value", "row"),
    [
        ("f", 1, 1.0),
        ("f", np.float32(0.5), 0.5),
        ("f", np.array(2.5), 2.5),
        ("f", float("inf"), float("inf")),
        ("s", 0.1, float(np.float32(0.1))),
        ("n", np.int64(-128), -128),
        ("b", np.True_, True),
        ("t", "é", "é"),
        ("x", b"\0", b"\0"),
        ("e", "on", 2),
        ("e", 0, 0),
        ("a", [1, 2.5], [1.0, 2.5]),
        ("a", np.array([1, 2], dtype=np.int8), [1.0, 2.0]),
        ("i", np.array([1, 2]), [1, 2]),
        ("c", [["a", "b"]], [["a", "b"]]),
    ],
)
def test_an_output_takes_what_its_type_can_hold(tmp_path: Path, name: str, value: object, row: object) -> None:
    bench = Bench(tmp_path, "Anything")
    bench.start()

    assert bench.assign(name, value) == row


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("f", "1"),
        ("f", "NaN"),
        ("f", None),
        ("f", True),
        ("f", 1j),
        ("f", [1.0]),
        ("f", np.array([1.0])),
        ("n", 128),
        ("n", 1.0),
        ("n", True),
        ("b", 1),
        ("t", b"x"),
        ("x", "eA=="),
        ("e", 1),
        ("e", "onn"),
        ("a", [1.0]),
        ("a", [1.0, "2"]),
        ("a", [[1.0, 2.0]]),
        ("a", 1.0),
        ("a", [True, False]),
        ("i", [1, 300]),
        ("i", [1.0, 2.0]),
        ("c", ["a", "b"]),
        ("c", [["a", 1]]),
    ],
)
def test_an_output_refuses_anything_else_by_its_name(tmp_path: Path, name: str, value: object) -> None:
    bench = Bench(tmp_path, "Anything")
    bench.start()

    with pytest.raises(StepFailed, match=r"its value is .*, expected ") as caught:
        bench.assign(name, value)

    assert (caught.value.instance, caught.value.variable) == ("c", name)


def test_the_folder_and_the_module_are_forgotten_when_it_is_closed(tmp_path: Path) -> None:
    path, finders, modules = list(sys.path), list(sys.meta_path), set(sys.modules)
    first, second = Bench(tmp_path, "Sum"), Bench(tmp_path, "Sum")
    assert type(first.instance._component) is not type(second.instance._component)

    first.instance.close()
    second.instance.close()
    second.instance.close()

    assert (sys.path, sys.meta_path) == (path, finders)
    assert {name for name in sys.modules if "@" in name} <= modules
    with pytest.raises(ValueError, match="instance 'c' is closed"):
        second.instance.get_state()


def test_what_fails_at_the_start_is_no_failed_step(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "Sum")
    vars(bench.instance._component)["k"] = "text"

    with pytest.raises(InitializationFailed, match=r"parts.py:\d+: TypeError: "):
        bench.instance.get_values(["y"])


# --- where a class is


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("controller.py:Controller", ("controller.py", "", "Controller")),
        ("../a b/c.py:C", ("../a b/c.py", "", "C")),
        ("package.module:C", ("", "package.module", "C")),
        ("controller.py", ("controller.py", "", "")),
    ],
)
def test_a_class_is_named_by_its_file_or_its_module(text: str, place: Sequence[str]) -> None:
    assert class_place_of(text) == tuple(place)


def test_processes_agree_about_the_class_and_not_about_where_it_is() -> None:
    here = PythonConfig(python="/here/c.py:C", interpreter="/usr/bin/python3", arguments={"n": 1})
    there = PythonConfig(python="../c.py:C", arguments={"n": 1})

    assert here.agreed() == there.agreed()
    assert here.agreed() != PythonConfig(python="c.py:D", arguments={"n": 1}).agreed()


@pytest.mark.parametrize(
    ("interpreter", "found"),
    [("env/bin/python", "/folder/env/bin/python"), ("~/bin/python", str(Path.home() / "bin/python")), ("/p", "/p")],
)
def test_an_interpreter_is_looked_for_beside_the_configuration(interpreter: str, found: str) -> None:
    assert PythonConfig(python="c.py:C", interpreter=interpreter).located(Path("/folder")).interpreter == found


def test_class_of_file_is_named_by_it_and_described_without_another_process() -> None:
    keys, description = component_section(Everything)

    assert keys == {"python": f"{Path(__file__).resolve()}:Everything"}
    assert description.model_name == "Everything"


@pytest.mark.parametrize(
    ("thing", "message"),
    [
        (lambda u: u, "is no `fmu_mesh.Component`"),
        (5, "5 is no `fmu_mesh.Component`"),
        (type("Made", (Component,), {}), "no file has it"),
    ],
)
def test_what_others_cannot_import_is_refused(thing: object, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        component_section(thing)


def test_only_the_thread_that_imports_a_component_is_refused_a_run(tmp_path: Path) -> None:
    """Another thread of the program may start one meanwhile."""
    (tmp_path / "slow.py").write_text(
        "import threading, fmu_mesh\n"
        "from fmu_mesh.instances.python.python_section import importing\n"
        "here = importing.get()\n"
        "there = []\n"
        "other = threading.Thread(target=lambda: there.append(importing.get()))\n"
        "other.start()\nother.join()\n"
        "class C(fmu_mesh.Component):\n"
        "    here = fmu_mesh.Output(str(here), type='String')\n"
        "    there = fmu_mesh.Output(str(there), type='String')\n"
        "    def step(self, time, step_size): pass\n",
        encoding="utf-8",
    )
    section = PythonConfig(python="slow.py:C")
    path = tmp_path / "slow.py"
    description = KIND_OF_COMPONENTS.describe(path, section, LimitsConfig(), lambda _text: None)
    instance = PythonInstance(Opening(name="c", path=path, section=section, description=description, folder=tmp_path))

    assert instance.get_values(["here", "there"]) == ["slow.py", "[None]"]
    assert importing.get() is None
    assert threading.active_count() >= 1
    instance.close()


def test_overlapping_local_runs_limit_threads_until_the_last_one_ends() -> None:
    def threads() -> set[int]:
        return {library["num_threads"] for library in threadpoolctl.threadpool_info()}

    one, other = one_thread_meanwhile(), one_thread_meanwhile()
    with threadpoolctl.threadpool_limits(2):
        one.__enter__()
        other.__enter__()
        during = threads()
        one.__exit__(None, None, None)
        still = threads()
        other.__exit__(None, None, None)

        assert (during, still, threads()) == ({1}, {1}, {2})


def test_the_public_names_are_those_of_components() -> None:
    assert {"Component", "Input", "Output", "Parameter", "component"} <= {*fmu_mesh.__all__}
    assert fmu_mesh.Component is Component
