"""A mesh over hosts that loses a process, ssh, or a whole host, and starts again: its result is the same in every byte.

The hosts are those of `test_over_ssh`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Final

import psutil
import pytest

from tests.helpers import Launched, row_count, wait_until
from tests.network_hosts import link_is
from tests.ssh_hosts import NEEDS_SSH, SshHosts, ssh_hosts
from tests.ssh_meshes import MeshOverSsh, mesh_over_ssh

pytestmark = NEEDS_SSH

IS_LONG: Final = "FMU_MESH_HOSTS" in os.environ


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SshHosts]:
    with ssh_hosts(tmp_path_factory.mktemp("pair")) as entered:
        yield entered


def journals(pair: SshHosts) -> list[str]:
    """What is left in the cache of the other host for a next attempt."""
    return [path.name for path in (pair["b"].home / ".cache/fmu_mesh/hosts/journals").glob("**/*")]


def kill_after_rows(mesh: MeshOverSsh, launched: Launched, part: str, words: str) -> None:
    """Kill a part when there are some more rows, and wait until `launch` says these words."""
    before = row_count(mesh.result)
    wait_until(lambda: row_count(mesh.result) > before + 50 or not launched.running, "new rows")
    assert launched.running, mesh.story()
    mesh.process(part).kill()
    wait_until(lambda: words in launched.errors or not launched.running, f"'{words}'")
    assert words in launched.errors, mesh.story()


def assert_no_row_is_lost(mesh: MeshOverSsh, code: int) -> None:
    assert code == 0, mesh.story()
    assert mesh.result.read_bytes() == mesh.expected(), mesh.story()
    mesh.assert_nothing_left()
    assert journals(mesh.entered) == []


PARTS: Final = ("delay", "master", "helper", "ssh")


@pytest.mark.parametrize("parts", [PARTS, PARTS[::-1]] if IS_LONG else [PARTS])
def test_whatever_is_killed_the_run_goes_on(pair: SshHosts, parts: tuple[str, ...]) -> None:
    with mesh_over_ssh(pair, lasts_s=4.0, recovery={"mode": "restart", "max_restarts": 9}) as mesh:
        launched = mesh.running()
        for number, part in enumerate(parts, 1):
            kill_after_rows(mesh, launched, part, f"(restart {number} of 9)")

        assert_no_row_is_lost(mesh, launched.wait())


def test_what_is_killed_while_it_comes_back_costs_one_more_restart(pair: SshHosts) -> None:
    with mesh_over_ssh(pair, lasts_s=2.0, recovery={"mode": "restart", "max_restarts": 9}) as mesh:
        launched = mesh.running(rows=200)
        for number, part in enumerate(("pendulum", "delay", "delay"), 1):
            mesh.process(part).kill()
            launched.wait_for_error_line(f"(restart {number} of 9)")

        mesh.process("ssh").kill()  # often before nodes can be started: then `launch` connects again

        assert_no_row_is_lost(mesh, launched.wait())


def test_a_host_that_is_back_takes_part_again(pair: SshHosts) -> None:
    recovery, timeouts = {"mode": "restart"}, {"link": 3.0, "start": 30.0}
    with mesh_over_ssh(pair, lasts_s=3.0, recovery=recovery, timeouts=timeouts) as mesh:
        launched = mesh.running(rows=200)
        link_is(pair["b"], "down")
        try:
            launched.wait_for_error_line("silent for 3 s, the limit of `timeouts.link`")
        finally:
            link_is(pair["b"], "up")

        assert_no_row_is_lost(mesh, launched.wait())


def test_a_host_that_does_not_come_back_ends_the_run(pair: SshHosts) -> None:
    with mesh_over_ssh(pair, lasts_s=20.0, recovery={"mode": "restart"}, timeouts={"start": 3.0}) as mesh:
        launched = mesh.running(rows=200)
        (daemon,) = psutil.Process(pair.daemons["b"].pid).children()
        daemon.suspend()  # a stopped sshd takes no new connection, and the session there goes on
        try:
            mesh.process("session").kill()

            assert launched.wait() == 4, mesh.story()
        finally:
            daemon.resume()
        assert "b was lost, and was not back within 3 s: no node can be started on b" in launched.errors
        assert "What was recorded up to then" in launched.errors
        mesh.assert_nothing_left()
        for folder in (pair["b"].home / ".cache/fmu_mesh/hosts/journals").iterdir():
            folder.rmdir()  # nobody could tell this host that no attempt follows; nothing was set


def test_values_set_on_another_host_are_given_again(pair: SshHosts) -> None:
    with mesh_over_ssh(pair, "star", lasts_s=4.0, recovery={"mode": "restart"}) as mesh:
        launched = mesh.running(rows=200)
        changed = pair["a"].start("fmu-mesh", "set", "gain_1.k", "7.5")
        assert changed.wait() == 0, changed.story()
        for number, part in enumerate(("gain_1", "helper", "master"), 1):
            kill_after_rows(mesh, launched, part, f"(restart {number} of 3)")

        assert launched.wait() == 0, mesh.story()  # the recorder has compared the rows with those before
        assert mesh.result.read_bytes() != mesh.expected()
        mesh.assert_nothing_left()
        assert journals(pair) == []
