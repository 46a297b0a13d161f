"""Who gets into a mesh: its user by the socket that `launch` prints, nobody else unless a port is asked for."""

from __future__ import annotations

import grp
import json
import math
import os
import re
import stat
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
import zenoh

from fmu_mesh.config.access_sections import leaves_host
from fmu_mesh.errors import ConfigurationError
from fmu_mesh.wire.runtime import run_folder, runtime_folder
from tests.helpers import DEADLINE_S, Launched, Place, row_count, wait_until, write_config

FAR_S = 1_000_000.0
NOBODY = 65534

_AS_NOBODY = """
import os, socket, sys
os.setgroups([])
os.setgid({nobody})
os.setuid({nobody})
with socket.socket(socket.AF_UNIX) as probe:
    probe.connect(sys.argv[1])
"""


def running(place: Place, *options: str) -> Launched:
    """A mesh that runs in real time, as soon as it says where."""
    config = write_config(place.folder, stop_time=FAR_S, simulation={"real_time_factor": 1})
    launched = place.start("launch", config, *options)
    launched.wait_for_error_line("mesh 'pair' at")
    return launched


def endpoint_of(launched: Launched) -> str:
    """The endpoint that was printed."""
    return launched.wait_for_error_line("mesh 'pair' at").rpartition(" at ")[2].strip()


def ports(place: Place) -> list[str]:
    """The TCP and UDP ports of all processes that run here."""
    found = []
    for process in place.processes():
        with suppress(psutil.NoSuchProcess):  # it has just ended
            found += process.net_connections(kind="inet")
    return [
        f"{connection.laddr.ip}:{connection.laddr.port}"
        for connection in found
        if connection.status == psutil.CONN_LISTEN or not connection.raddr
    ]


def value_of_angle(endpoint: str) -> float:
    """The angle of the pendulum, asked for by a session as any program would open it."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))

    def ask(session: zenoh.Session) -> float | None:
        for reply in session.get("fmu_mesh/pair/pendulum/out/a"):
            if reply.ok is not None:
                return float(json.loads(reply.ok.payload.to_bytes()))
        return None

    with zenoh.open(config) as session:
        return wait_until(lambda: ask(session), "the angle")


def test_only_way_in_is_socket_that_any_zenoh_client_of_user_opens(place: Place) -> None:
    launched = running(place)
    endpoint = endpoint_of(launched)

    assert endpoint.startswith(f"unixsock-stream/{place.folder}/run/pair.")
    assert list(place.note().endpoints) == [endpoint]
    assert value_of_angle(endpoint) != 0.0
    assert ports(place) == []
    info = json.loads(place.run("info", "pair", "--json").output)
    assert info["endpoints"] == [endpoint]


def test_a_gateway_to_ros_opens_no_port_either(place: Place) -> None:
    ros = {"profile": "rmw_zenoh", "distribution": "jazzy", "connect": ["tcp/127.0.0.1:9"]}
    config = write_config(place.folder, stop_time=FAR_S, simulation={"real_time_factor": 1}, ros=ros)
    place.start("launch", config)

    wait_until(lambda: row_count(config.with_suffix(".csv")) > 10, "rows, which come after the gateway is ready")

    assert ports(place) == []


@pytest.mark.skipif(os.getuid() != 0, reason="only root can become another user")
def test_another_user_of_the_host_does_not_get_in(place: Place) -> None:
    path = endpoint_of(running(place)).partition("/")[2]
    place.folder.chmod(0o755)  # what is above the runtime folder may be open

    program = _AS_NOBODY.format(nobody=NOBODY)
    tried = subprocess.run([sys.executable, "-c", program, path], capture_output=True, text=True, check=False)

    assert "PermissionError" in tried.stderr


@pytest.mark.parametrize("command", ["launch", "master", "run"])
def test_a_port_is_opened_where_listen_asks_for_it(place: Place, command: str) -> None:
    config = write_config(place.folder, stop_time=FAR_S, simulation={"real_time_factor": 1}, timeouts={"start": 60.0})
    if command == "run":
        gain = Path(__file__).parents[2] / "fmus" / "Gain.fmu"
        started = [place.start("run", gain, "--name", "pair", "--listen", "tcp/127.0.0.1:0")]
    else:
        started = [place.start(command, config, "--listen", "tcp/127.0.0.1:0")]
    if command == "master":
        started += [place.start("node", config, name) for name in ("pendulum", "delay")]

    endpoint = endpoint_of(started[0])

    assert re.fullmatch(r"tcp/127\.0\.0\.1:\d+", endpoint)
    # The door for row streams is closed when all have met, and share memory.
    wait_until(lambda: ports(place) == [endpoint.removeprefix("tcp/")], "a mesh with one port")
    socket, *others = place.note().endpoints
    assert socket.startswith("unixsock-stream/")
    assert others == [endpoint]
    if command != "run":
        assert value_of_angle(endpoint) != 0.0
    warning = "--listen tcp/127.0.0.1:0: every user of this host can set values at tcp/127.0.0.1:0"
    assert started[0].errors.count(warning) == started[0].errors.count("warning: ") == 1


def test_a_port_at_a_network_without_certificates_has_to_be_wanted(place: Place) -> None:
    config = write_config(place.folder, stop_time=FAR_S, simulation={"real_time_factor": 1})

    refused = place.run("launch", config, "--listen", "tcp/0.0.0.0:0")
    launched = running(place, "--listen", "tcp/0.0.0.0:0", "--insecure")

    assert refused.wait() == 2
    assert "--listen tcp/0.0.0.0:0: 'tcp/0.0.0.0:0' is open to everybody who can reach it; expected" in refused.errors
    assert "`fmu-mesh security init` begins" in refused.errors
    assert "`--insecure`" in refused.errors
    assert launched.errors.count("warning: ") == 1
    warning = "--listen tcp/0.0.0.0:0: whoever can reach this host at tcp/0.0.0.0:0 can read, set and end this mesh\n"
    assert warning in launched.errors


@pytest.mark.parametrize(
    ("endpoint", "leaves"),
    [
        ("unixsock-stream//run/user/1000/x.sock", False),
        ("tcp/127.0.0.1:7447", False),
        ("tcp/127.1.2.3:7447#iface=lo", False),
        ("udp/localhost:7447", False),
        ("tcp/[::1]:7447", False),
        ("tcp/[::]:7447", True),
        ("tcp/0.0.0.0:0", True),
        ("tls/192.168.1.2:7447", True),
        ("quic/robot.local:7447", True),
        ("serial//dev/ttyS0#baudrate=9600", True),
    ],
)
def test_what_leaves_the_host(endpoint: str, *, leaves: bool) -> None:
    assert leaves_host(endpoint) is leaves


_AS_MEMBER = """
import os, sys
import zenoh
os.setgroups([int(sys.argv[2])])
os.setgid({nobody})
os.setuid({nobody})
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5("connect/endpoints", '["unixsock-stream/%s"]' % sys.argv[1])
with zenoh.open(config) as session:
    [reply] = session.get("fmu_mesh/pair/delay/out/y")
    print(reply.ok.payload.to_string())
"""


@pytest.mark.skipif(os.getuid() != 0, reason="only root can become another user")
def test_members_of_a_group_reach_a_mesh_shared_with_them(place: Place) -> None:
    group = next(own for own in grp.getgrall() if own.gr_gid not in (0, NOBODY))
    launched = running(place, "--set-config", f"runtime.share_with={group.gr_name}")
    path = place.note().endpoints[1].partition("/")[2]
    for folder in (place.folder, place.folder / "tmp"):  # above that of the group
        folder.chmod(0o755)

    def tried(program: str, number: int) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", program.format(nobody=NOBODY), path, str(number)]
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=DEADLINE_S)

    assert math.isfinite(float(tried(_AS_MEMBER, group.gr_gid).stdout))
    assert "PermissionError" in tried(_AS_NOBODY, NOBODY).stderr
    assert f"the members of the group '{group.gr_name}' are trusted as you are" in launched.errors
    assert Path(path).parent.stat().st_mode & 0o777 == 0o750
    assert place.run("stop").wait() == 0
    launched.wait()
    assert not Path(path).parent.exists()


def test_a_group_that_is_not_there_is_a_finding(place: Place) -> None:
    checked = place.run("check", write_config(place.folder), "--set-config", "runtime.share_with=nobody-has-this")

    assert checked.wait() == 2
    assert "runtime.share_with=nobody-has-this: there is no group 'nobody-has-this' on this host" in checked.message


# --- the runtime folder


@pytest.fixture
def chosen(place: Place, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that FMU_MESH_RUNTIME_DIR names; it is not there."""
    folder = place.folder / "chosen"
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(folder))
    return folder


def test_the_runtime_folder_is_made_for_its_user_alone_whatever_the_umask(chosen: Path) -> None:
    before = os.umask(0)
    try:
        folders = [runtime_folder(), run_folder("pair", "1")]
    finally:
        os.umask(before)

    assert folders == [chosen, chosen / "pair.1"]
    assert [stat.S_IMODE(folder.stat().st_mode) for folder in folders] == [0o700, 0o700]


def open_to_others(folder: Path) -> None:
    folder.mkdir()
    folder.chmod(0o755)


def somebody_elses(folder: Path) -> None:
    if os.getuid() != 0:
        pytest.skip("only root can give a folder away")
    folder.mkdir(mode=0o700)
    os.chown(folder, NOBODY, NOBODY)


def planted_link(folder: Path) -> None:
    elsewhere = folder.with_name("elsewhere")
    elsewhere.mkdir(mode=0o700)
    folder.symlink_to(elsewhere)


def file_instead(folder: Path) -> None:
    folder.touch()


@pytest.mark.parametrize("level", ["runtime folder", "folder of a run"])
@pytest.mark.parametrize(
    ("make", "said"),
    [
        (open_to_others, "is open to other users (mode 0755). Close it with `chmod 700 {folder}`"),
        (somebody_elses, "belongs to another user. Set FMU_MESH_RUNTIME_DIR"),
        (planted_link, "is a symbolic link. Set FMU_MESH_RUNTIME_DIR"),
        (file_instead, "is no folder. Set FMU_MESH_RUNTIME_DIR"),
    ],
)
def test_a_runtime_folder_that_others_get_into_is_refused(
    chosen: Path, make: Callable[[Path], None], said: str, level: str
) -> None:
    folder = chosen if level == "runtime folder" else runtime_folder() / "pair.1"
    make(folder)

    with pytest.raises(ConfigurationError) as caught:
        run_folder("pair", "1")

    assert said.format(folder=folder) in str(caught.value)
    assert f"the runtime folder '{folder}'" in str(caught.value)


def test_a_mesh_is_not_launched_there(place: Place) -> None:
    (place.folder / "run").mkdir(mode=0o755)
    (place.folder / "run").chmod(0o755)

    launched = place.run("launch", write_config(place.folder))

    assert launched.wait() == 2
    assert "is open to other users" in launched.message


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a folder away")
def test_the_folder_of_another_user_after_su_is_not_used(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    theirs = place.folder / "theirs"
    theirs.mkdir(mode=0o700)
    os.chown(theirs, NOBODY, NOBODY)
    monkeypatch.delenv("FMU_MESH_RUNTIME_DIR", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(theirs))
    monkeypatch.setattr("tempfile.tempdir", str(place.folder))

    assert runtime_folder() == place.folder / f"fmu_mesh-{os.getuid()}"
    assert list(theirs.iterdir()) == []


def test_the_socket_of_a_relative_runtime_folder_can_be_reached_from_anywhere(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(place.folder)
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", "here")

    assert runtime_folder() == place.folder / "here"
