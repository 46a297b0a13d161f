"""The burst in many threads or processes over one memory: `nodes.c`, which has `burst.c` in it.

``FMU_MESH_BURST_SECONDS`` is how long each job runs; without it 1 s. `.ci/long tsan` runs them for longer.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

HERE = Path(__file__).parent
EQUATIONS = HERE.parents[1] / "fmu_mesh/rings/model_exchange.c"  # which `burst.c` calls
BURST = HERE.parents[1] / "fmu_mesh/rings/burst.c"
SECONDS = int(os.environ.get("FMU_MESH_BURST_SECONDS", "1"))
SANITIZERS = {"": ["-O2"], "thread": ["-O1", "-g"], "address,undefined": ["-O1", "-g", "-fno-sanitize-recover=all"]}

Job = tuple[str, int, int]
"""Shape, number of nodes, and window."""
JOBS: list[Job] = [
    ("chain", 2, 1),
    ("chain", 3, 512),
    ("chain", 8, 64),
    ("cycle", 2, 64),
    ("jacobi", 4, 3),
    ("cycle", 4, 2),
    ("cycle", 8, 1),
]

Build = Callable[[str, Path], Path]


@pytest.fixture(scope="module")
def build(tmp_path_factory: pytest.TempPathFactory) -> Build:
    """Builds `nodes.c` with a sanitizer, and with a text of `burst.c`; each only once."""
    compiler = shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        pytest.skip("there is no C compiler")
    built: dict[tuple[str, Path], Path] = {}

    def build(sanitizer: str, burst: Path) -> Path:
        if (sanitizer, burst) not in built:
            program = tmp_path_factory.mktemp("nodes") / "nodes"
            options = [*SANITIZERS[sanitizer], *([f"-fsanitize={sanitizer}"] if sanitizer else [])]
            options += [f'-DBURST="{burst}"', f"-I{BURST.parent}"]  # a changed copy includes the header of the original
            command = [compiler, "-std=c11", "-ffp-contract=off", "-pthread", *options]
            made = subprocess.run(
                [*command, HERE / "nodes.c", EQUATIONS, "-o", program, "-lm"],
                capture_output=True,
                text=True,
                check=False,
            )
            if sanitizer and "cannot find" in made.stderr:
                pytest.skip(f"the compiler has no -fsanitize={sanitizer}")
            assert made.returncode == 0, made.stderr
            built[sanitizer, burst] = program
        return built[sanitizer, burst]

    return build


def run(program: Path, job: Job, points: int, mode: str, seconds: int = SECONDS) -> subprocess.CompletedProcess[str]:
    command = [str(program), *map(str, job), str(points), str(seconds), mode]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=seconds + 150)


@pytest.mark.parametrize("mode", ["quiet", "disturbed", "streamed", "cut"])
@pytest.mark.parametrize("job", JOBS, ids=str)
def test_every_float_equals_a_plain_loop_and_no_wake_up_is_lost(build: Build, job: Job, mode: str) -> None:
    done = run(build("", BURST), job, 500, mode)

    assert done.returncode == 0, done.stdout + done.stderr
    assert " late 0 wrong 0 " in done.stdout
    assert (
        mode not in {"disturbed", "cut"} or int(done.stdout.split()[-1]) > 0
    )  # pauses, of which nobody was beyond one; or cuts


@pytest.mark.parametrize("mode", ["disturbed", "streamed", "cut"])
@pytest.mark.parametrize("sanitizer", ["thread", "address,undefined"])
@pytest.mark.parametrize("job", JOBS, ids=str)
def test_a_sanitizer_finds_nothing(build: Build, job: Job, sanitizer: str, mode: str) -> None:
    done = run(build(sanitizer, BURST), job, 200, mode)

    assert done.returncode == 0, done.stdout + done.stderr
    assert " wrong 0 " in done.stdout
    assert not done.stderr


@pytest.mark.parametrize("job", [("chain", 3, 4), ("cycle", 3, 4)], ids=str)
def test_processes_stopped_or_killed_at_any_moment_resume_at_their_rings_end(build: Build, job: Job) -> None:
    done = run(build("", BURST), job, 20_000, "killed")

    assert done.returncode == 0, done.stdout + done.stderr
    assert int(done.stdout.split()[-1]) >= 20


@pytest.mark.parametrize("sanitizer", ["", "address,undefined"])
@pytest.mark.parametrize("job", [("chain", 2, 1), ("chain", 4, 4), ("cycle", 4, 4)], ids=str)
def test_a_forged_counter_ends_the_run_and_leaves_no_wrong_row(build: Build, job: Job, sanitizer: str) -> None:
    done = run(build(sanitizer, BURST), job, 20_000, "forged")

    assert done.returncode == 0, done.stdout + done.stderr
    assert " wrong 0 " in done.stdout
    assert int(done.stdout.split()[-1]) > 0


def changed(folder: Path, *lines: tuple[str, str]) -> Path:
    """A copy of `burst.c`, and of the header that it includes, with other lines."""
    texts = {name: BURST.with_name(name).read_text() for name in ("burst.c", "counters.h")}
    for old, new in lines:
        assert sum(text.count(old) for text in texts.values()) == 1
        texts = {name: text.replace(old, new) for name, text in texts.items()}
    for name, text in texts.items():
        (folder / name).write_text(text)
    return folder / "burst.c"


def test_a_node_that_claims_nothing_would_be_found_beyond_a_pause(build: Build, tmp_path: Path) -> None:
    line = "atomic_store_explicit(&node->progress->claimed, claimed, memory_order_relaxed);"
    burst = changed(tmp_path, (line, ""))

    done = run(build("", burst), ("chain", 2, 1), 500, "disturbed")

    assert done.returncode == 1
    assert " overrun 0 " not in done.stdout


def test_a_lost_wake_up_would_be_found(build: Build, tmp_path: Path) -> None:
    burst = changed(tmp_path, ("ring(&place->bells[process]);", "(void)process;"))

    done = run(build("", burst), ("cycle", 4, 2), 3, "quiet")

    assert done.returncode == 1
    assert " late 0 " not in done.stdout


def test_a_race_would_be_found(build: Build, tmp_path: Path) -> None:
    line = "atomic_store_explicit(&counter->value, value, memory_order_release);\n  wake_if_needed"
    burst = changed(tmp_path, (line, line.replace("release", "relaxed")))

    done = run(build("thread", burst), ("chain", 2, 4), 2000, "quiet")

    assert "WARNING: ThreadSanitizer: data race" in done.stderr


def test_a_wrong_row_would_be_found(build: Build, tmp_path: Path) -> None:
    burst = changed(
        tmp_path,
        ("memory_order_acquire) != row + 1)", "memory_order_acquire) < 0)"),
        ("if (!gates_held(member)) {", "if (0) {"),
    )

    done = run(build("", burst), ("chain", 2, 1), 20_000, "forged")

    assert done.returncode == 1
    assert " wrong 0 " not in done.stdout
