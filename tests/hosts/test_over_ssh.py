"""A mesh over hosts that `launch` enters by ssh: the numbers of one process, who ends what, and what is left.

Each host has a network, processes, a `/tmp` and a home folder of its own, and a real sshd. `FMU_MESH_HOSTS` adds what
takes minutes: all systems, and each fault more than once.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from tests.all_systems import SYSTEMS
from tests.helpers import Launched, on_a_busy_machine, row_count, wait_until
from tests.network_hosts import link_is
from tests.ssh_hosts import NEEDS_SSH, SshHosts, ssh_hosts
from tests.ssh_meshes import MeshOverSsh, mesh_over_ssh

pytestmark = NEEDS_SSH

IS_LONG: Final = "FMU_MESH_HOSTS" in os.environ
LINK_S: Final = 5.0
"""`timeouts.link` where a fault is only seen by silence."""
ENDLESS_S: Final = 600.0


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SshHosts]:
    with ssh_hosts(tmp_path_factory.mktemp("pair")) as entered:
        yield entered


def assert_ends_well(mesh: MeshOverSsh, launched: Launched) -> None:
    assert launched.wait() == 0, mesh.story()
    assert mesh.result.read_bytes() == mesh.expected(), mesh.story()
    mesh.assert_nothing_left()


def let_pass(seconds: float) -> None:
    end = time.monotonic() + seconds
    wait_until(lambda: time.monotonic() > end, "the end of a time")


@pytest.mark.parametrize("system", SYSTEMS if IS_LONG else ["pendulum_delay", "cycle2"])
def test_a_system_over_two_hosts_has_the_result_of_one_process(pair: SshHosts, system: str) -> None:
    with mesh_over_ssh(pair, system) as mesh:
        assert_ends_well(mesh, mesh.launch())


def test_three_hosts_reach_each_other_through_the_one_of_launch(tmp_path: Path) -> None:
    with ssh_hosts(tmp_path, ("a", "b", "c")) as entered, mesh_over_ssh(entered, "star") as mesh:
        launched = mesh.running() if IS_LONG else mesh.launch()

        assert_ends_well(mesh, launched)


def test_second_start_finds_the_files_of_the_first_in_the_cache(pair: SshHosts) -> None:
    def cached() -> dict[Path, tuple[int, int]]:
        files = [path for path in (pair["b"].home / ".cache" / "fmu_mesh" / "hosts").rglob("*") if path.is_file()]
        return {path: (path.stat().st_ino, path.stat().st_mtime_ns) for path in files}

    with mesh_over_ssh(pair) as mesh:
        assert_ends_well(mesh, mesh.launch())
        first = cached()
        assert first

        assert_ends_well(mesh, mesh.launch())

        assert {path: inode for path, (inode, _) in cached().items()} == {path: one for path, (one, _) in first.items()}


CONNECTION: Final = {
    "ssh": "ssh was ended by SIGKILL)",
    "session": "ssh ended with exit code 255: ",
    "helper": "ssh ended with exit code 255: a signal has ended the helper there)",
    "relay": "the relay to ssh was ended by SIGKILL)",
}
"""How it is lost if a part of it is killed."""


@pytest.mark.parametrize("part", [*CONNECTION, "delay", "pendulum", "master"])
def test_whatever_is_killed_the_run_ends_and_says_so(pair: SshHosts, part: str) -> None:
    with mesh_over_ssh(pair, lasts_s=ENDLESS_S) as mesh:
        launched = mesh.running()

        mesh.process(part).kill()

        assert launched.wait() == 4, mesh.story()
        assert launched.ended_after_s < on_a_busy_machine(3.0), mesh.story()
        mesh.assert_nothing_left(on_a_busy_machine(2.0))
        message = launched.message
        if part in {"delay", "pendulum", "master"}:
            assert "its process was ended by SIGKILL" in message
        if part in {"ssh", "session"}:
            assert "the ssh connection to b was lost (ssh " in message
        if part not in {"pendulum", "master"}:
            assert "instance delay on b, point" in message
            assert "node 'delay' was lost: " in message


def test_a_killed_launcher_leaves_nothing_on_any_host(pair: SshHosts) -> None:
    with mesh_over_ssh(pair, lasts_s=ENDLESS_S) as mesh:
        launched = mesh.running()

        mesh.process("launcher").kill()

        launched.wait()
        mesh.assert_nothing_left(on_a_busy_machine(3.0))


@pytest.mark.parametrize("part", CONNECTION)
def test_what_is_stopped_is_seen_by_its_silence(pair: SshHosts, part: str) -> None:
    with mesh_over_ssh(pair, lasts_s=ENDLESS_S, timeouts={"link": LINK_S}) as mesh:
        launched = mesh.running()

        mesh.process(part).suspend()

        assert launched.wait() == 4, mesh.story()
        assert launched.ended_after_s < on_a_busy_machine(LINK_S + 3.0), mesh.story()
        assert "silent for 5 s" in launched.message
        if part == "session":  # a stopped sshd ends when it goes on
            wait_until(lambda: [one for one in mesh.left() if "sshd" in one] == mesh.left(), "sshd alone")
            mesh.process(part).resume()
        mesh.assert_nothing_left(on_a_busy_machine(LINK_S + 3.0))


def test_a_stopped_launcher_stops_nothing_but_its_output(pair: SshHosts) -> None:
    with mesh_over_ssh(pair, lasts_s=8.0, timeouts={"link": 3.0}) as mesh:
        launched = mesh.running()
        launcher = mesh.process("launcher")

        launcher.suspend()
        rows = row_count(mesh.result)
        let_pass(5.0)
        more = row_count(mesh.result)
        launcher.resume()
        launched.signal(signal.SIGCONT)  # `nsenter` has stopped with it

        assert more > rows
        assert_ends_well(mesh, launched)


@pytest.mark.parametrize("part", ["delay", "pendulum", "master"] if IS_LONG else ["delay"])
def test_a_process_that_was_stopped_for_a_while_costs_only_time(pair: SshHosts, part: str) -> None:
    with mesh_over_ssh(pair, lasts_s=8.0, timeouts={"link": 3.0}) as mesh:
        launched = mesh.running()
        process = mesh.process(part)

        process.suspend()
        let_pass(5.0)
        process.resume()

        assert_ends_well(mesh, launched)


@pytest.mark.parametrize(
    ("part", "words"),
    [
        ("delay", "node 'delay' on b, point "),
        ("pendulum", "its process is stopped (state T)"),
        ("master", "the master was lost: its process is stopped (state T)"),
    ],
    ids=["delay", "pendulum", "master"],
)
@pytest.mark.skipif(not IS_LONG, reason="it takes half a minute; FMU_MESH_HOSTS asks for it")
def test_a_process_that_stays_stopped_ends_the_run(pair: SshHosts, part: str, words: str) -> None:
    with mesh_over_ssh(pair, lasts_s=ENDLESS_S, timeouts={"step": 3.0, "stop": 3.0}) as mesh:
        launched = mesh.running()

        mesh.process(part).suspend()

        assert launched.wait() == 4, mesh.story()
        assert words in launched.message
        mesh.assert_nothing_left()


def test_an_interrupt_ends_the_run_in_order_on_all_hosts(pair: SshHosts) -> None:
    with mesh_over_ssh(pair, lasts_s=ENDLESS_S) as mesh:
        launched = mesh.running()

        mesh.process("launcher").send_signal(signal.SIGINT)

        assert launched.wait() == 130, mesh.story()
        assert launched.ended_after_s < on_a_busy_machine(3.0)
        mesh.assert_nothing_left(on_a_busy_machine(2.0))


def test_a_cut_of_three_seconds_costs_only_time(pair: SshHosts) -> None:
    with mesh_over_ssh(pair, lasts_s=5.0) as mesh:
        launched = mesh.running()

        link_is(pair["b"], "down")
        let_pass(3.0)
        link_is(pair["b"], "up")

        assert_ends_well(mesh, launched)


def test_a_host_that_is_cut_off_ends_its_part_by_itself(pair: SshHosts) -> None:
    with mesh_over_ssh(pair, lasts_s=ENDLESS_S, timeouts={"link": LINK_S}) as mesh:
        launched = mesh.running()
        link_is(pair["b"], "down")
        try:
            assert launched.wait() == 4, mesh.story()
            assert launched.ended_after_s < on_a_busy_machine(LINK_S + 3.0), mesh.story()
            assert "silent for 5 s" in launched.message
            wait_until(lambda: not [one for one in mesh.left() if "sshd" not in one], "nothing of ours", LINK_S + 5.0)
        finally:
            link_is(pair["b"], "up")
        mesh.assert_nothing_left()
