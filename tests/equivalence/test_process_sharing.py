"""What runs together computes what it computes apart, or does not start, and the error names both instances."""

from __future__ import annotations

import subprocess
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

import fmu_mesh
from fmu_mesh.errors import ConfigurationError
from tests.fmus.helpers import FMUS, NO_COMPILER
from tests.fmus.packing import repacked
from tests.helpers import DEADLINE_S, write_config

pytestmark = pytest.mark.skipif(NO_COMPILER is not None, reason=NO_COMPILER or "")

Instances = Mapping[str, Mapping[str, Any]]
COUNTING = "static double n; double value(void) {{ return n += {gain}; }}\n"
UNIQUE = """
inline double& total() {{ static double n = {gain}; return n; }}
template <class T> struct Counted {{ static T n; }};
template <class T> T Counted<T>::n = 0;
extern "C" double value() {{ return total() + (Counted<int>::n += 1); }}
"""
EMBEDDED = """
int PyGILState_Ensure(void); void PyGILState_Release(int); int PyRun_SimpleString(const char *);
void *PyImport_ImportModule(const char *); void *PyObject_GetAttrString(void *, const char *);
double PyFloat_AsDouble(void *); int Py_IsInitialized(void); void Py_Initialize(void);
double value(void)
{{
    int state;
    double found;

    if (!Py_IsInitialized()) Py_Initialize();
    state = PyGILState_Ensure();
    PyRun_SimpleString("import sys; sys.path.append('{folder}')");
    found = PyFloat_AsDouble(PyObject_GetAttrString(PyImport_ImportModule("slave_of_test"), "GAIN"));
    PyGILState_Release(state);
    return found;
}}
"""
COMPONENT = """
import fmu_mesh
from helper import values

class C(fmu_mesh.Component):
    y = fmu_mesh.Output(0.0)

    def step(self, time, step_size):
        values.append(values[0])
        self.y = sum(values)
"""


def fmu_of(folder: Path, *link: str | Path, add: Mapping[str, Path] = {}) -> str:
    """An FMU with the output `y` of what `value` of ``link`` returns in each step."""
    with zipfile.ZipFile(FMUS / "Gain.fmu") as gain:
        gain.extractall(folder / "gain")
    sources = folder / "gain" / "sources"
    own = (sources / "Gain.c").read_text().replace("s->y = s->k * s->u;", "s->y = value();")
    (sources / "Gain.c").write_text(f"double value(void);\n{own}")
    library = folder / "Gain.so"
    compiled("cc", library, *sorted(sources.glob("*.c")), f"-I{sources}", *link, "-Wl,-rpath,$ORIGIN")
    libraries = {"Gain.so": library, **add}
    return str(
        repacked(
            folder / "model.fmu",
            keep=lambda name: not name.startswith("binaries/"),
            add={f"binaries/linux64/{name}": path.read_bytes() for name, path in libraries.items()},
        )
    )


def compiled(compiler: str, target: Path, *arguments: str | Path) -> Path:
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", target, *arguments], check=True, timeout=DEADLINE_S)
    return target


def with_helper(folder: Path, gain: float) -> dict[str, str]:
    """An FMU whose library needs a `libhelper.so` that lies beside it."""
    code = folder / "helper.c"
    code.write_text(COUNTING.format(gain=gain))
    helper = compiled("cc", folder / "libhelper.so", code, "-Wl,-soname,libhelper.so")
    return {"fmu": fmu_of(folder, helper, add={"libhelper.so": helper})}


def with_unique_symbols(folder: Path, gain: float) -> dict[str, str]:
    """An FMU with inline singletons and static variables of templates."""
    code = folder / "unique.cpp"
    code.write_text(UNIQUE.format(gain=gain))
    subprocess.run(["c++", "-c", "-fPIC", "-o", folder / "unique.o", code], check=True, timeout=DEADLINE_S)
    return {"fmu": fmu_of(folder, folder / "unique.o")}


def with_python(folder: Path, gain: float) -> dict[str, str]:
    """An FMU that runs Python, as those of PythonFMU."""
    (folder / "slave_of_test.py").write_text(f"GAIN = {gain}\n")
    code = folder / "embedding.c"
    code.write_text(EMBEDDED.format(folder=folder))
    return {"fmu": fmu_of(folder, code)}


def component(folder: Path, gain: float) -> dict[str, str]:
    """A component that imports a module of its folder."""
    (folder / "helper.py").write_text(f"values = [{gain}]\n")
    (folder / "controller.py").write_text(COMPONENT)
    return {"python": f"{folder / 'controller.py'}:C"}


KINDS: dict[str, tuple[Callable[[Path, float], dict[str, str]], str]] = {
    "helper libraries": (with_helper, ""),
    "unique symbols": (with_unique_symbols, "both have the C++ variable '"),
    "embedded Python": (with_python, "both use the interpreter of Python"),
    "components": (component, ""),
}
"""By what two instances have in common: how to make such a model, and the reason why they cannot share a process."""


def made(kind: str, folder: Path, *, twice: bool) -> Instances:
    """Two instances: of one model, or of two that differ."""
    make = KINDS[kind][0]
    models = []
    for name, gain in (("a", 2.0),) if twice else (("a", 2.0), ("b", 30.0)):
        (folder / name).mkdir()
        models.append(make(folder / name, gain))
    return {"a": models[0], "b": models[-1]}


def numbers(result: fmu_mesh.Result) -> dict[str, list[float]]:
    return {name: result[name].tolist() for name in ("a.y", "b.y")}


@pytest.mark.parametrize("twice", [False, True], ids=["two models", "one model twice"])
@pytest.mark.parametrize("kind", KINDS)
def test_together_are_the_numbers_of_apart_or_a_refusal(kind: str, tmp_path: Path, *, twice: bool) -> None:
    instances, reason = made(kind, tmp_path, twice=twice), KINDS[kind][1]

    def mesh(group: str | None = None) -> fmu_mesh.Mesh:
        grouped = {name: {**own, **({"group": group} if group else {})} for name, own in instances.items()}
        return fmu_mesh.load(write_config(tmp_path, instances=grouped, connections=[], stop_time=0.005))

    def stepped() -> dict[str, list[float]]:
        found: dict[str, list[float]] = {"a.y": [], "b.y": []}
        with mesh().open() as system:
            for point in range(6):
                if point:
                    system.step()
                for name, values in found.items():
                    values.append(system.get(name))
        return found

    def repeated() -> dict[str, list[float]]:
        with mesh().repeated() as runs:
            return numbers(runs.run())

    apart = numbers(mesh().run(record="memory"))
    together: dict[str, Callable[[], dict[str, list[float]]]] = {
        "a group": lambda: numbers(mesh("g").run(record="memory")),
        "--local": lambda: numbers(mesh().run(record="memory", processes=False)),
        "open": stepped,
        "repeated": repeated,
    }
    assert (apart["a.y"] == apart["b.y"]) == twice
    for way, run in together.items():
        if reason:
            with pytest.raises(ConfigurationError, match="'a' and 'b' cannot run in one process") as caught:
                run()
            assert (reason in str(caught.value), caught.value.exit_code) == (True, 2), way
        else:
            assert run() == apart, way

    with fmu_mesh.sweep(mesh(), {"simulation.step_size": [0.001]}, workers=1, folder=tmp_path / "sweep") as running:
        (row,) = running.wait(DEADLINE_S)
    assert row.values == {"last(a.y)": apart["a.y"][-1], "last(b.y)": apart["b.y"][-1]}


def test_group_auto_gives_instances_that_cannot_share_a_process_two(tmp_path: Path) -> None:
    instances = made("unique symbols", tmp_path, twice=True)
    cycle = ["a.y -> b.u", "b.y -> a.u"]
    config = write_config(tmp_path, instances=instances, connections=cycle, stop_time=0.005)

    check = fmu_mesh.load(config).check()
    automatic = fmu_mesh.load(config).plan(config_values={"group": "auto"}).plan

    assert {automatic.node_of("a"), automatic.node_of("b")} == {"a", "b"}
    assert "'a' and 'b' cannot run in one process: both have the C++ variable '" in check.page


def test_a_variant_whose_model_cannot_follow_another_one_gets_processes(tmp_path: Path) -> None:
    instances = made("unique symbols", tmp_path, twice=False)
    config = write_config(tmp_path, instances={"a": instances["a"]}, connections=[], stop_time=0.005)
    models = [own["fmu"] for own in instances.values()]
    alone = [fmu_mesh.load(config).run(config_values={"instances.a.fmu": fmu}, record="memory") for fmu in models]

    with fmu_mesh.sweep(config, {"instances.a.fmu": models}, workers=1, folder=tmp_path / "sweep") as running:
        found = running.wait(DEADLINE_S)

    assert [row.values["last(a.y)"] for row in found] == [result["a.y"][-1] for result in alone]
