"""Processes that stand for a while, and links that are cut: what goes on, what ends, and who is named."""

from __future__ import annotations

import re
import selectors
import socket
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import psutil
import pytest

from fmu_mesh.awake import AwakeClock
from fmu_mesh.cli.main import main
from tests.helpers import BY_STREAMS, BY_ZENOH, Place, row_count, wait_until, write_config

LINK_S = 1.0
STEP_S = 4.0


def pause(processes: Sequence[psutil.Process], seconds: float) -> None:
    """Let processes stand for some time."""
    for process in processes:
        process.suspend()
    end = time.monotonic() + seconds
    wait_until(lambda: time.monotonic() > end, "the end of the pause")
    for process in processes:
        process.resume()


@pytest.mark.parametrize("way", [{}, BY_STREAMS, BY_ZENOH], ids=["shared memory", "streams", "frames"])
def test_a_run_goes_on_after_its_processes_were_stopped(place: Place, way: Mapping[str, bool]) -> None:
    """The last pause is that of a host that is suspended: longer than the deadline of a step, for all at once."""
    config = write_config(
        place.folder,
        stop_time=4.0,
        simulation={"real_time_factor": 1},
        timeouts={"link": LINK_S, "step": STEP_S},
        zenoh={**way, "listen": ["tcp/127.0.0.1:0"]},
    )
    result, undisturbed = config.with_suffix(".csv"), place.folder / "undisturbed.csv"
    launched = place.start("launch", config, "--no-progress")
    wait_until(lambda: row_count(result) > 100, "100 rows")

    pause([launched.child("pendulum")], 1.5 * LINK_S)
    pause([launched.child("master")], 1.5 * LINK_S)
    pause(place.processes(), 1.25 * STEP_S)

    assert launched.wait() == 0, launched.story()
    assert main(["launch", str(config), "--local", "--no-progress", "--output", str(undisturbed)]) == 0
    assert result.read_bytes() == undisturbed.read_bytes()


class Relay:
    """Passes bytes on between its port and another one, until it is cut: then the connections stay, and are mute."""

    def __init__(self, port: int) -> None:
        self._target = ("127.0.0.1", port)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        self.is_cut = threading.Event()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End it."""
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        with selectors.DefaultSelector() as selector, self._listener:
            selector.register(self._listener, selectors.EVENT_READ)
            while not self._closing.is_set():
                for key, _ in selector.select(0.1):
                    if self.is_cut.is_set():
                        self._closing.wait(0.1)
                    elif key.data is None:
                        near, _ = self._listener.accept()
                        far = socket.create_connection(self._target)
                        selector.register(near, selectors.EVENT_READ, far)
                        selector.register(far, selectors.EVENT_READ, near)
                    elif data := key.fileobj.recv(1 << 16):  # type: ignore[union-attr]  # a socket
                        key.data.sendall(data)
                    else:
                        selector.unregister(key.fileobj)
            for key in [*selector.get_map().values()]:
                if key.data is not None:
                    key.data.close()


@pytest.fixture
def relay(place: Place) -> Iterator[tuple[str, Relay]]:
    """A router, and a relay to it."""
    router = place.start("router", "--listen", "tcp/127.0.0.1:0")
    found = wait_until(lambda: re.search(r"router at (tcp/127.0.0.1:(\d+))", router.output), "a router")
    relay = Relay(int(found[2]))
    yield found[1], relay
    relay.close()


@pytest.mark.parametrize("way", [{}, BY_ZENOH], ids=["shared memory", "frames"])
def test_a_link_that_is_cut_is_named_by_both_ends(
    place: Place, relay: tuple[str, Relay], way: Mapping[str, bool]
) -> None:
    router, cable = relay

    def config(name: str, endpoint: str) -> Path:
        zenoh = {"mode": "client", "connect": [endpoint], **way}
        made = write_config(
            place.folder,
            stop_time=1e6,
            simulation={"real_time_factor": 1},
            timeouts={"link": 2.0},
            zenoh=zenoh,
        )
        return made.rename(made.with_stem(name))

    far, near = config("far", cable.endpoint), config("near", router)
    master, node = place.start("master", near), place.start("node", far, "delay")
    place.start("node", near, "pendulum")
    wait_until(lambda: row_count(place.folder / "pair.csv") > 100, "100 rows")

    cable.is_cut.set()

    assert node.wait() == 4
    assert re.search(r"node 'delay' lost its link to the master, which did not answer for \d+ s", node.message)
    assert master.wait() == 4
    assert "node 'delay' was lost: its process does not answer any more" in master.message


def test_a_clock_for_deadlines_stands_while_its_process_does() -> None:
    times = iter([100.0, 100.5, 160.5, 161.0])
    clock = AwakeClock(lambda: next(times))

    assert [clock() for _ in range(3)] == [0.5, 1.5, 2.0]
