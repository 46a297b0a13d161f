"""Two FMUs in one Python program: a damped pendulum, and a delay that repeats its angle 5.5 s later.

The library example of the book chapter on `fmi_adapter`, with `fmu_mesh.FMIAdapter`. It gives the same floats as
`fmu-mesh launch configs/chapter_library_example.yaml`, where each FMU has a process of its own.
"""

from __future__ import annotations

import argparse
import csv
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Event

from fmu_mesh import FMIAdapter

ROOT = Path(__file__).resolve().parents[1]
STEP_SIZE = 0.02  # s


def timer(start: float, duration: float, stop: Event | None) -> Iterator[float]:
    """The times of all steps after ``start``, at once; or, with an event that can stop it, when each is due."""
    for k in range(1, round(duration / STEP_SIZE) + 1):
        expected = start + k * STEP_SIZE
        if stop is not None and stop.wait(max(0.0, expected - time.time())):
            return
        yield expected


def run(start: float = 0.0, duration: float = 60.0, stop: Event | None = None) -> list[tuple[float, float, float]]:
    """Run from ``start`` for ``duration`` (s); return rows of the time since then, angle and delayed angle (rad)."""
    fmus = ROOT / "fmus"
    with (
        FMIAdapter(fmus / "DampedPendulum.fmu", STEP_SIZE) as pendulum,
        FMIAdapter(fmus / "TransportDelay.fmu", STEP_SIZE) as delay,
    ):
        pendulum.set_initial_value("d", 0.001)
        pendulum.set_initial_value("l", 2.0)
        delay.set_initial_value("d", 5.5)

        pendulum.set_initial_value("a", 1.3)
        delay.set_initial_value("x", pendulum.get_output_value("a"))

        pendulum.exit_initialization_mode(start)
        delay.exit_initialization_mode(start)
        rows = [(0.0, float(pendulum.get_output_value("a")), float(delay.get_output_value("y")))]

        for k, expected in enumerate(timer(start, duration, stop), start=1):
            pendulum.do_steps_until(expected)
            angle = float(pendulum.get_output_value("a"))
            # Inputs are read where a step starts: stamped `expected`, the angle would reach the delay one step late.
            delay.set_input_value("x", delay.simulation_time, angle)
            delay.do_steps_until(expected)
            rows.append((k * STEP_SIZE, angle, float(delay.get_output_value("y"))))
    return rows


def main(arguments: list[str] | None = None) -> None:
    """Run, write the result and print its last row."""
    parser = argparse.ArgumentParser(description="A damped pendulum and a delay of its angle, in one program.")
    parser.add_argument("--duration", type=float, default=60.0, help="simulated time in s (default: 60)")
    parser.add_argument("--real-time", action="store_true", help="one second per second, on the system's clock")
    parser.add_argument("--output", type=Path, default=ROOT / "results" / "integrated_node.csv", help="the result file")
    options = parser.parse_args(arguments)

    if options.real_time:
        stop = Event()  # Ctrl-C or a SIGTERM ends the loop, and what there is so far is written
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stop.set())
        rows = run(time.time(), options.duration, stop)
    else:
        rows = run(duration=options.duration)

    options.output.parent.mkdir(parents=True, exist_ok=True)
    with options.output.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["time", "pendulum.a", "delay.y"])
        writer.writerows(rows)
    seconds, angle, delayed_angle = rows[-1]
    print(f"t = {seconds:g} s: angle {angle:.6f} rad, delayed angle {delayed_angle:.6f} rad")
    print(f"Result: {options.output}")


if __name__ == "__main__":
    main()
