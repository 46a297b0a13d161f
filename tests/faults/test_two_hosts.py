"""A mesh over two hosts: they meet at a router or at the master, and what one host has is nothing to the other."""

from __future__ import annotations

import json
import re
import shlex
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.helpers import Launched, Place, row_count, rows_of, wait_until, write_config
from tests.network_hosts import NEEDS_HOSTS, NetworkHost, two_hosts
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
    with two_hosts(tmp_path, names) as (first, second):
        expected = reference(second)
        meeting = started(first, router)
        wait_until(lambda: meeting.output, "the router")

        by_hand = [started(host, line) for host, line in zip((first, first, second), parts, strict=True)]

        assert ended(by_hand) == [0, 0, 0], "".join(one.story() for one in by_hand)
        assert (first.folder / RESULT).read_bytes() == expected


def test_nodes_of_another_host_connect_to_a_master_that_listens(tmp_path: Path) -> None:
    with two_hosts(tmp_path) as (first, second):
        expected = reference(second)

        by_hand = [
            started(first, "fmu-mesh master CONFIG --listen tcp/0.0.0.0:7447 --paused"),
            started(first, "fmu-mesh node CONFIG pendulum"),
            started(second, "fmu-mesh node CONFIG delay --connect tcp/router:7447"),
        ]

        def ways() -> list[list[Any]]:
            asked = first.start("fmu-mesh", "info", "mesh", "--json")
            info = json.loads(asked.output) if asked.wait() == 0 else {"shared_memory": []}
            return [info["shared_memory"], info["row_streams"]] if info["shared_memory"] else []

        streams = [["@mesh", "delay"], ["delay", "pendulum"]]
        assert wait_until(ways, "a mesh that is there") == [["pendulum", "@record", "@mesh"], streams]
        resume = "fmu-mesh resume pendulum_delay --connect tcp/router:7447"
        wait_until(lambda: started(second, resume).wait() == 0, "a mesh that runs")
        assert ended(by_hand) == [0, 0, 0], "".join(one.story() for one in by_hand)
        assert (first.folder / RESULT).read_bytes() == expected


PACED = "configs/paced.yaml"


def paced(host: NetworkHost, example: str) -> list[str]:
    """Write an example that takes 4 s there, and return the names of its two nodes."""
    made = (ROOT / "configs" / example).read_text(encoding="utf-8")
    made = re.sub(r"stop_time: \d+.0", "stop_time: 4.0", made)
    made = made.replace("simulation:", "simulation:\n  real_time_factor: 1")
    (host.folder / "own-clone" / PACED).write_text(made, encoding="utf-8")
    return re.findall(r"^  (\w+):\n    fmu:", made, re.MULTILINE)


@pytest.mark.parametrize("cut_s", [0.5, 3.0])
@pytest.mark.parametrize("example", ["cycle2.yaml", "pendulum_delay.yaml"])
def test_a_link_that_is_cut_for_a_while_costs_only_time(tmp_path: Path, example: str, cut_s: float) -> None:
    with two_hosts(tmp_path) as (first, second):
        near, far = paced(first, example)
        paced(second, example)
        result = first.folder / "out.csv"
        by_hand = [
            started(first, f"fmu-mesh master {PACED} --listen tcp/0.0.0.0:7447 --output ../out.csv"),
            started(first, f"fmu-mesh node {PACED} {near}"),
            started(second, f"fmu-mesh node {PACED} {far} --connect tcp/router:7447"),
        ]
        wait_until(lambda: row_count(result) > 100, "some rows")

        assert second.start("ip", "link", "set", "wire", "down").wait() == 0
        begun = time.monotonic()
        wait_until(lambda: time.monotonic() - begun > cut_s, "the end of the cut")
        rows = row_count(result)
        assert second.start("ip", "link", "set", "wire", "up").wait() == 0
        wait_until(lambda: row_count(result) > rows, "more rows")

        assert ended(by_hand) == [0, 0, 0], "".join(one.story() for one in by_hand)
        alone = started(second, f"fmu-mesh launch {PACED} --local --no-progress --output ../alone.csv")
        assert alone.wait() == 0
        assert result.read_bytes() == (second.folder / "alone.csv").read_bytes()


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
