"""Every YAML, shell and Python block of every page runs, or its page says why not.

The blocks of a page run in order, in a folder that looks like a clone: what one of them writes or starts is there for
the next one. Numbers in the output of a run differ from machine to machine and are not compared; the words are.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import os
import re
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, Self
from unittest import mock
from xml.etree import ElementTree as ET

import pytest
import yaml
import zenoh

from fmu_mesh.config.findings import Findings
from fmu_mesh.config.yaml_text import read
from tests.helpers import Launched, Place, wait_until
from tests.pages.blocks import LANGUAGES, PAGES, ROOT, Block, Command, blocks_of
from tests.ros.ros_peer import environment

BLOCKS = {str(page.relative_to(ROOT)): blocks_of(page) for page in PAGES}

MODEL_EXCHANGE = "docs/model-exchange-and-events.md"
WHOLE: dict[str, dict[str, str]] = {
    "docs/bags.md": {"pendulum": "DampedPendulum", "delay": "TransportDelay"},
    "docs/connections.md": {
        "pendulum": "DampedPendulum",
        "gain": "Gain",
        "motor": "SimpleElectricalActuator",
        "vehicle": "ActiveShuttle",
    },
    "docs/live-data.md": {"pump": "Gain", "tank": "Integrator"},
    MODEL_EXCHANGE: {"gain": "Gain", "oscillator": "oscillator"},
    "docs/ros.md": {
        "pendulum": "DampedPendulum",
        "delay": "TransportDelay",
        "gain": "Gain",
        "path_filter": "PathFilter",
    },
}
"""Instances, by their FMUs, of the file that the fragments of a page are part of."""

UNTIL_CTRL_C = re.compile(r"fmu-mesh (foxglove|top|watch (?!.*--count))")
SOCKET = re.compile(r"unixsock-stream//run/user/\d+/fmu_mesh/\w+\.[\w-]+/\w+\.sock")


class PageRun:
    """A folder that looks like a clone, in which the blocks of one page run.

    Use it as a context manager: what goes on in the background is interrupted at its end, and has to end well.
    """

    def __init__(self, page: str, place: Place) -> None:
        self._page = page
        self._place = place
        self._folder = place.folder
        self._exports = ""
        self._meanwhile: list[Launched] = []
        self._names: dict[str, object] = {"__name__": "__main__"}
        self._printed = io.StringIO()
        for name in ("configs", "examples", "fmus"):
            shutil.copytree(ROOT / name, self._folder / name)
        (self._folder / ".venv").symlink_to(sys.prefix)
        for block in (block for blocks in BLOCKS.values() for block in blocks if block.note == "file"):
            # A reader is through with the page in this minute of real time; a busy machine may not be.
            text = block.text.replace("stop_time: 60,", "stop_time: 600,")
            (self._folder / block.detail).write_text(text, encoding="utf-8")

    def __enter__(self) -> Self:
        self._here = contextlib.ExitStack()
        self._here.enter_context(contextlib.redirect_stdout(self._printed))
        own = {name: self._place.environment[name] for name in ("FMU_MESH_RUNTIME_DIR", "TMPDIR")}
        self._here.enter_context(mock.patch.dict(os.environ, own))
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        self._here.close()
        for session in (value for value in self._names.values() if isinstance(value, zenoh.Session)):
            session.close()
        for process in self._meanwhile:
            if process.running:
                process.signal(signal.SIGINT)
            code = process.wait()
            # The signal itself ends a program that is through with all of its own.
            assert kind is not None or code in {0, 130, -signal.SIGINT}, process.story()
            assert kind is not None or "Traceback" not in process.errors, process.story()

    def run(self, block: Block, shown: str | None) -> None:
        """Run a block; ``shown`` is what the page shows as its output."""
        match block.language:
            case "yaml":
                self._run_yaml(block)
            case "sh" | "console":
                for command in block.commands(shown):
                    self._run_command(command, in_background=block.note == "meanwhile")
            case "python" if block.note == "needs":  # a program of its own
                (self._folder / "program.py").write_text(block.text, encoding="utf-8")
                self._run_command(Command("python3 program.py"), in_background=False)
            case "python":
                self._run_python(block, shown)
            case "json":
                json.loads(block.text)
            case "xml":
                ET.fromstring(block.text)  # noqa: S314 our own page

    def _run_yaml(self, block: Block) -> None:
        content: Any = read(block.text, Findings(block.place), {})  # YAML 1.2: `on` is a key
        if not content.keys() & {"instances", "connections", "record", "ros"}:
            return  # a file for somebody else, such as parameters of a ROS node, which a command of the page names
        if "mesh" not in content:
            instances = {name: {"fmu": f"../fmus/{fmu}.fmu"} for name, fmu in WHOLE.get(self._page, {}).items()}
            frame = {"mesh": "block", "simulation": {"stop_time": 0.1, "step_size": 0.002}}
            content = frame | content | {"instances": instances | content.get("instances", {})}
        file = self._folder / (block.detail if block.note == "file" else "configs/block.yaml")
        if block.note != "file":
            file.write_text(yaml.safe_dump(content), encoding="utf-8")
        launch = "launch --local --no-progress --real-time-factor 0"
        if "real_time_factor" in content.get("simulation", {}):
            launch += " --stop-time 2"  # a reader watches this run, and ends it
        if "process" in content:
            launch = launch.replace(" --local", "")  # one process for all has no limits
        ends = [one for one in content.get("connections", ()) if isinstance(one, dict)]
        fed = any("key" in one and "to" in one for one in ends)  # one process has no Zenoh
        for words in ("check",) if fed else ("check", launch):
            command = f"{self._exports}fmu-mesh {words} {file}"
            done = self._place.start_command(["bash", "-euo", "pipefail", "-c", command])
            assert done.wait() == 0, f"{block.place}\n{done.story()}"
            assert "grows by a factor" not in done.output, done.story()

    def _run_command(self, command: Command, *, in_background: bool) -> None:
        line = command.line.removesuffix("&").rstrip()
        if line.startswith("export "):
            self._exports += f"{line}\n"
            return
        process = self._place.start_command(["bash", "-euo", "pipefail", "-c", self._exports + line])
        if in_background or command.line.endswith("&"):
            self._meanwhile.append(process)
            said = f"something that '{line}' tells"
            wait_until(lambda: process.errors or process.output or not process.running, said)
            return
        if UNTIL_CTRL_C.match(line):
            wait_until(lambda: process.output or not process.running, f"something that '{line}' shows")
            process.signal(signal.SIGINT)
        code = process.wait()
        refused = any(text.startswith("fmu-mesh: ") for text in command.output)
        assert (code in {0, 130}) == (not refused), process.story()
        missing = {*masked("\n".join(command.output))} - {*masked(process.output + process.errors)}
        assert not missing, f"{missing} is not in\n{process.story()}"

    def _run_python(self, block: Block, shown: str | None) -> None:
        running = any(process.running for process in self._meanwhile)
        code = SOCKET.sub(lambda _: self._place.note().endpoints[0], block.text)
        before = len(self._printed.getvalue())
        with contextlib.chdir(self._folder):
            exec(compile(code, block.place, "exec"), self._names)  # noqa: S102 our own page
        if shown is None:
            return
        if running:
            what = f"{block.place} prints what the page shows"
            wait_until(lambda: {*masked(shown)} <= {*masked(self._printed.getvalue()[before:])}, what)
        else:
            printed = self._printed.getvalue()[before:]
            assert [line.rstrip() for line in printed.splitlines()] == shown.splitlines()


def masked(text: str) -> list[str]:
    """The lines of an output without what differs from run to run: numbers, tokens, and columns."""
    text = re.sub(r"unixsock-stream/\S+", "SOCKET", text)
    text = re.sub(r"token(=|%3D)[\w-]{32}", "TOKEN", text)
    text = re.sub(r"-?\d+(\.\d+)?(e[-+]?\d+)?\b", "#", text)
    return [" ".join(line.split()) for line in text.splitlines() if line.strip()]


@pytest.fixture
def folder_of_a_clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Place]:
    """A place for processes where `fmu-mesh` and `python3` are ours, as in a terminal with the environment active."""
    for name, value in environment(tmp_path).items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    with Place() as place:
        yield place


@pytest.mark.parametrize("page", [page for page, blocks in BLOCKS.items() if blocks])
def test_the_blocks_of_a_page_run_as_they_are_shown(
    page: str, folder_of_a_clone: Place, event_fmu: Callable[..., Path]
) -> None:
    blocks = [block for block in BLOCKS[page] if block.note != "not run"]
    with PageRun(page, folder_of_a_clone) as run:
        if page == MODEL_EXCHANGE:
            for name in ("Ball", "Oscillator"):
                shutil.copy(event_fmu(name, 2), folder_of_a_clone.folder / "fmus" / f"{name.lower()}.fmu")
        for block, after in pairwise([*blocks, None]):
            assert block is not None
            if block.note == "needs" and not (importlib.util.find_spec(block.detail) or shutil.which(block.detail)):
                continue
            run.run(block, after.text if after is not None and after.language == "text" else None)


def test_every_block_says_what_it_is_and_every_note_belongs_to_one() -> None:
    unknown = [block.place for blocks in BLOCKS.values() for block in blocks if block.language not in LANGUAGES]
    notes = {page: (ROOT / page).read_text(encoding="utf-8") for page in BLOCKS}
    lost = [
        page
        for page, text in notes.items()
        if len(re.findall(r"^<!-- (?:not run|needs|meanwhile|file)", text, re.MULTILINE))
        != sum(block.note is not None for block in BLOCKS[page])
    ]

    assert unknown == []
    assert lost == []


def test_these_blocks_are_not_run_and_say_why() -> None:
    not_run = [
        (block.place.partition(":")[0], block.text.splitlines()[0].partition("  ")[0], block.detail)
        for blocks in BLOCKS.values()
        for block in blocks
        if block.note == "not run"
    ]

    assert not_run == NOT_RUN


def test_what_runs_instead_of_a_block_exists() -> None:
    named = {name for _, _, reason in NOT_RUN for name in re.findall(r"tests/[\w/]+\.py|\.ci/\w+", reason)}

    assert named
    assert [name for name in sorted(named) if not (ROOT / name).is_file()] == []


NOT_RUN = [
    ("README.md", "make demo", ".ci/run runs both; this test is part of the second"),
    (
        "README.md",
        "fmu-mesh master CONFIG --connect tcp/router:7447 --insecure",
        "CONFIG and router are yours; tests/hosts/test_hosts_page.py types them on two hosts",
    ),
    ("bridges/ros2dds/README.md", "./build", ".ci/long builds it, and tests/ros/test_bridge.py runs it"),
    ("bridges/zenoh/README.md", "./build", ".ci/long builds it, and tests/mqtt/test_mqtt_and_http.py runs it"),
    (
        "docs/commands.md",
        "$ fmu-mesh launch configs/pendulum_delay.yaml --real-time-factor 1 --restarts 3",
        "somebody kills a process there; tests/faults/test_restarting.py does",
    ),
    (
        "docs/connections.md",
        "connections:",
        "the two FMUs are yours; tests/equivalence/test_maps.py runs such connections",
    ),
    (
        "docs/dashboard.md",
        "fmu-mesh dashboard",
        "it serves until somebody ends it; tests/equivalence/test_dashboard_page.py opens the page in a browser",
    ),
    (
        "docs/digital-twin.md",
        "connections:",
        "tests/mqtt/test_digital_twin.py runs configs/pump_twin.yaml, which has these lines",
    ),
    (
        "docs/digital-twin.md",
        "fmu-mesh-zenoh-bridge bridges/zenoh/config.json5",
        "it needs the bridge; tests/mqtt/test_digital_twin.py runs it",
    ),
    (
        "docs/digital-twin.md",
        "fmu-mesh launch configs/pump_twin.yaml --listen tcp/127.0.0.1:7447 --no-progress",
        "it needs the bridge; tests/mqtt/test_digital_twin.py runs it",
    ),
    (
        "docs/digital-twin.md",
        "mosquitto_sub -v -t 'twin/#'",
        "it needs the bridge; tests/mqtt/test_digital_twin.py runs it",
    ),
    (
        "docs/digital-twin.md",
        "mosquitto_pub -q 1 -t plant/pump/speed -m '{\"rpm\": 2400}'",
        "it needs the bridge; tests/mqtt/test_digital_twin.py runs it",
    ),
    (
        "docs/digital-twin.md",
        "curl http://127.0.0.1:8000/fmu_mesh/pump_twin/pump/out/forecast",
        "it needs the bridge; tests/mqtt/test_digital_twin.py runs it",
    ),
    (
        "docs/digital-twin.md",
        "curl -N -H 'accept: text/event-stream' 'http://127.0.0.1:8000/twin/**'",
        "it needs the bridge; tests/mqtt/test_digital_twin.py runs it",
    ),
    (
        "docs/digital-twin.md",
        "fmu-mesh dashboard pump_twin",
        "it needs a running twin; tests/mqtt/test_digital_twin.py runs it",
    ),
    (
        "docs/digital-twin.md",
        "fmu-mesh stop pump_twin",
        "it needs the result of the story; tests/mqtt/test_digital_twin.py runs it",
    ),
    (
        "docs/digital-twin.md",
        "connections:",
        "it is a part; tests/mqtt/test_digital_twin.py runs it in a complete file",
    ),
    (
        "docs/digital-twin.md",
        "connections:",
        "it is a part; tests/mqtt/test_digital_twin.py runs it in a complete file",
    ),
    (
        "docs/digital-twin.md",
        "docker compose --file docker/twin.compose.yaml up --build",
        "there is no engine of containers here; tests/mqtt/test_twin_compose.py runs the commands of the services",
    ),
    (
        "docs/engines.md",
        "fmu-mesh security init lab",
        "the names of hosts are yours; tests/hosts/test_engines.py makes such folders",
    ),
    (
        "docs/engines.md",
        "fmu-mesh submit slurm configs/pendulum_delay.yaml --insecure --slurm-option=--partition=short",
        "it needs a Slurm cluster; tests/hosts/test_slurm_mesh.py runs it on one of two hosts",
    ),
    (
        "docs/engines.md",
        "docker build --file docker/Dockerfile --tag fmu-mesh .",
        "it needs Docker; tests/hosts/test_containers.py runs such a file with podman-compose",
    ),
    (
        "docs/engines.md",
        "fmu-mesh render kubernetes configs/pendulum_delay.yaml --security lab --claim lab-data -o mesh.yaml",
        "it needs a cluster",
    ),
    ("docs/fmi-support-protection.md", "process: {sandbox: wasm}", "it needs an FMU of your own"),
    (
        "docs/foxglove.md",
        "ssh -L 8765:127.0.0.1:8765 robot fmu-mesh foxglove",
        "robot is yours; tests/equivalence/test_foxglove.py connects to the port",
    ),
    (
        "docs/gazebo.md",
        "instances:",
        "it needs Gazebo classic 11; tests/physics/test_gazebo_classic.py runs such a file",
    ),
    (
        "docs/gazebo.md",
        "fmu-mesh launch examples/gazebo_fmi/simple_electrical_actuator.world",
        "it needs Gazebo classic 11; tests/physics/test_gazebo_classic.py runs these worlds",
    ),
    (
        "docs/gazebo.md",
        "make -C bridges/gazebo_classic",
        "it needs the headers of Gazebo classic 11; .ci/long builds it",
    ),
    (
        "docs/gazebo.md",
        "sudo bridges/gazebo_classic/setup.sh /opt/gazebo_classic",
        "it takes 15 minutes; .ci/long runs it",
    ),
    (
        "docs/hosts.md",
        "ssh user@lab2 python3 -m venv mesh",
        "it installs on a host of yours; tests/hosts/test_hosts_page.py types it on one of two hosts",
    ),
    (
        "docs/hosts.md",
        "ssh -o BatchMode=yes user@lab2 true",
        "lab2 is yours; tests/hosts/test_hosts_page.py types them on one of two hosts",
    ),
    (
        "docs/hosts.md",
        "$ fmu-mesh launch two_hosts.yaml --listen tcp/0.0.0.0:7447 --insecure",
        "two hosts are needed; tests/hosts/test_hosts_page.py has them",
    ),
    ("docs/installation.md", "pipx install '.[plot]'", "it installs into your home; .ci/run installs the same wheel"),
    (
        "docs/installation.md",
        "uv tool install '.[plot]'",
        "it installs into your home; .ci/run installs the same wheel",
    ),
    ("docs/installation.md", "python3 -m venv .my-venv", "it downloads 100 MB; .ci/run installs the same wheel"),
    (
        "docs/onnx.md",
        "import torch",
        "PyTorch is no requirement here; tests/unit/test_onnx.py reads models of this form",
    ),
    (
        "docs/onnx.md",
        "import jax.numpy as jnp",
        "JAX is no requirement here; tests/unit/test_onnx.py reads models of this form",
    ),
    (
        "docs/onnx.md",
        "from pathlib import Path",
        "scikit-learn is no requirement here; tests/unit/test_onnx.py reads models of this form",
    ),
    ("docs/performance.md", "make bench", "it takes 20 minutes, and figures of a busy machine mean nothing"),
    ("docs/performance.md", ".venv/bin/python -m benchmarks.chaos configs/pendulum_delay.yaml", "it takes minutes"),
    (
        "docs/performance.md",
        ".venv/bin/python -m benchmarks.far",
        "it needs root, and takes minutes; tests/faults/test_far_link.py runs it over one network",
    ),
    (
        "docs/performance.md",
        ".venv/bin/python -m benchmarks.live_data --parts clients --seconds 10 --repeat 1",
        "it takes an hour, and figures of a busy machine mean nothing",
    ),
    (
        "docs/performance.md",
        ".venv/bin/python -m benchmarks.tls",
        "it takes minutes; tests/security/test_locked_doors.py compares the floats",
    ),
    ("docs/performance.md", ".venv/bin/python -m benchmarks.over_ssh", "it takes minutes"),
    (
        "docs/performance.md",
        ".venv/bin/python -m benchmarks.floods --floods large stopped --repeat 1",
        "it takes half an hour, and figures of a busy machine mean nothing",
    ),
    (
        "docs/profiling.md",
        "$ pgrep -af '^fmu-mesh'",
        "it lists the processes of all meshes of this host; tests/faults/test_fork_server.py reads the titles",
    ),
    (
        "docs/profiling.md",
        "PID=$(pgrep -f '^fmu-mesh node pendulum$')",
        "it needs perf and gdb, and may need root; tests/faults/test_fork_server.py attaches py-spy",
    ),
    (
        "docs/recovery.md",
        "$ fmu-mesh launch plant.yaml",
        "the power is cut in between; tests/faults/test_resuming.py does that",
    ),
    (
        "docs/recovery.md",
        "#!/bin/sh",
        "it needs a Slurm cluster; tests/hosts/test_slurm_mesh.py runs it, and queues it again",
    ),
    (
        "docs/recovery.md",
        "fmu-mesh checkpoint plant --output at20s.state",
        "the mesh is yours; tests/property/test_branches.py does it with others",
    ),
    (
        "docs/recovery.md",
        "fmu-mesh launch plant.yaml --from at20s.state --replace pump --output results/other_pump.csv",
        "as above; tests/property/test_replacing.py does it",
    ),
    (
        "docs/ros-node.md",
        "source /opt/ros/jazzy/setup.bash",
        "it needs a ROS with its commands; tests/ros/test_node.py starts this node and switches it",
    ),
    (
        "docs/ros-node.md",
        "ros2 lifecycle set /fmi_adapter_node cleanup",
        "`ros2` is not on PyPI; tests/ros/test_gateway_lifecycle.py calls these services",
    ),
    (
        "docs/ros-package.md",
        "sudo apt install python3-venv python3-colcon-common-extensions",
        "it needs a ROS in /opt/ros; .ci/long ros builds the package with colcon from PyPI",
    ),
    ("docs/ros-package.md", "source /opt/ros/jazzy/setup.bash", "as above"),
    ("docs/ros-package.md", "source ~/ws/install/setup.bash", "as above"),
    (
        "docs/ros-package.md",
        "ros2 launch fmu_mesh_ros fmu.launch.py fmu_path:=fmus/DampedPendulum.fmu",
        "`ros2` is not on PyPI; tests/ros/test_package.py runs these files",
    ),
    (
        "docs/ros-package.md",
        "from fmu_mesh_ros.actions import Mesh, OnMeshReady",
        "`launch` is not on PyPI; tests/ros/test_package.py has these events",
    ),
    (
        "docs/ros-simulation.md",
        "$ ros2 service call /get_simulation_state simulation_interfaces/srv/GetSimulationState",
        "`ros2` is not on PyPI; tests/ros/test_simulation_interfaces.py calls these services",
    ),
    (
        "docs/ros-simulation.md",
        "mesh: controlled",
        "it needs a simulator; tests/ros/test_ros_simulator.py runs this file",
    ),
    (
        "docs/ros-simulation.md",
        "fmu-mesh router --listen tcp/127.0.0.1:7447",
        "they run at the same time; tests/ros/test_ros_simulator.py runs them",
    ),
    (
        "docs/ros-tutorial.md",
        "sudo apt install python3-venv",
        "it needs a ROS in /opt/ros; tests/ros/test_ros_tutorial.py runs the rest with rclpy from PyPI",
    ),
    ("docs/ros-tutorial.md", "source /opt/ros/jazzy/setup.bash", "as above"),
    (
        "docs/ros-tutorial.md",
        "rviz2 -d examples/ros/arm.rviz --ros-args -p use_sim_time:=true",
        "RViz is not on PyPI; tests/ros/test_ros_tutorial.py checks what it needs",
    ),
    (
        "docs/ros-tutorial.md",
        ('ros2 topic pub --once /joint_commands sensor_msgs/msg/JointState "{name: [joint2], position: [-0.5]}"'),
        "`ros2` is not on PyPI; tests/ros/test_ros_tutorial.py sends this message",
    ),
    ("docs/ros.md", "$ ros2 topic list", "`ros2` is not on PyPI; tests/ros/test_bridge.py looks with rclpy"),
    (
        "docs/ros.md",
        "$ fmu-mesh status pendulum_ros",
        "the run takes 2 s; tests/ros/test_link.py reads this line",
    ),
    ("docs/ros.md", "ROS", "needs two hosts; tests/ros/test_router_elsewhere.py has them"),
    (
        "docs/ros.md",
        "$ ros2 param get /pendulum_ros gain.k",
        "`ros2` is not on PyPI; tests/ros/test_rmw_zenoh.py calls these services",
    ),
    ("docs/ros2-control.md", "ros:", "it is a part; tests/ros/test_ros2_control.py runs the complete file"),
    (
        "docs/ros2-control.md",
        "ros2 launch fmu_mesh_ros mesh_and_gateway.launch.py config:=examples/ros/ros2_control_arm.yaml",
        "it needs a ROS with its commands; tests/ros/test_ros2_control.py starts both programs",
    ),
    (
        "docs/ros2-control.md",
        (
            "ros2 run controller_manager ros2_control_node --ros-args --params-file controllers.yaml "
            "-r ~/robot_description:=/robot_description"
        ),
        "ros2_control is not on PyPI",
    ),
    (
        "docs/sweeps.md",
        "fmu-mesh sweep configs/pendulum_delay.yaml --vary pendulum.d=0.05:0.8:16 --dask tcp://192.168.1.2:8786",
        "it needs a Dask cluster; tests/sweeps/test_dask.py starts one",
    ),
    (
        "docs/sweeps.md",
        (
            "fmu-mesh sweep configs/pendulum_delay.yaml --vary pendulum.d=0.05:0.8:256 --slurm --tasks 8 "
            "--slurm-option=--partition=short"
        ),
        "it needs a Slurm cluster; tests/sweeps/test_slurm.py runs it on one of two hosts",
    ),
    (
        "docs/windows_fmus.md",
        "$ sudo apt install wine",
        "it installs Wine; tests/wine/test_windows_meshes.py inspects such an FMU",
    ),
    (
        "examples/cart_pole/README.md",
        "python examples/cart_pole/train.py --output policy.onnx",
        "it takes a minute; tests/physics/test_cart_pole.py runs it with less training",
    ),
    (
        "examples/gazebo/README.md",
        "export PYTHONPATH=$PWD/examples/gazebo",
        "there is no package of gz-sim here; tests/equivalence/test_gazebo_example.py runs mesh_actuator.py",
    ),
    (
        "examples/ros/path_filter/README.md",
        "$ ros2 launch examples/ros/path_filter/path_filter.launch.py",
        "launch_ros is not on PyPI; tests/ros/test_launch_files.py starts what this file names",
    ),
]
"""All blocks that are not run: page, beginning, reason."""
