"""Writes the bag that `fit.py` reads: the angles of a pendulum, as a robot publishes those of its joints.

The pendulum is simulated with a damping and a length that the fit does not know, and its sensor has noise. Replace the
bag by one of your own robot. From the root of the repository:

    python examples/calibration/measure.py --output results/measured.mcap
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import fmu_mesh

DAMPING, LENGTH = 0.17, 1.23
"""1/s, m."""

NOISE = 0.03
"""Standard deviation of the sensor in rad."""

RATE = 50.0
"""Messages per second; they do not lie at the points of the mesh."""

BEGIN = 1_700_000_000_000_000_000
"""Unix time of the first message in ns."""

Array = NDArray[np.float64]


def main() -> None:
    """Measure, and write the bag."""
    parser = argparse.ArgumentParser(description="Write a bag with the angles of a pendulum.")
    parser.add_argument("--output", type=Path, default=Path("results/measured.mcap"))
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    times, angles = measured(options.seed)
    write(options.output, times, angles)
    print(f"{options.output}: {len(times)} messages")


def measured(seed: int) -> tuple[Array, Array]:
    """Times in s after the start, and angles in rad with noise."""
    mesh = fmu_mesh.load(Path(__file__).with_name("pendulum.yaml"))
    start_values = {"pendulum.d": DAMPING, "pendulum.l": LENGTH}
    result = mesh.run(processes=False, record="memory", start_values=start_values)
    random = np.random.default_rng(seed)
    times = np.arange(0.0, result.times[-1], 1.0 / RATE)
    times[1:] += random.uniform(0.0, 0.5 / RATE, len(times) - 1)  # a sensor is not quite regular
    angles = np.interp(times, result.times, result["pendulum.a"]) + random.normal(0.0, NOISE, len(times))
    return times, angles


def write(path: Path, times: Array, angles: Array) -> None:
    """Write one `sensor_msgs/msg/JointState` for each time, in the format of `ros2 bag`."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    state, header, stamp = (
        store.types[name]
        for name in ("sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    nothing = np.zeros(0)
    with TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            topic = writer.add_connection("/joint_states", state.__msgtype__, typestore=store)
            for time, angle in zip(times, angles, strict=True):
                at = BEGIN + round(time * 1e9)
                head = header(stamp(*divmod(at, 10**9)), "base")
                message = state(head, ["pendulum"], np.array([angle]), nothing, nothing)
                writer.write(topic, at, store.serialize_cdr(message, state.__msgtype__))
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(next(bag.glob("*.mcap")), path)


if __name__ == "__main__":
    main()
