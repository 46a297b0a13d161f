"""A sandbox of bubblewrap: what an FMU can no longer do, and that the run stays what it was."""

from __future__ import annotations

import os
import shutil
import signal
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.fmus.helpers import NO_COMPILER, built_once
from tests.helpers import DEADLINE_S, PAIR, Launched, Place, rows_of, wait_until, write_config

SANDBOX = {"sandbox": "bubblewrap"}
PRIES = ("shadow", "secret", "outside", "network", "process", "relative")

pytestmark = pytest.mark.skipif(shutil.which("bwrap") is None, reason="bubblewrap is not installed")


@pytest.fixture(scope="module")
def prying() -> Path:
    """The FMU that looks at what it may do to the host."""
    if NO_COMPILER is not None:
        pytest.skip(NO_COMPILER)
    return built_once(Path(__file__).parent / "fmus" / "Prying")


@pytest.fixture
def outside() -> Iterator[Path]:
    """A file that is not there yet, in a folder where everybody may write."""
    path = Path("/var/tmp") / f"fmu_mesh-outside-{os.getpid()}"  # noqa: S108  nothing is expected there
    yield path
    path.unlink(missing_ok=True)


def pried(place: Place, prying: Path, process: dict[str, Any], outside: Path) -> dict[str, float]:
    """What the FMU could do."""
    (place.folder / "secret").write_text("secret")
    config = write_config(
        place.folder, instances={"spy": {"fmu": str(prying)}}, connections=[], stop_time=0.01, process=process
    )
    with socket.create_server(("127.0.0.1", 0)) as listener:
        place.environment |= {
            "FMU_MESH_PRY_SECRET": str(place.folder / "secret"),
            "FMU_MESH_PRY_OUTSIDE": str(outside),
            "FMU_MESH_PRY_PORT": str(listener.getsockname()[1]),
            "FMU_MESH_PRY_PROCESS": str(os.getpid()),
        }
        launched = place.run("launch", config)
    assert launched.wait() == 0, launched.story()
    place.assert_nothing_left()
    return dict(zip(PRIES, rows_of(config.with_suffix(".csv"))[-1][1:], strict=True))


def test_without_a_sandbox_an_fmu_can_do_what_its_user_can(place: Place, prying: Path, outside: Path) -> None:
    could = pried(place, prying, {}, outside)

    assert could.pop("shadow") == float(os.access("/etc/shadow", os.R_OK))
    assert set(could.values()) == {1.0}
    assert outside.exists()


def test_in_a_sandbox_an_fmu_has_only_its_own_folder(place: Place, prying: Path, outside: Path) -> None:
    could = pried(place, prying, SANDBOX, outside)

    assert could == dict.fromkeys(PRIES, 0.0) | {"relative": 1.0}
    assert not outside.exists()
    assert not (place.folder / "relative.txt").exists()


@pytest.mark.parametrize("where", ["all", "one"])
@pytest.mark.parametrize("ways", [{}, {"shared_memory": False}], ids=["memory", "streams"])
def test_a_sandbox_changes_no_float(place: Place, where: str, ways: dict[str, bool]) -> None:
    plain = write_config(place.folder, name="plain", zenoh=ways)
    instances = {name: dict(own) for name, own in PAIR.items()}
    more: dict[str, Any] = {"process": SANDBOX}
    if where == "one":
        instances["pendulum"]["process"], more = SANDBOX, {}
    boxed = write_config(place.folder, name="boxed", instances=instances, zenoh=ways, **more)

    assert place.run("launch", plain).wait() == 0
    launched = place.run("launch", boxed)

    assert launched.wait() == 0, launched.story()
    assert rows_of(boxed.with_suffix(".csv")) == rows_of(plain.with_suffix(".csv"))
    place.assert_nothing_left()


def running(place: Place) -> Launched:
    """A mesh in sandboxes that runs."""
    config = write_config(place.folder, process=SANDBOX, stop_time=60.0, simulation={"real_time_factor": 1.0})
    launched = place.start("launch", config)
    place.note()
    return launched


def test_nodes_in_sandboxes_share_the_memory_of_the_run(place: Place) -> None:
    launched = running(place)

    maps = [Path(f"/proc/{launched.child(name).pid}/maps") for name in ("pendulum", "delay")]
    wait_until(lambda: all("memfd:fmu_mesh" in own.read_text() for own in maps), "the memory of the run")
    launched.signal(signal.SIGINT)
    assert launched.wait() == 130
    place.assert_nothing_left()


def test_a_killed_node_in_a_sandbox_is_named(place: Place) -> None:
    launched = running(place)
    launched.child("delay").kill()

    assert launched.wait() == 4
    assert "node 'delay' was lost: its process was ended by SIGKILL" in launched.message
    place.assert_nothing_left()


def test_a_killed_launcher_leaves_no_sandbox(place: Place) -> None:
    launched = running(place)
    launched.child("delay")
    launched.signal(signal.SIGKILL)

    launched.wait()

    wait_until(lambda: not place.processes(), "the end of all processes", DEADLINE_S)


def test_limits_hold_in_a_sandbox(place: Place, prying: Path) -> None:
    config = write_config(
        place.folder,
        instances={"taker": {"fmu": str(prying), "start_values": {"burn": 0.05}}},
        connections=[],
        process={**SANDBOX, "cpu_time": 1.0},
    )

    launched = place.run("launch", config)

    assert launched.wait() == 4
    assert "its process has used its cpu_time of 1 s" in launched.message


def test_a_component_runs_in_a_sandbox(place: Place) -> None:
    (place.folder / "one.py").write_text(
        "import fmu_mesh\n\nclass One(fmu_mesh.Component):\n    y = fmu_mesh.Output(start=1.0)\n\n"
        "    def step(self, time, step_size):\n        self.y = time\n"
    )
    config = write_config(
        place.folder, instances={"one": {"python": "one.py:One"}}, connections=[], stop_time=0.1, process=SANDBOX
    )

    launched = place.run("launch", config)

    assert launched.wait() == 0, launched.story()


def test_without_bubblewrap_a_sandbox_is_refused(place: Place) -> None:
    config = write_config(place.folder, process=SANDBOX)
    place.environment |= {"PATH": str(place.folder)}

    launched = place.run("launch", config)

    assert launched.wait() == 2
    assert (
        "process.sandbox: bubblewrap, which is not installed; expected `apt-get install bubblewrap`" in launched.errors
    )


def test_a_sandbox_needs_a_launcher(place: Place) -> None:
    config = write_config(place.folder, process=SANDBOX)

    launched = place.run("node", config, "delay")

    assert launched.wait() == 2
    assert "`sandbox` of node 'delay' has no effect where the node is started manually" in launched.message
