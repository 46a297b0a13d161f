"""What all tests share: how hypothesis runs, a place for real processes, and the FMU with faults."""

from __future__ import annotations

import faulthandler
import os
import signal
import sys
from collections.abc import Callable, Generator, Iterator
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from tests.fmus.event_fmus import Version, build_event_fmu
from tests.fmus.helpers import NO_COMPILER, find_fmu, session_folder
from tests.helpers import Place

# Where byte-code must not be written, each process of each mesh compiles all modules again, and each worker all tests.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# There are more processes than cores, so none of them needs a thread for each core; starting them takes 0.03 s.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# onnxruntime sends nothing from here either; fmu_mesh itself sets this where it imports it.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

session_folder()  # before there are workers

# It lives as long as this process. If a test started it in a place of its own, that place would end it.
resource_tracker.ensure_running()

# How long an example takes says more about the machine than about the code; a failure must be the same everywhere.
settings.register_profile("fmu_mesh", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("fmu_mesh")

# A script that starts the tests in the background has Ctrl-C ignored, and what tests start inherits that.
signal.signal(signal.SIGINT, signal.default_int_handler)


# The limit of pytest-timeout is 600 s. It cannot end a library that never returns to Python, as Fast DDS 3.2 does with
# a sample of which a fragment is missing; then this process ends, and pytest-xdist names the test.
HUNG_S = 660.0


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol() -> Generator[None, Any, Any]:
    """A test that hangs in a library ends its worker, and not the whole run."""
    faulthandler.dump_traceback_later(HUNG_S, exit=True, file=2)
    try:
        return (yield)
    finally:
        faulthandler.cancel_dump_traceback_later()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, Any, Any]:
    """A failed test shows what the processes that it started have written."""
    report = yield
    place = getattr(item, "funcargs", {}).get("place")
    if report.when == "call" and report.failed and isinstance(place, Place):
        report.sections.append(("Processes of this test", place.story()))
    return report


@pytest.fixture
def place() -> Iterator[Place]:
    """Where a test starts processes; whatever still runs afterwards is killed."""
    with Place() as place:
        yield place


@pytest.fixture(scope="session")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The FMU that fails on demand, built once; without a C compiler the test is skipped."""
    return find_fmu("Faulty", tmp_path_factory.mktemp("faulty"))


@pytest.fixture(scope="session")
def event_fmu() -> Callable[..., Path]:
    """Returns an event test FMU by model and FMI version; without a C compiler the test is skipped."""

    def find(name: str, version: Version, **changes: str) -> Path:
        if NO_COMPILER is not None:
            pytest.skip(NO_COMPILER)
        return build_event_fmu(name, version, session_folder(), **changes)

    return find
