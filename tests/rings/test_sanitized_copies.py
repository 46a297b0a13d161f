"""Copies of a batch on several threads, through Python, with a library that a sanitizer looks into: also its solver."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from build_library import PACKAGE, SOURCES, manifest

PROGRAM = Path(__file__).with_name("copies_in_threads.py")
RUNTIMES = {"thread": "libtsan.so", "address,undefined": "libasan.so"}
REPORTED = 66
OPTIONS = f"exitcode={REPORTED}"


def sanitized(folder: Path, sanitizer: str, *lines: tuple[str, str]) -> dict[str, str]:
    """Builds the library with a sanitizer, and other lines in `burst.c`; the environment of a program that uses it."""
    gcc = shutil.which("gcc")
    if gcc is None:
        pytest.skip("there is no gcc")
    for name in SOURCES:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        text = (PACKAGE / name).read_text(encoding="utf-8")
        for old, new in lines if name == "rings/burst.c" else ():
            assert text.count(old) == 1, old
            text = text.replace(old, new)
        (folder / name).write_text(text, encoding="utf-8")
    digests = "".join(f'  "{line}\\n"\n' for line in manifest().splitlines())
    (folder / "sources.c").write_text(f"const char fmu_mesh_sources[] =\n{digests};\n", encoding="utf-8")
    code = [name for name in SOURCES if name.endswith(".c")] + ["sources.c"]
    options = ["-std=c11", "-O1", "-g", "-ffp-contract=off", "-fPIC", "-shared", "-pthread", f"-fsanitize={sanitizer}"]
    made = subprocess.run(
        [gcc, *options, *code, "-o", "library.so", "-lm"], cwd=folder, capture_output=True, text=True, check=False
    )
    runtime = subprocess.run(
        [gcc, f"-print-file-name={RUNTIMES[sanitizer]}"], capture_output=True, text=True, check=True
    ).stdout.strip()
    if not Path(runtime).is_absolute():
        pytest.skip(f"the compiler has no -fsanitize={sanitizer}")
    assert made.returncode == 0, made.stderr
    own = {"FMU_MESH_LIBRARY": str(folder / "library.so"), "LD_PRELOAD": runtime}
    # Python keeps memory to its end, and its allocator would hide what is freed.
    own |= {"TSAN_OPTIONS": OPTIONS, "ASAN_OPTIONS": f"{OPTIONS}:detect_leaks=0", "PYTHONMALLOC": "malloc"}
    return os.environ | own


def run(environment: dict[str, str], equations: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(PROGRAM), str(equations)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=550)


@pytest.mark.parametrize("sanitizer", RUNTIMES)
def test_copies_in_threads_have_equal_floats_and_nothing_is_reported(
    sanitizer: str, tmp_path: Path, event_fmu: Callable[..., Path]
) -> None:
    done = run(sanitized(tmp_path, sanitizer), event_fmu("Oscillator", 2))

    assert done.returncode == 0, done.stdout + done.stderr[-4000:]
    assert done.stdout.endswith(" floats, 0 differ\n")
    assert "Sanitizer" not in done.stderr
    assert "runtime error" not in done.stderr


def test_a_call_that_ends_before_its_threads_would_be_found(tmp_path: Path, event_fmu: Callable[..., Path]) -> None:
    line = ("    await_work(&workers->place, workers[i].done, number);\n", "")

    done = run(sanitized(tmp_path, "thread", line), event_fmu("Oscillator", 2))

    assert "WARNING: ThreadSanitizer: data race" in done.stderr
    assert done.returncode == REPORTED
