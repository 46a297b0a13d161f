"""`FMIAdapter` with FMUs that change the process of the program that steps them: it finds everything as it was."""

from __future__ import annotations

import ctypes
import locale
import os
import signal
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fmu_mesh import FMIAdapter
from fmu_mesh.instances.process_state import floating_point_changed, restore_floating_point
from tests.fmus.helpers import NO_COMPILER, built_once
from tests.fmus.packing import repacked

Hostile = Callable[[str], Path]

CALLS = (
    "fmi2Instantiate",
    "fmi2SetupExperiment",
    "fmi2EnterInitializationMode",
    "fmi2ExitInitializationMode",
    "fmi2DoStep",
    "fmi2GetReal",
    "fmi2Terminate",
    "fmi2FreeInstance",
)
UPWARD = 0x800  # of x86

libc = ctypes.CDLL(None)
libc.signal.restype = ctypes.c_void_p
libc.signal.argtypes = [ctypes.c_int, ctypes.c_void_p]
libc.getenv.restype = ctypes.c_char_p
libc.uselocale.restype = ctypes.c_void_p
x86 = pytest.mark.skipif(os.uname().machine != "x86_64", reason="the numbers of the rounding modes are those of x86")


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> Hostile:
    """The FMU that does what its model identifier says, which is what an adapter's instance name begins with."""
    if NO_COMPILER is not None:
        pytest.skip(NO_COMPILER)
    folder = tmp_path_factory.mktemp("hostile")
    source = built_once(Path(__file__).parent / "fmus" / "Hostile")

    def named(name: str) -> Path:
        with zipfile.ZipFile(source) as archive:
            library = archive.read("binaries/linux64/Hostile.so")
        return repacked(
            folder / f"{name}.fmu",
            source=source,
            description=lambda text: text.replace('modelIdentifier="Hostile"', f'modelIdentifier="{name}"'),
            keep=lambda entry: not entry.startswith("binaries/"),
            add={f"binaries/linux64/{name}.so": library},
        )

    return named


@pytest.fixture(autouse=True)
def handlers() -> Iterator[list[int]]:
    """Handlers of SIGINT and SIGTERM that C code installed, of which Python knows nothing; signals that came."""
    seen: list[int] = []
    handler = ctypes.CFUNCTYPE(None, ctypes.c_int)(seen.append)
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [libc.signal(number, ctypes.cast(handler, ctypes.c_void_p).value) for number in numbers]
    yield seen
    for number, old in zip(numbers, before, strict=True):
        libc.signal(number, old)


def run(fmu: Path) -> list[float]:
    """A whole life of an adapter: its output after each of ten steps."""
    with FMIAdapter(fmu, 0.001) as adapter:
        adapter.set_initial_value("u", 1.0)
        adapter.exit_initialization_mode(0.0)
        values = []
        for _ in range(10):
            adapter.do_step()
            values.append(adapter.get_output_value("third"))
        return values


@x86
@pytest.mark.parametrize(
    "fault",
    ["chdir", "locale", "threadlocale", "rounding", "flushing", "handlers", "blocking", "umask", "environment"],
)
def test_what_a_call_changes_of_the_process_is_undone(fault: str, hostile: Hostile, handlers: list[int]) -> None:
    folder, language = Path.cwd(), locale.setlocale(locale.LC_ALL)
    os.umask(umask := os.umask(0o022))

    for number, function in enumerate(CALLS, 1):
        assert run(hostile(f"{fault}_{function}")) == [1 / 3] * 10

        assert (Path.cwd(), locale.setlocale(locale.LC_ALL), os.umask(umask)) == (folder, language, umask)
        assert (libc.getenv(b"HOSTILE"), libc.getenv(b"PATH")) == (None, os.environb[b"PATH"])
        assert libc.uselocale(None) == ctypes.c_void_p(-1).value
        assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == set()
        assert not floating_point_changed()
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGINT)
        assert handlers == [signal.SIGTERM, signal.SIGINT] * number


@x86
@pytest.mark.parametrize("fault", ["rounding", "flushing"])
def test_the_floating_point_mode_is_undone_after_every_step(fault: str, hostile: Hostile) -> None:
    assert run(hostile(f"{fault}_fmi2DoStep")) == [1 / 3] * 10
    assert not floating_point_changed()


@x86
def test_a_floating_point_mode_of_the_program_is_left_to_it(hostile: Hostile) -> None:
    libc.fesetround(UPWARD)
    try:
        run(hostile("polite"))
        mode = libc.fegetround()
    finally:
        restore_floating_point()

    assert mode == UPWARD
