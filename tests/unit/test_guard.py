"""Calls of an FMU have deadlines, and leave the state of the process alone."""

from __future__ import annotations

import ctypes
import locale
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from fmu_mesh.errors import FmuError, InitializationFailed, LoadFailed, StepFailed
from fmu_mesh.instances.call_guard import (
    CallWatch,
    current_function,
    floating_point_changed,
    kept_state,
    restore_floating_point,
)
from fmu_mesh.instances.fmi import Fmi2Instance, read_description
from fmu_mesh.instances.fmi.calls import FmpyCalls
from tests.helpers import DEADLINE_S, FMUS

UPWARD, DOWNWARD, TOWARD_ZERO = 0x800, 0x400, 0xC00  # of x86; other processors have other numbers

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


def test_a_call_that_meets_its_deadline_is_told_with_the_function_of_fmi(watch: CallWatch, overruns: Overruns) -> None:
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


def test_a_call_that_sets_or_gets_values_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    named: list[str | None] = []
    call: Callable[..., int] = Fmi2Instance._call

    def noted(*arguments: object) -> int:
        named.append(current_function(threading.get_ident()))
        return call(*arguments)

    monkeypatch.setattr(Fmi2Instance, "_call", noted)
    path = FMUS / "Gain.fmu"
    with closing(Fmi2Instance(path, "gain", read_description(path), tmp_path)) as gain:
        gain.enter_initialization(0.0, None, {"u": 2.0})
        gain.get_values(["y"])

    assert named == ["fmi2SetReal", "fmi2GetReal"]


def test_threads_that_load_fmus_at_once_find_the_working_directory_as_it_was(tmp_path: Path) -> None:
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
