"""`ulimit -v`: words that name the limit and the way out, before a library fails inside; and what is enough."""

from __future__ import annotations

import errno
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from fmu_mesh.run.limits import FEWEST_MIB, needed_mib, out_of_memory
from tests.helpers import DEADLINE_S

CONFIG = Path(__file__).parents[2] / "configs" / "pendulum_delay.yaml"

pytestmark = pytest.mark.skipif(shutil.which("prlimit") is None, reason="needs prlimit")


def limited(mib: int, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the command ``fmu-mesh`` with that much address space for each process."""
    command = ["prlimit", f"--as={mib << 20}", sys.executable, "-m", "fmu_mesh", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=DEADLINE_S)


@pytest.mark.parametrize(
    ("mib", "arguments"),
    [
        (40, ("check", CONFIG)),
        (140, ("--version",)),
        (380, ("launch", CONFIG)),
        (380, ("launch", CONFIG, "--local")),
        (950, ("launch", CONFIG)),
        (1430, ("launch", CONFIG)),
        (1430, ("node", CONFIG, "pendulum")),
        (1430, ("master", CONFIG)),
        (700, ("ls",)),
    ],
    ids=lambda value: str(value) if isinstance(value, int) else " ".join(map(str, value[::2])),
)
def test_too_little_address_space_is_told_with_the_limit_and_way_out(
    mib: int, arguments: tuple[str | Path, ...]
) -> None:
    done = limited(mib, *arguments)

    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("fmu-mesh: the address space of a process is limited to ")
    assert f"here (`ulimit -v {mib << 10}`), and this command needs " in done.stderr
    assert "Raise the limit with `ulimit -v unlimited`" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("options", [(), ("--local",)], ids=["processes", "local"])
def test_what_is_said_to_be_enough_address_space_is(options: tuple[str, ...], tmp_path: Path) -> None:
    result = tmp_path / "result.csv"

    done = limited(needed_mib("launch", local=bool(options)), "launch", CONFIG, *options, "--output", result)

    assert done.returncode == 0, done.stderr
    assert result.read_bytes().count(b"\n") == 20002


def test_what_a_look_at_a_configuration_needs_is_enough_for_it() -> None:
    assert limited(FEWEST_MIB, "check", CONFIG).returncode == 0


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
        RuntimeError("can't start new thread"),
        ImportError("libopenjp2.so: failed to map segment from shared object"),
    ],
)
def test_an_error_that_comes_of_too_little_memory_is_told_as_such(error: Exception) -> None:
    problem = out_of_memory(error)

    assert problem is not None
    assert str(problem) == "there is not enough memory for this on this host"
    assert out_of_memory(RuntimeError("something else")) is None
