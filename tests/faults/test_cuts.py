"""The network between two hosts is cut, at any moment of a run: it costs time, and never a value.

`FMU_MESH_CUTS` says how many times the network is cut in a run of each system, and adds what takes minutes. Without it,
a few systems are cut a few times.
"""

from __future__ import annotations

import ctypes
import os
import random
import re
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final, NamedTuple

import pytest
import yaml

from fmu_mesh.run.options import PlanOptions
from fmu_mesh.system.plan import MASTER, RECORDER
from tests.all_systems import SYSTEMS, written_system
from tests.helpers import BY_STREAMS, FMUS, Launched, Place, row_count, wait_until
from tests.network_hosts import NEEDS_HOSTS, NetworkHost, link_is, started_apart, started_hosts
from tests.plain_run import PlainRun
from tests.planning import prepare

IS_LONG: Final = "FMU_MESH_CUTS" in os.environ
CUTS: Final = int(os.environ.get("FMU_MESH_CUTS", "4"))
LASTS_S: Final = max(5.0, 0.8 * CUTS)
"""A run: more than its cuts and the time between them."""
AFTER_S: Final = 1.0
"""A run goes on so long after the network is back, at most; two round trips are nothing here."""
FLUSH_S: Final = 0.2
"""The recorder writes so often into the file."""
SILENT_S: Final = 1.5
"""After so long, a silent stream counts as cut."""
CONFIG: Final = Path("system", "system.yaml")

THREE: Final = [MAIN := "pendulum_delay", CYCLE := "cycle2", STAR := "star"]
BY_ZENOH: Final = {"row_streams": False}

LIBC: Final = ctypes.CDLL(None, use_errno=True)
PIDFD_GETFD: Final = 438
"""The number of this call of the system on every processor."""


class Apart(NamedTuple):
    """A mesh that runs on two hosts."""

    hosts: Sequence[NetworkHost]
    config: Path
    launched: Sequence[Launched]

    @property
    def result(self) -> Path:
        """The result file."""
        return self.config.with_suffix(".csv")

    def assert_ends_well(self) -> None:
        """The result is that of one process."""
        codes = [one.wait() for one in self.launched]
        assert codes == [0] * len(codes), self.story()
        local = self.config.with_name("local.csv")
        PlainRun(prepare(self.config, PlanOptions(output=local))).run()
        assert self.result.read_bytes() == local.read_bytes(), self.story()

    def story(self) -> str:
        """What its processes wrote."""
        return "".join(one.story() for one in self.launched)


def let_pass(seconds: float) -> None:
    """The time of a cut, or between two."""
    end = time.monotonic() + seconds
    wait_until(lambda: time.monotonic() > end, "the end of a time")


def cut(host: NetworkHost, seconds: float) -> None:
    """Cut the network for this time."""
    link_is(host, "down")
    let_pass(seconds)
    link_is(host, "up")


def until_more_rows(mesh: Apart, times: int = 1) -> float:
    """Wait until so many times rows are written, or the run has ended; return how long that took, in s."""
    begun = time.monotonic()
    for _ in range(times):
        rows = row_count(mesh.result)
        wait_until(lambda: row_count(mesh.result) > rows or not mesh.launched[0].running, "more rows")  # noqa: B023  used here
    return time.monotonic() - begun


UNREACHED = """
import sys

def refuse(event, arguments):
    frame = sys._getframe(1) if event == "socket.connect" and isinstance(arguments[1], tuple) else None
    while frame is not None:
        if frame.f_locals.get("peer") == "{}":
            raise ConnectionRefusedError
        frame = frame.f_back

sys.addaudithook(refuse)
"""
"""In each process: the door for row streams of one participant cannot be reached; Zenoh, which is no Python, can."""


@contextmanager
def running(
    folder: Path, name: str, zenoh: Mapping[str, bool], link_s: float = 30.0, *, unreached: str = ""
) -> Iterator[Apart]:
    """A system that runs for `LASTS_S`, with some rows written; the door of one participant may be ``unreached``."""
    with started_hosts(folder) as hosts:
        if unreached:
            (folder / "shared" / "sitecustomize.py").write_text(UNREACHED.format(unreached), encoding="utf-8")
        configs = [
            written_system(
                name, host.folder / "own-clone" / CONFIG.parent, lasts_s=LASTS_S, zenoh=zenoh, timeouts={"link": link_s}
            )
            for host in hosts
        ]
        nodes = [node for node in prepare(configs[0]).nodes if node != RECORDER]
        environment = {"PYTHONPATH": "/mnt"} if unreached else {}
        mesh = Apart(hosts, configs[0], started_apart(hosts, CONFIG, nodes, environment=environment))
        wait_until(lambda: row_count(mesh.result) > 1 or not mesh.launched[0].running, "some rows")
        yield mesh


@NEEDS_HOSTS
@pytest.mark.parametrize(
    ("name", "zenoh"),
    [
        *(pytest.param(name, {}, id=f"{name}-streams") for name in (SYSTEMS if IS_LONG else [CYCLE])),
        *(pytest.param(name, BY_ZENOH, id=f"{name}-zenoh") for name in ([MAIN, CYCLE] if IS_LONG else [MAIN])),
    ],
)
def test_short_cuts_at_any_moment_cost_only_time(tmp_path: Path, name: str, zenoh: Mapping[str, bool]) -> None:
    seed = random.SystemRandom().randrange(2**32) if IS_LONG else 0
    chance = random.Random(seed)  # noqa: S311  a moment
    with running(tmp_path, name, zenoh) as mesh:
        made = 0
        while made < CUTS and mesh.launched[0].running:
            let_pass(chance.uniform(0.0, 0.5))
            cut(mesh.hosts[1], chance.uniform(0.05, 0.5))
            made += 1

        assert made == CUTS, f"seed {seed}; the run has ended before\n{mesh.story()}"
        mesh.assert_ends_well()


@NEEDS_HOSTS
@pytest.mark.parametrize(
    ("name", "zenoh", "seconds"),
    [
        *(pytest.param(name, {}, 3.0, id=f"{name}-streams-3") for name in (THREE if IS_LONG else [MAIN])),
        *(pytest.param(name, BY_ZENOH, 3.0, id=f"{name}-zenoh-3") for name in (THREE if IS_LONG else [CYCLE])),
        *(pytest.param(name, {}, 20.0, id=f"{name}-streams-20") for name in (THREE if IS_LONG else [])),
        *(pytest.param(name, BY_ZENOH, 20.0, id=f"{name}-zenoh-20") for name in (THREE if IS_LONG else [])),
    ],
)
def test_after_a_long_cut_a_run_goes_on_at_once(
    tmp_path: Path,
    name: str,
    zenoh: Mapping[str, bool],
    seconds: float,
    record_property: Callable[[str, object], None],
) -> None:
    with running(tmp_path, name, zenoh) as mesh:
        link_is(mesh.hosts[1], "down")
        let_pass(seconds)
        link_is(mesh.hosts[1], "up")
        waited_s = until_more_rows(mesh)
        record_property("waited_s", waited_s)

        mesh.assert_ends_well()
        assert waited_s <= AFTER_S + FLUSH_S, f"it waited {waited_s:.2f} s after the network was back"


WIDE = '''
import time

import fmu_mesh


class Wide(fmu_mesh.Component):
    """Rows of 8 MB, each after a second."""

    y = fmu_mesh.Output(shape=1_000_000)

    def step(self, now, step_size):
        time.sleep(1.0)
        self.y[:] = now


class Sum(fmu_mesh.Component):
    u = fmu_mesh.Input(shape=1_000_000)
    sum = fmu_mesh.Output()

    def step(self, now, step_size):
        self.sum = float(self.u.sum())
'''

GATE = '''
import os
import time

import fmu_mesh


class Gate(fmu_mesh.Component):
    """Stands at the moment that a file names, until another file is there."""

    u = fmu_mesh.Input()
    y = fmu_mesh.Output()
    name = fmu_mesh.Parameter("", type="String")
    last = fmu_mesh.Parameter(0.0)

    def initialize(self):
        self.stand("initialize")

    def step(self, now, step_size):
        self.y = self.u + now
        if now + 1.5 * step_size > self.last:
            self.stand("last step")

    def stand(self, moment):
        here = os.path.join(os.path.dirname(__file__), f"{self.name} in {moment}")
        if os.path.exists(f"{here}: stand"):
            open(f"{here}: stands", "w").close()
            end = time.monotonic() + 60.0
            while os.path.exists(f"{here}: stand") and time.monotonic() < end:
                time.sleep(0.01)
'''


def written_parts(folder: Path, source: str, content: Mapping[str, object]) -> Path:
    """Components, and a configuration with them."""
    folder.mkdir()
    (folder / "parts.py").write_text(source, encoding="utf-8")
    path = folder / CONFIG.name
    path.write_text(yaml.safe_dump({"mesh": "system", **content}, sort_keys=False), encoding="utf-8")
    return path


def told_in_a_cut(mesh: Apart, command: str) -> None:
    """Give a command on the first host while the network is cut; it has to succeed."""
    first, second = mesh.hosts
    link_is(second, "down")
    telling = first.start("fmu-mesh", command, "system")
    let_pass(2.0)
    link_is(second, "up")
    assert telling.wait() == 0, telling.story() + mesh.story()


@NEEDS_HOSTS
@pytest.mark.parametrize("zenoh", [{}, BY_ZENOH] if IS_LONG else [{}], ids=lambda own: "zenoh" if own else "streams")
def test_a_pause_during_a_cut_takes_effect_and_costs_only_time(tmp_path: Path, zenoh: Mapping[str, bool]) -> None:
    with running(tmp_path, CYCLE, zenoh) as mesh:
        told_in_a_cut(mesh, "pause")

        assert mesh.hosts[0].start("fmu-mesh", "resume", "system").wait() == 0
        mesh.assert_ends_well()


@NEEDS_HOSTS
@pytest.mark.parametrize("zenoh", [{}, BY_ZENOH], ids=["streams", "zenoh"])
def test_a_stop_during_a_cut_ends_all_processes(tmp_path: Path, zenoh: Mapping[str, bool]) -> None:
    with running(tmp_path, CYCLE, zenoh) as mesh:
        told_in_a_cut(mesh, "stop")

        assert [one.wait() for one in mesh.launched] == [130, 130, 130], mesh.story()


@NEEDS_HOSTS
@pytest.mark.parametrize(
    ("zenoh", "unreached"), [({}, ""), (BY_ZENOH, ""), ({}, MASTER)], ids=["streams", "zenoh", "master-by-zenoh"]
)
def test_a_cut_that_is_too_long_is_named_with_both_ends(
    tmp_path: Path, zenoh: Mapping[str, bool], unreached: str
) -> None:
    with running(tmp_path, MAIN, zenoh, link_s=2.0, unreached=unreached) as mesh:
        link_is(mesh.hosts[1], "down")
        begun = time.monotonic()

        assert [one.wait() for one in mesh.launched] == [4, 4, 4], mesh.story()

        assert time.monotonic() - begun < 2.0 + SILENT_S + 2.0, mesh.story()
        for one in mesh.launched:
            assert re.search(r"link.*node 'delay'|node 'delay'.*link", one.message), mesh.story()
            assert re.search(r"the master|node 'pendulum'", one.message), mesh.story()
        told = (
            ["WARNING: the master and node 'delay' cannot reach each other: their rows go by Zenoh"]
            if unreached
            else []
        )
        assert re.findall("WARNING: .*cannot reach.*", mesh.launched[0].errors) == told


@NEEDS_HOSTS
@pytest.mark.skipif(not IS_LONG, reason="it takes 20 s; FMU_MESH_CUTS asks for it")
def test_rows_of_eight_megabytes_survive_a_cut(tmp_path: Path) -> None:
    content = {
        "simulation": {"stop_time": 6.0, "step_size": 1.0},
        "instances": {"sum": {"python": "parts.py:Sum"}, "wide": {"python": "parts.py:Wide"}},
        "connections": ["wide.y -> sum.u"],
        "record": {"file": "system.csv", "variables": ["sum.sum"]},
    }
    with started_hosts(tmp_path) as hosts:
        configs = [written_parts(host.folder / "own-clone" / CONFIG.parent, WIDE, content) for host in hosts]
        mesh = Apart(hosts, configs[0], started_apart(hosts, CONFIG, ["sum", "wide"]))
        wait_until(lambda: row_count(mesh.result) > 1 or not mesh.launched[0].running, "some rows")

        cut(hosts[1], 2.0)

        mesh.assert_ends_well()


STANDING: Final = {
    "simulation": {"stop_time": 0.5, "step_size": 0.01},
    "instances": {
        "near": {"python": "parts.py:Gate", "start_values": {"name": "near", "last": 0.5}},
        "far": {"python": "parts.py:Gate", "start_values": {"name": "far", "last": 0.5}},
        "gain": {"fmu": str(FMUS / "Gain.fmu")},
    },
    "connections": ["near.y -> far.u", "far.y -> gain.u"],
    "record": {"file": "system.csv"},
}
LONGEST: Final = [2.0, 12.0] if IS_LONG else [2.0]
"""Of cuts; in s. The longer one is longer than `timeouts.stop`."""


@contextmanager
def prepared(folder: Path) -> Iterator[tuple[list[NetworkHost], Path]]:
    """Two hosts, and the configuration with two gates and the master's result."""
    with started_hosts(folder) as hosts:
        configs = [written_parts(host.folder / "own-clone" / CONFIG.parent, GATE, STANDING) for host in hosts]
        yield hosts, configs[0]


@NEEDS_HOSTS
@pytest.mark.parametrize("seconds", LONGEST)
def test_a_network_that_comes_late_delays_the_start(tmp_path: Path, seconds: float) -> None:
    with prepared(tmp_path) as (hosts, config):
        link_is(hosts[1], "down")
        mesh = Apart(hosts, config, started_apart(hosts, CONFIG, ["near", "far", "gain"]))
        let_pass(seconds)
        link_is(hosts[1], "up")

        mesh.assert_ends_well()


def connections(host: NetworkHost) -> int:
    """How many connections to the other host are there."""
    lines = Path(f"/proc/{host.pid}/net/tcp").read_text(encoding="ascii").splitlines()[1:]
    return sum(line.split()[3] == "01" for line in lines)


@NEEDS_HOSTS
@pytest.mark.parametrize("seconds", LONGEST)
@pytest.mark.parametrize("later_s", [0.0, 0.02, 0.05, 0.1, 0.2] if IS_LONG else [0.0])
@pytest.mark.parametrize("met", [1, 2, 3], ids=["the session", "a first stream", "a second stream"])
def test_a_cut_while_nodes_register_and_meet_costs_only_time(
    tmp_path: Path, met: int, later_s: float, seconds: float
) -> None:
    with prepared(tmp_path) as (hosts, config):
        mesh = Apart(hosts, config, started_apart(hosts, CONFIG, ["near", "far", "gain"]))
        wait_until(lambda: connections(hosts[1]) >= met or not mesh.launched[0].running, f"{met} connections")
        let_pass(later_s)

        cut(hosts[1], seconds)

        mesh.assert_ends_well()


@NEEDS_HOSTS
@pytest.mark.parametrize("seconds", LONGEST)
@pytest.mark.parametrize("moment", ["initialize", "last step"])
@pytest.mark.parametrize("who", ["near", "far"])
def test_a_cut_in_initialization_or_at_the_end_costs_only_time(
    tmp_path: Path, who: str, moment: str, seconds: float
) -> None:
    with prepared(tmp_path) as (hosts, config):
        gates = [host.folder / "own-clone" / CONFIG.parent / f"{who} in {moment}: stand" for host in hosts]
        for gate in gates:
            gate.touch()
        mesh = Apart(hosts, config, started_apart(hosts, CONFIG, ["near", "far", "gain"]))
        stands = [gate.with_name(f"{who} in {moment}: stands") for gate in gates]
        wait_until(lambda: any(file.exists() for file in stands) or not mesh.launched[0].running, "a node that stands")
        assert any(file.exists() for file in stands), mesh.story()

        link_is(hosts[1], "down")
        for gate in gates:
            gate.unlink()
        let_pass(seconds)
        link_is(hosts[1], "up")

        mesh.assert_ends_well()


def streams_here(place: Place) -> list[tuple[int, int]]:
    """The process and the descriptor of each end of a stream that came to a door."""
    lines = Path("/proc/net/unix").read_text(encoding="utf-8").splitlines()
    fields = [line.split() for line in lines if line.endswith(".rows") and str(place.folder) in line]
    connected = {f"socket:[{field[6]}]" for field in fields if field[5] == "03"}
    found = []
    for process in place.processes():
        with suppress(OSError):
            own = Path(f"/proc/{process.pid}/fd")
            found += [(process.pid, int(file.name)) for file in own.iterdir() if str(file.readlink()) in connected]
    return found


def shut_down(pid: int, descriptor: int) -> bool:
    """End a socket of another process, as if its peer had reset it; whether it was there."""
    process = os.pidfd_open(pid)
    try:
        own = LIBC.syscall(PIDFD_GETFD, process, descriptor, 0)
        if own < 0:
            return False
        with socket.socket(fileno=own) as end:
            end.shutdown(socket.SHUT_RDWR)
    except OSError:
        return False
    finally:
        os.close(process)
    return True


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may take a socket of another process")
@pytest.mark.parametrize("name", SYSTEMS if IS_LONG else [STAR])
def test_a_stream_that_ends_is_dialled_again_and_costs_only_time(place: Place, name: str) -> None:
    seed = random.SystemRandom().randrange(2**32) if IS_LONG else 0
    chance = random.Random(seed)  # noqa: S311  a moment
    config = written_system(name, place.folder / "system", lasts_s=LASTS_S, zenoh=BY_STREAMS)
    launched = place.start("launch", config, "--no-progress")
    mesh = Apart((), config, [launched])
    wait_until(lambda: row_count(mesh.result) > 1 or not launched.running, "some rows")

    ended, waited_s = 0, [0.0]
    while ended < CUTS and launched.running:
        let_pass(chance.uniform(0.0, 0.5))
        if (there := streams_here(place)) and shut_down(*chance.choice(there)):
            ended += 1
            if name in THREE:  # whose rows come often
                waited_s.append(until_more_rows(mesh, 2))  # the first ones may have come before

    assert ended == CUTS, f"seed {seed}; the run has ended before\n{mesh.story()}"
    mesh.assert_ends_well()
    assert max(waited_s) <= AFTER_S + 2 * FLUSH_S, f"seed {seed}: it waited {waited_s} s"
