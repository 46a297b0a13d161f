"""Hosts without `ssh`: `launch` waits for their nodes, and `fmu-mesh node CONFIG --host NAME` starts all of one host.

Two places with runtime folders of their own stand for two hosts. They are one machine, so rows go in shared memory;
`tests/faults/test_two_hosts.py` has real ones.
"""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from tests.helpers import Launched, Place, free_port, on_a_busy_machine, row_count, wait_until, write_config
from tests.terminal import Terminal

PAIR = {"pendulum": {"fmu": "DampedPendulum"}, "delay": {"fmu": "TransportDelay"}}
FREE = {"stop_time": None, "real_time_factor": 1.0}


@pytest.fixture
def here() -> Iterator[Place]:
    with Place() as place:
        yield place


@pytest.fixture
def there() -> Iterator[Place]:
    with Place() as place:
        yield place


def written(folder: Path, *names: str, simulation: dict[str, float | None] | None = None) -> Path:
    """The pair, with these instances on host b, which has no `ssh`."""
    instances = {name: {**own, **({"host": "b"} if name in names else {})} for name, own in PAIR.items()}
    return write_config(
        folder,
        instances=instances,
        deploy={"hosts": {"b": {}}},
        simulation=dict(simulation or {}),
        timeouts={"stop": 5},
    )


def launched(place: Place, file: Path, *options: str) -> tuple[Launched, str]:
    """A launch that waits for host b, and the command that it shows."""
    launch = place.start("launch", file, "--listen", f"tcp/127.0.0.1:{free_port()}", *options)
    return launch, launch.wait_for_error_line("start on b ").strip().rpartition("fmu-mesh node ")[2]


@pytest.mark.parametrize("names", [("delay",), ("pendulum", "delay")], ids=["one node", "two nodes"])
def test_the_shown_command_starts_all_nodes_of_a_host(names: tuple[str, ...], here: Place, there: Place) -> None:
    file = written(here.folder, *names)
    expected = here.run("launch", file, "--local", "--output", here.folder / "local.csv")
    launch, command = launched(here, file)

    by_hand = there.start("node", *command.split())

    assert (launch.wait(), by_hand.wait()) == (0, 0), f"{here.story()}\n{there.story()}"
    assert expected.wait() == 0
    assert file.with_suffix(".csv").read_bytes() == (here.folder / "local.csv").read_bytes()
    assert f"start on b ({', '.join(names)}): fmu-mesh node {file} --host b --connect tcp/127.0.0.1:" in launch.errors
    assert "all nodes of b are there" in launch.errors
    there.assert_nothing_left(on_a_busy_machine(2.0))


def test_status_says_who_is_missing_and_who_is_where(here: Place, there: Place) -> None:
    file = written(here.folder, "delay", simulation=FREE)
    launch, command = launched(here, file)
    missing = wait_until(
        lambda: json.loads(here.run("status", "pair", "--json").output or "{}").get("missing"), "a status"
    )

    by_hand = there.start("node", *command.split())
    wait_until(lambda: here.run("wait", "pair").wait() == 0, "a mesh that runs")
    shown = {name: here.run(*name.split()).output for name in ("status", "top --once", "info delay", "info mesh")}
    launch.signal(signal.SIGINT)

    assert (launch.wait(), by_hand.wait()) == (130, 130), f"{here.story()}\n{there.story()}"
    assert missing[-2:] == ["delay", "@record"]
    assert [line.split()[:2] for line in shown["top --once"].splitlines() if line.startswith("delay")] == [
        ["delay", "b"]
    ]
    assert "delay on host 'b', process" in shown["info delay"]
    assert "pendulum, delay on host 'b', @record" in shown["info mesh"]


@pytest.mark.parametrize("names", [("delay",), ("pendulum", "delay")], ids=["one node", "two nodes"])
def test_a_node_of_a_host_that_is_killed_is_named(names: tuple[str, ...], here: Place, there: Place) -> None:
    file = written(here.folder, *names, simulation=FREE)
    launch, command = launched(here, file)
    by_hand = there.start("node", *command.split())
    wait_until(lambda: here.run("wait", "pair").wait() == 0, "a mesh that runs")
    nodes = {" ".join(process.cmdline()).split()[-1]: process for process in there.processes("node")}
    victim = nodes["delay"] if len(names) > 1 else psutil.Process(by_hand.pid)

    victim.kill()

    codes = (launch.wait(), by_hand.wait())
    assert codes == (4, -signal.SIGKILL if len(names) == 1 else 4), f"{here.story()}\n{there.story()}"
    assert "instance delay on b, point " in launch.errors
    assert "node 'delay' was lost" in launch.errors
    if len(names) > 1:
        assert "node 'delay' was lost: its process was ended by SIGKILL" in by_hand.errors


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_nodes_of_a_host_end_with_the_command(number: signal.Signals, here: Place, there: Place) -> None:
    launch, command = launched(here, written(here.folder, "pendulum", "delay", simulation=FREE))
    by_hand = there.start("node", *command.split())
    wait_until(lambda: here.run("wait", "pair").wait() == 0, "a mesh that runs")

    by_hand.signal(number)

    assert by_hand.wait() == (130 if number != signal.SIGKILL else -signal.SIGKILL)
    assert launch.wait() == 4, here.story()
    psutil.wait_procs(there.processes(), on_a_busy_machine(2.0))
    assert there.processes() == []


def test_a_terminal_shows_who_is_missing_until_the_end(here: Place) -> None:
    file = written(here.folder, "pendulum", "delay", simulation=FREE)
    with Terminal(here, "launch", file, "--listen", f"tcp/127.0.0.1:{free_port()}", columns=200) as terminal:
        terminal.wait_for("b  waits for pendulum, delay")
        terminal.signal(signal.SIGINT)

        assert terminal.wait() == 130
        shown = "\n".join(terminal.shown)
        assert "start on b (pendulum, delay): fmu-mesh node " in shown
        assert "are there" not in shown
        assert "waits for" not in shown


def test_a_host_that_nobody_can_reach_is_refused_at_once(here: Place) -> None:
    launch = here.run("launch", written(here.folder, "delay"))

    assert launch.wait() == 2
    assert launch.message == (
        "fmu-mesh: the nodes of host 'b', which has no `ssh`, cannot reach this mesh. "
        "Give it `--listen` or `--connect`, or `ssh` to the host."
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "`fmu-mesh node` needs INSTANCE. `fmu-mesh node --help` tells more."),
        (("--host", "b", "delay"), "--host starts all nodes of a host, and INSTANCE one. Leave one of them out."),
        (("delay", "--host", "b"), "--host starts all nodes of a host, and INSTANCE one. Leave one of them out."),
        (("--host", "bb"), "there is no host 'bb'. Did you mean 'b'?"),
    ],
)
def test_a_wrong_choice_of_nodes_is_refused(arguments: tuple[str, ...], message: str, here: Place) -> None:
    node = here.run("node", written(here.folder, "delay"), *arguments)

    assert (node.wait(), node.message) == (2, f"fmu-mesh: {message}")


def test_a_host_without_nodes_is_refused(here: Place) -> None:
    node = here.run("node", written(here.folder), "--host", "b")

    assert (node.wait(), node.message) == (
        2,
        "fmu-mesh: host 'b' has no nodes. An instance with this `host` has its node there.",
    )


def test_a_node_that_is_lost_early_ends_the_others(there: Place) -> None:
    file = written(there.folder, "pendulum", "delay")
    by_hand = there.start("node", file, "--host", "b", "--connect", f"tcp/127.0.0.1:{free_port()}")
    nodes = wait_until(lambda: found if len(found := there.processes("node")) == 2 else None, "two nodes")

    nodes[0].kill()

    assert by_hand.wait() == 4, there.story()
    assert "was lost: its process was ended by SIGKILL" in by_hand.errors
    assert there.processes() == []


@pytest.mark.parametrize("names", [("delay",), ("pendulum", "delay")], ids=["one node", "two nodes"])
def test_nodes_go_on_with_the_next_attempt(names: tuple[str, ...], here: Place, there: Place) -> None:
    file = written(here.folder, *names, simulation={"stop_time": 3.0, "real_time_factor": 1.0})
    with file.open("a", encoding="utf-8") as text:
        text.write("recovery: {mode: restart}\n")
    expected = here.run("launch", file, "--local", "--set-config", "recovery.mode=stop", "--output", "local.csv")
    assert expected.wait() == 0, here.story()
    launch, command = launched(here, file)
    by_hand = there.start("node", *command.split())
    result = file.with_suffix(".csv")

    for number in (1, 2):
        before = row_count(result)
        wait_until(lambda: row_count(result) > before + 50 or not launch.running, "rows")  # noqa: B023  called within the turn
        launch.child("master").kill()
        wait_until(lambda: f"(restart {number} of 3)" in launch.errors or not launch.running, "a restart")  # noqa: B023  as above
    if len(names) > 1:
        nodes = {" ".join(process.cmdline()).split()[-1]: process for process in there.processes("node")}
        wait_until(lambda: row_count(result) > 1300 or not launch.running, "rows")
        nodes["delay"].kill()

    assert (launch.wait(), by_hand.wait()) == (0, 0), f"{here.story()}\n{there.story()}"
    assert result.read_bytes() == (here.folder / "local.csv").read_bytes()
    assert "waiting for the next attempt" in by_hand.errors
    there.assert_nothing_left(on_a_busy_machine(2.0))


def test_what_was_set_at_a_node_is_given_again(here: Place, there: Place) -> None:
    file = write_config(
        here.folder,
        instances={"pendulum": {"fmu": "DampedPendulum"}, "gain": {"fmu": "Gain", "host": "b"}},
        connections=["pendulum.a -> gain.u"],
        deploy={"hosts": {"b": {}}},
        simulation={"stop_time": 3.0, "real_time_factor": 1.0},
    )
    launch, command = launched(here, file, "--restarts", "1")
    by_hand = there.start("node", *command.split())
    result = file.with_suffix(".csv")
    wait_until(lambda: row_count(result) > 50 or not launch.running, "rows")

    assert here.run("set", "gain.k", "3.5").wait() == 0
    before = row_count(result)
    wait_until(lambda: row_count(result) > before + 50 or not launch.running, "rows with it")
    launch.child("master").kill()

    # The recorder compares the rows with those before, and the values in the metadata are those of the last attempt.
    assert (launch.wait(), by_hand.wait()) == (0, 0), f"{here.story()}\n{there.story()}"
    text = result.with_name(f"{result.name}.json").read_text(encoding="utf-8")
    assert [value["value"] for value in json.loads(text)["set"]] == [3.5]
    there.assert_nothing_left(on_a_busy_machine(2.0))
