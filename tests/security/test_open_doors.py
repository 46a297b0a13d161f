"""A network without TLS: refused by every part of a mesh and by every tool, unless somebody wants it, and then told."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from typing import Any, Final

import pytest

from tests.helpers import FMUS, Place, write_config

OPEN: Final = "tcp/0.0.0.0:0"
FAR: Final = "tcp/192.0.2.9:7447"
"""An address of nobody (RFC 5737)."""

PARTS: Final = {
    "launch one.yaml": "listen connect",
    "master one.yaml": "listen connect",
    "node one.yaml gain": "connect",
    "gateway one.yaml": "connect",
    "router": "listen",
    "run Gain.fmu --step-size 0.01": "listen connect",
    "check one.yaml": "listen connect",
}
"""The parts of a mesh, and which flags they have."""

TOOLS: Final = (
    *(
        "ls",
        "status",
        "info one",
        "get gain.y",
        "set gain.k 1",
        "watch gain.y",
        "top --once",
        "logs",
        "wait",
        "graph one",
    ),
    *(
        "pause",
        "resume",
        "step 1",
        "reset",
        "stop",
        "play one.mcap",
        "dashboard --no-browser --port 0",
        "foxglove --port 0",
    ),
)
DOORS: Final = [
    *(
        (part, f"--{flag} {OPEN if flag == 'listen' else FAR}")
        for part, flags in PARTS.items()
        for flag in flags.split()
    ),
    *((tool, f"--connect {FAR}") for tool in TOOLS),
]


@pytest.fixture(scope="module")
def here() -> Iterator[Place]:
    """A place with a mesh and a bag."""
    with Place() as place:
        (place.folder / "Gain.fmu").symlink_to(FMUS / "Gain.fmu")
        ros: dict[str, Any] = {"topics": ["gain.y"]}
        one = {"gain": {"fmu": "Gain.fmu"}}
        config = write_config(place.folder, name="one", instances=one, connections=[], stop_time=0.05, ros=ros)
        bag = place.folder / "one.mcap"
        assert place.run("launch", config, "--local", "--output", bag, "--no-progress").wait() == 0
        yield place


@pytest.mark.parametrize(("command", "door"), DOORS)
def test_a_network_without_tls_is_refused_with_both_ways_out(here: Place, command: str, door: str) -> None:
    refused = here.run(*command.split(), *door.split())

    assert refused.wait() == 2, refused.story()
    assert f"'{door.split()[1]}' is open to everybody who can reach it" in refused.message
    assert (
        "xpected tls/ and `--security` (`fmu-mesh security init` begins), or `--insecure`: everybody" in refused.message
    )
    assert "warning" not in refused.errors


@pytest.mark.parametrize(("command", "door"), [one for one in DOORS if "check" not in one[0]])
def test_who_wants_such_a_network_is_warned_at_each_start(here: Place, command: str, door: str) -> None:
    started = here.start(*command.split(), *door.split(), "--insecure")

    where = f"this host at {OPEN}" if OPEN in door else FAR
    warned = started.wait_for_error_line("fmu-mesh: warning: ")
    assert warned.endswith(f"whoever can reach {where} can read, set and end this mesh\n")
    if started.running:
        started.signal(signal.SIGKILL)
    started.wait()


@pytest.mark.parametrize("command", ["launch one.yaml", "run Gain.fmu --step-size 0.01", "master one.yaml", "router"])
def test_a_port_of_this_host_is_open_to_all_its_users(here: Place, command: str) -> None:
    started = here.start(*command.split(), "--listen", "tcp/127.0.0.1:0")

    warned = started.wait_for_error_line("fmu-mesh: warning: ")
    assert warned.endswith("every user of this host can set values at tcp/127.0.0.1:0\n")
    if started.running:
        started.signal(signal.SIGKILL)
    started.wait()
