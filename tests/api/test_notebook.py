"""A run in a notebook: a real kernel shows its progress, and "interrupt kernel" ends it cleanly."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import pytest

from tests.helpers import DEADLINE_S, FMUS, Place, wait_until
from tests.notebooks import assert_is_a_picture

manager = pytest.importorskip("jupyter_client.manager")
pytest.importorskip("ipykernel")

MESH = f"""
import fmu_mesh
mesh = fmu_mesh.Mesh("cell", step_size=0.01, stop_time=STOP, real_time_factor=1.0)
mesh.add("gain", fmu={str(FMUS / "Gain.fmu")!r})
"""


class Kernel:
    """A kernel, and what its cells show."""

    def __init__(self, client: Any, manager: Any) -> None:  # noqa: ANN401  jupyter_client has no types for them
        self.client = client
        self.manager = manager

    def messages(self, cell: str) -> Iterator[tuple[str, dict[str, Any]]]:
        """Run a cell; its messages to the end."""
        asked = self.client.execute(cell)
        end = time.monotonic() + DEADLINE_S
        while time.monotonic() < end:
            message = self.client.get_iopub_msg(timeout=DEADLINE_S)
            if message["parent_header"].get("msg_id") != asked:
                continue
            yield message["msg_type"], message["content"]
            if message["msg_type"] == "status" and message["content"]["execution_state"] == "idle":
                return
        raise AssertionError("the cell has not ended")


@pytest.fixture
def kernel(place: Place, monkeypatch: pytest.MonkeyPatch) -> Iterator[Kernel]:
    for name, value in place.environment.items():
        monkeypatch.setenv(name, value)
    own, client = manager.start_new_kernel(kernel_name="python3")
    try:
        yield Kernel(client, own)
    finally:
        client.stop_channels()
        own.shutdown_kernel(now=True)


def test_a_run_shows_a_progress_bar_that_goes_when_it_ends(kernel: Kernel) -> None:
    shown = [
        content
        for kind, content in kernel.messages(
            MESH.replace("STOP", "2.0") + "print(len(mesh.run(record='memory').times))"
        )
        if kind in ("display_data", "update_display_data", "stream", "error")
    ]

    bars = [content["data"].get("text/html", "") for content in shown if "data" in content]
    assert "<progress value=" in bars[0]
    assert "max='200'" in bars[0]
    assert any("cell: running, point " in bar for bar in bars)
    assert bars[-1] == ""
    assert shown[-1] == {"name": "stdout", "text": "201\n"}


def test_interrupt_kernel_ends_the_run_and_the_kernel_goes_on(kernel: Kernel, place: Place) -> None:
    told: list[tuple[str, dict[str, Any]]] = []
    for kind, content in kernel.messages(MESH.replace("STOP", "None") + "mesh.run(record='memory')"):
        told.append((kind, content))
        if kind == "update_display_data" and "running" in content["data"].get("text/plain", ""):
            kernel.manager.interrupt_kernel()

    [error] = [content for kind, content in told if kind == "error"]
    assert error["ename"] == "KeyboardInterrupted"
    assert "point " in error["evalue"]
    wait_until(
        lambda: not (place.processes("node") or place.processes("master") or place.processes("fork")),
        "the end of all processes",
    )
    again = "print(len(mesh.run(record='memory', stop_time=0.1).times))"
    assert ("stream", {"name": "stdout", "text": "11\n"}) in list(kernel.messages(again))


def test_a_picture_is_shown_exactly_once_however_matplotlib_is_set_up(kernel: Kernel) -> None:
    list(kernel.messages(MESH.replace("STOP", "1.0") + "result = mesh.run(record='memory', processes=False)"))
    list(kernel.messages("other = mesh.run(record='memory', processes=False, start_values={'gain.k': 2.0})"))

    for setup in ("", "import matplotlib.pyplot", "%matplotlib inline"):
        for last in ("result.plot()", "result.compare(other).plot()", "mesh.graph().figure()"):
            shown = [content["data"] for _, content in kernel.messages(f"{setup}\n{last}") if "data" in content]
            assert [sorted(data) for data in shown] == [["image/png", "text/plain"]], (setup, last)
            pixels = assert_is_a_picture(shown[0]["image/png"]) if "graph" not in last else None
            assert pixels is None or pixels.size


def test_a_sweep_shows_a_progress_bar_that_goes_when_it_ends(kernel: Kernel) -> None:
    cell = (
        "with fmu_mesh.sweep(mesh, {'gain.k': [1.0, 2.0, 3.0]}, folder='three', workers=1) as running:\n"
        "    sweep = running.wait()\nsweep"
    )

    shown = [
        content["data"]
        for kind, content in kernel.messages(MESH.replace("STOP", "0.1") + cell)
        if kind in ("display_data", "update_display_data", "execute_result")
    ]
    # A kernel ends without what multiprocessing does at the exit of a process.
    list(kernel.messages("import multiprocessing.util, shutil; shutil.rmtree(multiprocessing.util.get_temp_dir())"))

    assert "<progress value='0' max='3'></progress> cell: 0 of 3 runs, 0 failed" in shown[0]["text/html"]
    assert shown[-2] == {"text/plain": ""}
    assert shown[-1]["text/plain"] == "<SweepResult of 'cell': 3 of 3 runs, 0 failed>"
    assert shown[-1]["text/html"].count("<tr>") == 4
