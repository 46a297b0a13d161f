"""Calls of an FMU have deadlines, and leave the state of the process alone."""

from __future__ import annotations

import ctypes
import locale
import os
import signal
import subprocess
import sys
import threading
import zipfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

import fmu_mesh
from fmu_mesh import FMIAdapter
from fmu_mesh.errors import FmuError, InitializationFailed, LoadFailed, StepFailed
from fmu_mesh.instances.call_guard import CallWatch, current_function
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.calls import FmpyCalls, Function
from fmu_mesh.instances.fmi.co_simulation.fmi2 import Fmi2Instance
from fmu_mesh.instances.fmi.fmu_values import Verb
from fmu_mesh.instances.process_state import floating_point_changed, kept_state, restore_floating_point
from fmu_mesh.variables.value_types import VariableType
from fmus.build import find_compiler
from tests.fmus.helpers import NO_COMPILER
from tests.fmus.packing import repacked
from tests.helpers import DEADLINE_S, FMUS

UPWARD, DOWNWARD, TOWARD_ZERO = 0x800, 0x400, 0xC00  # of x86; other processors have other numbers

SLY = """
#include <stddef.h>
void *fmi2Instantiate(void) { static int it; return &it; }
int fmi2SetupExperiment(void) { return 0; }
int fmi2EnterInitializationMode(void) { return 0; }
int fmi2ExitInitializationMode(void) { return 0; }
int fmi2SetReal(void) { return 0; }
int fmi2GetReal(void *c, const unsigned r[], size_t n, double y[]) { while (n--) y[n] = 0.0; return 0; }
long syscall(long number, ...);
int fmi2DoStep(void) { return syscall(80, "/") == 0 ? 0 : 3; } /* chdir on x86 */
"""

libc = ctypes.CDLL(None)
x86 = pytest.mark.skipif(os.uname().machine != "x86_64", reason="the numbers of the rounding modes are those of x86")


class Overruns:
    """What a watch has found."""

    def __init__(self) -> None:
        self.found: list[FmuError] = []
        self.there = threading.Event()

    def take(self, error: FmuError) -> None:
        self.found.append(error)
        self.there.set()


@pytest.fixture
def overruns() -> Overruns:
    return Overruns()


@pytest.fixture
def watch(overruns: Overruns) -> Iterator[CallWatch]:
    watch = CallWatch(overruns.take)
    yield watch
    watch.close()


class Hanging:
    """Stands for FMPy's object of an FMU, whose call returns when the watch has found that it is late."""

    def __init__(self, overruns: Overruns) -> None:
        self.component = 0
        self._overruns = overruns

    def enterInitializationMode(self) -> None:  # noqa: N802 as FMPy names it
        assert self._overruns.there.wait(DEADLINE_S)


def test_a_call_that_meets_its_deadline_is_told_with_function_of_fmi(watch: CallWatch, overruns: Overruns) -> None:
    fmu = FmpyCalls(Hanging(overruns), "fmi2", {})

    with watch.calling("plant", InitializationFailed, "call", 0.05):
        fmu.enterInitializationMode()

    (error,) = overruns.found
    assert type(error) is InitializationFailed
    assert error.instance == "plant"
    assert error.message.endswith("s from fmi2EnterInitializationMode; its process is ended")
    assert error.hint is not None
    assert "`timeouts.call`" in error.hint
    assert current_function(threading.get_ident()) is None


def test_a_function_is_named_by_its_prefix_unless_it_has_another_name() -> None:
    class Slave:
        component = 0

        def __init__(self) -> None:
            self.named: list[str | None] = []

        def instantiate(self) -> None:
            self.named.append(current_function(threading.get_ident()))

        setupExperiment = fmi2GetFMUstate = instantiate  # noqa: N815 as FMPy names them

    slave = Slave()
    fmu = FmpyCalls(slave, "fmi2", {"instantiate": "fmi2Instantiated"})

    fmu.instantiate()
    fmu.setupExperiment()
    fmu.fmi2GetFMUstate()
    slave.component = 7

    assert slave.named == ["fmi2Instantiated", "fmi2SetupExperiment", "fmi2GetFMUstate"]
    assert fmu.component == 7


def test_calls_in_time_are_not_told_however_many_they_are(watch: CallWatch, overruns: Overruns) -> None:
    for _ in range(200):
        with watch.calling("plant", InitializationFailed, "call", DEADLINE_S):
            pass

    assert overruns.found == []


def test_a_step_that_meets_its_deadline_is_told(watch: CallWatch, overruns: Overruns) -> None:
    with watch.stepping(lambda: ("plant", 7, "doStep"), 0.05):
        assert overruns.there.wait(DEADLINE_S)

    (error,) = overruns.found
    assert type(error) is StepFailed
    assert error.instance == "plant"


@x86
@pytest.mark.parametrize("mode", [UPWARD, DOWNWARD, TOWARD_ZERO])
def test_another_rounding_mode_is_seen_and_restored(mode: int) -> None:
    assert not floating_point_changed()

    libc.fesetround(mode)
    seen = floating_point_changed()
    restore_floating_point()

    assert seen
    assert not floating_point_changed()


@x86
def test_folder_locale_rounding_and_signal_handlers_are_kept(tmp_path: Path) -> None:
    folder, language = Path.cwd(), locale.setlocale(locale.LC_ALL)
    interrupts: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, _frame: interrupts.append(number))
    try:
        with kept_state():
            os.chdir(tmp_path)
            locale.setlocale(locale.LC_NUMERIC, "C.UTF-8")
            libc.fesetround(UPWARD)
            libc.signal(signal.SIGTERM, ctypes.c_void_p(1))  # SIG_IGN, as C code would

        assert Path.cwd() == folder
        assert locale.setlocale(locale.LC_ALL) == language
        assert not floating_point_changed()
        os.kill(os.getpid(), signal.SIGTERM)
        assert interrupts == [signal.SIGTERM]
    finally:
        signal.signal(signal.SIGTERM, before)


@pytest.fixture
def sly(tmp_path: Path) -> Path:
    """An FMU that goes to the root folder in its steps, and imports nothing that would tell."""
    if NO_COMPILER is not None:
        pytest.skip(NO_COMPILER)
    source, library = tmp_path / "Gain.c", tmp_path / "Gain.so"
    source.write_text(SLY, encoding="utf-8")
    subprocess.run([*find_compiler(), "-shared", "-fPIC", "-o", str(library), str(source)], check=True)
    with zipfile.ZipFile(FMUS / "Gain.fmu") as archive:
        (name,) = [one for one in archive.namelist() if one.startswith("binaries/")]
    return repacked(tmp_path / "Sly.fmu", keep=lambda entry: entry != name, add={name: library.read_bytes()})


@x86
@pytest.mark.parametrize("way", ["open", "repeated", "adapter"])
def test_a_step_that_changes_the_process_without_a_sign_is_found(sly: Path, way: str) -> None:
    """At the end of the first burst or of the first step; then it is looked after each."""
    before = Path.cwd()
    mesh = fmu_mesh.Mesh("one", step_size=0.1, stop_time=1.0)
    mesh.add("gain", fmu=str(sly))

    if way == "repeated":
        with mesh.repeated() as runs:
            runs.run()
        assert Path.cwd() == before
    elif way == "open":
        with mesh.open() as system:
            for _ in range(3):
                system.step()
                assert Path.cwd() == before
    else:
        with FMIAdapter(sly, 0.1) as adapter:
            adapter.exit_initialization_mode(0.0)
            for _ in range(3):
                adapter.do_step()
                assert Path.cwd() == before


def test_environment_variables_are_kept_but_for_those_that_python_sets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GUARD_CHANGED", "before")
    monkeypatch.setenv("GUARD_REMOVED", "before")
    monkeypatch.delenv("GUARD_OF_PYTHON", raising=False)
    names = (b"GUARD_CHANGED", b"GUARD_REMOVED", b"GUARD_ADDED", b"GUARD_OF_PYTHON")
    libc.getenv.restype = ctypes.c_char_p

    with kept_state() as state:
        libc.setenv(b"GUARD_CHANGED", b"after", 1)
        libc.unsetenv(b"GUARD_REMOVED")
        libc.setenv(b"GUARD_ADDED", b"after", 1)
        monkeypatch.setenv("GUARD_OF_PYTHON", "after")

    assert [libc.getenv(name) for name in names] == [b"before", b"before", None, b"after"]
    assert state.changed


def test_what_python_sets_is_no_change_of_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    with kept_state() as state:
        monkeypatch.setenv("GUARD_OF_PYTHON", "after")

    assert not state.changed


def test_a_call_that_sets_or_gets_values_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    named: list[str | None] = []
    found = Fmi2Instance._named

    def noting(instance: Fmi2Instance, verb: Verb, type_: VariableType) -> tuple[str, Function]:
        name, function = found(instance, verb, type_)

        def noted(*arguments: object) -> int:
            named.append(current_function(threading.get_ident()))
            return function(*arguments)

        return name, noted

    monkeypatch.setattr(Fmi2Instance, "_named", noting)
    path = FMUS / "Gain.fmu"
    with closing(Fmi2Instance(path, "gain", read_description(path), tmp_path)) as gain:
        gain.enter_initialization(0.0, None, {"u": 2.0})
        gain.get_values(["y"])

    assert named == ["fmi2SetReal", "fmi2GetReal"]


def test_threads_that_load_fmus_at_once_find_working_directory_as_it_was(tmp_path: Path) -> None:
    """FMPy changes the working directory while it loads a library, and the process has only one."""
    before, failures = Path.cwd(), list[Exception]()
    description = read_description(FMUS / "Gain.fmu")

    def load(number: int) -> None:
        folder = tmp_path / str(number)
        folder.mkdir()
        try:
            for _ in range(20):
                with kept_state():
                    instance = Fmi2Instance(FMUS / "Gain.fmu", "gain", description, folder)
                instance.close()
        except (OSError, LoadFailed) as failed:
            failures.append(failed)

    threads = [threading.Thread(target=load, args=(number,)) for number in range(4)]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(DEADLINE_S)
    finally:
        sys.setswitchinterval(interval)

    assert failures == []
    assert Path.cwd() == before
