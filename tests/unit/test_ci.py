"""What the scripts of CI say at their end: a stage that did not run must not look as if it had passed."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

SCRIPT = """
set -euo pipefail
. .ci/stages
trap 'tell_stages; exit $?' EXIT
stage "the first"
skip "the bridge" "it is not built"
stage "all tests"
tests sh -c 'echo "some tests"; echo "== 3 tests in 1 s"; exit CODE'
"""


@pytest.mark.parametrize(("code", "verdict"), [(0, "ran      all tests (N s)"), (1, "FAILED   all tests (N s)")])
def test_a_script_of_ci_ends_with_its_stages_and_pytests_line(code: int, verdict: str) -> None:
    script = SCRIPT.replace("CODE", str(code))

    done = subprocess.run(["bash", "-c", script], cwd=ROOT, capture_output=True, text=True, check=False)

    assert done.returncode == code
    assert re.sub(r"\(\d+ s\)", "(N s)", done.stdout.split("== Stages\n")[1]).splitlines() == [
        "ran      the first (N s)",
        verdict,
        "SKIPPED  the bridge: it is not built",
        "",
        "== 3 tests in 1 s",
    ]


UNSTEADY = """
set -euo pipefail
. STAGES
trap 'tell_stages; exit $?' EXIT
stage "all tests"
mkdir -p .pytest_cache/v/cache
echo '{"test_a": true, "test_b": true}' > .pytest_cache/v/cache/lastfailed
tests sh -c 'echo "== 2 failed in 9 s"; exit 1' || alone sh -c 'echo "== SECOND in 1 s"; exit CODE'
"""


@pytest.mark.parametrize("code", [0, 1])
def test_a_test_that_fails_beside_others_only_is_named(tmp_path: Path, code: int) -> None:
    script = UNSTEADY.replace("CODE", str(code)).replace("STAGES", str(ROOT / ".ci" / "stages"))

    done = subprocess.run(["bash", "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False)

    assert done.returncode == code
    told = done.stdout.split("== Stages\n")[1].splitlines()
    assert told[0].startswith("FAILED" if code else "ran ")
    names = [f"UNSTEADY test_{name}: failed beside others, and passed alone" for name in "ab" if not code]
    assert told[1:] == [*names, "", "== SECOND in 1 s"]
    assert "== 2 failed in 9 s\ntest_a\ntest_b\n" in done.stdout


def test_many_failed_tests_are_not_tried_again(tmp_path: Path) -> None:
    many = ", ".join(f'"test_{number}": true' for number in range(6))
    script = UNSTEADY.replace('"test_a": true, "test_b": true', many).replace("STAGES", str(ROOT / ".ci" / "stages"))

    done = subprocess.run(["bash", "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False)

    assert done.returncode == 1
    assert "SECOND" not in done.stdout


STAGES = (
    "arm64 bridge browser containers cuts examples floods gazebo hosts kills learning live_data recovery ros slurm tsan"
    " wine zenoh_bridge"
)


def test_a_stage_that_there_is_not_is_refused() -> None:
    done = subprocess.run([ROOT / ".ci" / "long", "zenohd"], capture_output=True, text=True, check=False)

    assert (done.returncode, done.stderr) == (
        2,
        f"zenohd is no stage; there are: {STAGES}\n",
    )


@pytest.mark.parametrize("name", ["run", "long"])
def test_a_script_of_ci_leaves_nothing_out_without_a_reason(name: str) -> None:
    text = (ROOT / ".ci" / name).read_text(encoding="utf-8")

    skipped = re.findall(r'\bskip ("[^"]*") *(.*)', text)

    assert skipped
    assert all(re.match(r'"[^"]{5,}"', reason) for _, reason in skipped)
    assert "|| echo" not in text


def test_tests_with_built_types_are_in_the_stage_that_builds_them() -> None:
    text = (ROOT / ".ci" / "long").read_text(encoding="utf-8")
    stage = text[text.index("\nros() {") :].partition("\n}")[0]
    names = {name for group in re.findall(r"tests/ros/test_\{([^}]*)\}\.py", stage) for name in group.split(",")}

    call = re.compile(r"^(?!def ).*\bbuilt_types_or_skip\(\)", re.MULTILINE)
    files = (ROOT / "tests" / "ros").glob("test_*.py")
    needed = {file.stem.removeprefix("test_") for file in files if call.search(file.read_text(encoding="utf-8"))}

    assert "simulation_interfaces" in needed
    assert needed <= names
