"""The end of a process whose Zenoh threads could come back into a Python that finalizes itself."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import atexit, sys
from fmu_mesh.wire.last_exit import LastExit

class Finalized:
    def __del__(self):
        print("finalized", flush=True)

last_exit = LastExit()
kept = Finalized()
atexit.register(print, "called at the exit")
{load}
sys.stdout.write("written\\n")
sys.exit(last_exit.with_code(3))
"""


@pytest.mark.parametrize(
    ("load", "lines"),
    [
        ("import zenoh", ["written", "called at the exit"]),
        ("", ["written", "called at the exit", "finalized"]),
    ],
    ids=["with Zenoh", "without"],
)
def test_a_process_with_zenoh_ends_before_python_finalizes_itself(load: str, lines: list[str]) -> None:
    ended = subprocess.run(
        [sys.executable, "-c", PROGRAM.format(load=load)], capture_output=True, text=True, timeout=60, check=False
    )

    assert ended.stdout.splitlines() == lines
    assert (ended.returncode, ended.stderr) == (3, "")
