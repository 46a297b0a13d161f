"""The interfaces that ROS's own generator builds here: other processes use them, and their hashes are those of ROS."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.helpers import DEADLINE_S
from tests.ros.ros_peer import Ros, built_types_or_skip, ros_or_skip

ros_or_skip()
BUILT = built_types_or_skip()

SERVER = """
import rclpy
from simulation_interfaces.srv import StepSimulation

def step(request, response):
    response.result.result, response.result.error_message = response.result.RESULT_OK, f"{request.steps} steps"
    return response

rclpy.init()
node = rclpy.create_node("simulator")
node.create_service(StepSimulation, "step_simulation", step)
rclpy.spin(node)
"""


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[Ros]:
    with Ros(tmp_path / "log") as ros:
        yield ros


def test_another_process_answers_a_service_of_simulation_interfaces(ros: Ros) -> None:
    from simulation_interfaces.srv import StepSimulation  # noqa: PLC0415 only where it is built

    client = ros.peer("client").create_client(StepSimulation, "/step_simulation")
    environment = {**os.environ, **ros.environment, **BUILT}
    server = subprocess.Popen([sys.executable, "-c", SERVER], env=environment)
    try:
        answer = ros.called(client, StepSimulation.Request())
    finally:
        server.kill()
        server.wait(DEADLINE_S)

    assert answer.result.error_message == "1 steps"  # the default of the request is 1
    assert answer.result.result == answer.result.RESULT_OK


def test_the_hash_of_a_transform_message_is_that_of_rosbags() -> None:
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 an extra

    built = Path(BUILT["LD_LIBRARY_PATH"].split(os.pathsep)[0]).parent
    description: Any = json.loads((built / "share/tf2_msgs/msg/TFMessage.json").read_text(encoding="utf-8"))
    hashes = {entry["type_name"]: entry["hash_string"] for entry in description["type_hashes"]}

    assert hashes["tf2_msgs/msg/TFMessage"] == get_typestore(Stores.ROS2_KILTED).hash_rihs01("tf2_msgs/msg/TFMessage")
