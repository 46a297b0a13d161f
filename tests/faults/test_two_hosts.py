"""A mesh over two hosts: they meet at a router or at the master, and what one host has is nothing to the other."""

from __future__ import annotations

import json
import re
import shlex
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.all_systems import written_system
from tests.helpers import Launched, Place, on_a_busy_machine, row_count, rows_of, wait_until, write_config
from tests.network_hosts import NEEDS_HOSTS, NetworkHost, started_apart, started_hosts
from tests.pages.blocks import ROOT, blocks_of

pytestmark = NEEDS_HOSTS

CONFIG = "configs/pendulum_delay.yaml"
RESULT = "own-clone/results/pendulum_delay.csv"
CONTAINER = ("unshare", "--pid", "--fork", "--mount-proc", "--kill-child")
"""A command in front of another one: that one is process 1, and has the host name of this machine."""

_HIGH = 'echo $(($(cat /proc/sys/kernel/pid_max) - 1000)) >/proc/sys/kernel/ns_last_pid; "$@"; exit $?'
UNKNOWN = (*CONTAINER, "sh", "-c", _HIGH, "sh")
"""The same, with a process id that no process outside has."""


def commands_of_readme() -> tuple[str, list[str]]:
    """The router and the other commands of the section "More than one machine"."""
    text = (
        (ROOT / "README.md").read_text(encoding="utf-8").partition("## More than one machine")[2].partition("\n## ")[0]
    )
    router = text.partition("`fmu-mesh router")[2].partition("`")[0]
    [block] = [block for block in blocks_of(ROOT / "README.md") if block.language == "sh" and block.text in text]
    return f"fmu-mesh router{router}", [command.line for command in block.commands(None)]


def started(host: NetworkHost, line: str) -> Launched:
    return host.start(*shlex.split(line.replace("CONFIG", CONFIG)))


def ended(launched: list[Launched]) -> list[int]:
    return [one.wait() for one in launched]


def reference(host: NetworkHost) -> bytes:
    """The result of the example in one process."""
    assert host.start("fmu-mesh", "launch", CONFIG, "--local", "--no-progress").wait() == 0
    return (host.folder / RESULT).read_bytes()


@pytest.mark.parametrize("names", [("first", "second"), ("same", "same")], ids=["two names", "one name"])
def test_the_commands_of_the_readme_run_on_two_hosts(tmp_path: Path, names: tuple[str, str]) -> None:
    router, parts = commands_of_readme()
    with started_hosts(tmp_path, names) as (first, second):
        expected = reference(second)
        meeting = started(first, router)
        wait_until(lambda: meeting.output, "the router")

        by_hand = [started(host, line) for host, line in zip((first, first, second), parts, strict=True)]

        assert ended(by_hand) == [0, 0, 0], "".join(one.story() for one in by_hand)
        assert (first.folder / RESULT).read_bytes() == expected


def test_nodes_of_another_host_connect_to_a_master_that_listens(tmp_path: Path) -> None:
    with started_hosts(tmp_path) as (first, second):
        expected = reference(second)

        by_hand = [
            started(first, "fmu-mesh master CONFIG --listen tcp/0.0.0.0:7447 --insecure --paused"),
            started(first, "fmu-mesh node CONFIG pendulum"),
            started(second, "fmu-mesh node CONFIG delay --connect tcp/router:7447 --insecure"),
        ]

        def ways() -> list[list[Any]]:
            asked = first.start("fmu-mesh", "info", "mesh", "--json")
            info = json.loads(asked.output) if asked.wait() == 0 else {"shared_memory": []}
            return [info["shared_memory"], info["row_streams"]] if info["shared_memory"] else []

        streams = [["@mesh", "delay"], ["delay", "pendulum"]]
        assert wait_until(ways, "a mesh that is there") == [["pendulum", "@record", "@mesh"], streams]
        resume = "fmu-mesh resume pendulum_delay --connect tcp/router:7447 --insecure"
        wait_until(lambda: started(second, resume).wait() == 0, "a mesh that runs")
        assert ended(by_hand) == [0, 0, 0], "".join(one.story() for one in by_hand)
        assert (first.folder / RESULT).read_bytes() == expected


UNREACHED = """
import sys

def refuse(event, arguments):
    if event == "socket.connect" and isinstance(arguments[1], tuple):
        raise ConnectionRefusedError

sys.addaudithook(refuse)
"""
"""In each process: the doors of row streams at a port cannot be reached, and Zenoh, which is no Python, can."""


def test_hosts_whose_doors_cannot_be_reached_are_told_and_use_zenoh(tmp_path: Path) -> None:
    with started_hosts(tmp_path) as hosts:
        first, second = hosts
        expected = reference(second)
        (tmp_path / "shared" / "sitecustomize.py").write_text(UNREACHED, encoding="utf-8")

        by_hand = started_apart(hosts, Path(CONFIG), ["pendulum", "delay"], environment={"PYTHONPATH": "/mnt"})

        assert ended(by_hand) == [0, 0, 0], "".join(one.story() for one in by_hand)
        told = "cannot reach each other: their rows go by Zenoh"
        assert re.findall(rf"WARNING: (.*) {told}", by_hand[0].errors) == [
            "the master and node 'delay'",
            "node 'delay' and node 'pendulum'",
        ], by_hand[0].story()
        assert (first.folder / RESULT).read_bytes() == expected


@pytest.mark.parametrize("victim", ["pendulum", "delay"])
def test_a_killed_process_is_named_by_the_others_within_two_seconds(tmp_path: Path, victim: str) -> None:
    with started_hosts(tmp_path) as hosts:
        config = Path("endless", "system.yaml")
        systems = [
            written_system("pendulum_delay", host.folder / "own-clone" / "endless", lasts_s=60.0) for host in hosts
        ]
        by_hand = started_apart(hosts, config, ["pendulum", "delay"])
        wait_until(lambda: row_count(systems[0].with_suffix(".csv")) > 100, "some rows")
        killed = by_hand[("master", "pendulum", "delay").index(victim)]

        begun = time.monotonic()
        for process in psutil.Process(killed.pid).children(recursive=True):
            process.kill()

        others = [one for one in by_hand if one is not killed]
        assert ended(others) == [4, 4], "".join(one.story() for one in by_hand)
        assert time.monotonic() - begun < on_a_busy_machine(2.0)
        for one in others:
            assert f"node '{victim}' was lost" in one.message


def test_two_processes_of_two_hosts_with_equal_names_and_numbers_are_two(place: Place) -> None:
    router = place.start("router", "--listen", "tcp/127.0.0.1:0")
    wait_until(lambda: "router at " in router.output, "a router")
    config = write_config(place.folder, zenoh={"connect": [router.output.split("router at ")[1].split()[0]]})
    master = place.start("master", config)
    first = place.start("node", config, "pendulum", prefix=CONTAINER)

    with Place() as elsewhere:
        second = elsewhere.start("node", config, "pendulum", prefix=CONTAINER)
        wait_until(lambda: not (first.running and second.running), "one that is refused")
        refused = second if first.running else first
        assert refused.wait() == 4
        assert "node 'pendulum' is there already; two processes run it" in refused.message

        rest = place.start("node", config, "delay")
        accepted = first if refused is second else second
        assert ended([master, accepted, rest]) == [0, 0, 0]


def beside(place: Place, other: Callable[[], Launched]) -> None:
    """Run ``other`` while a mesh runs in a container with the same runtime folder: it has to go on until its end."""
    config = write_config(place.folder, stop_time=1e6, simulation={"real_time_factor": 1})
    mesh = place.start("launch", config, "--no-progress", prefix=UNKNOWN)
    wait_until(lambda: row_count(config.with_suffix(".csv")) > 100, "100 rows")

    assert other().wait() == 0

    address = mesh.wait_for_error_line("mesh 'pair' at ").split()[-1]
    assert place.run("stop", "pair", "--connect", address).wait() == 0
    assert mesh.wait() == 130, mesh.story()
    place.assert_nothing_left()


def test_a_look_leaves_the_run_of_another_host_alone(place: Place) -> None:
    beside(place, lambda: place.run("ls"))


def test_a_run_leaves_the_run_of_another_host_alone(place: Place) -> None:
    (other := place.folder / "other").mkdir()
    config = write_config(other)

    beside(place, lambda: place.run("launch", config, "--no-progress"))


def test_two_hosts_with_one_runtime_folder_run_meshes_of_one_name(place: Place) -> None:
    """Their launchers have the same process id."""
    config = write_config(place.folder, stop_time=2.0, simulation={"real_time_factor": 1})
    outputs = [place.folder / f"{number}.csv" for number in (1, 2)]

    both = [place.start("launch", config, "--no-progress", "--output", one, prefix=CONTAINER) for one in outputs]

    assert ended(both) == [0, 0], "".join(one.story() for one in both)
    assert outputs[0].read_bytes() == outputs[1].read_bytes()
    place.assert_nothing_left()


def test_nodes_of_two_containers_with_one_process_id_share_a_folder(place: Place) -> None:
    config = write_config(place.folder)

    by_hand = [place.start("master", config, "--paused")]
    by_hand += [place.start("node", config, name, prefix=CONTAINER) for name in ("pendulum", "delay")]

    notes = (place.folder / "run" / "pair.hand").glob
    wait_until(lambda: len([*notes("*.pid")]) == 3, "a note of each")
    wait_until(lambda: place.run("resume", "pair").wait() == 0, "a mesh that runs")
    assert ended(by_hand) == [0, 0, 0], "".join(one.story() for one in by_hand)
    assert len(rows_of(config.with_suffix(".csv"))) == 1001
    place.assert_nothing_left()
