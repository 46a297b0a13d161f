"""The limit of a sweep: a program in C that runs each variant with new instances, in two processes.

It has no plan, no checks, no deadlines and no table; the rows of a run are in memory, and one value is taken from them.
"""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

import fmpy

from benchmarks.contestants.entry import FMUS, compiled, main, versions
from benchmarks.contestants.reference import rows_of
from benchmarks.task import Member, Outcome, System, Task

__all__ = ["FIRST", "POINTS", "STEP", "check", "run"]

POINTS = 2000
"""Communication steps of each variant."""
FIRST, STEP = 0.05, 2.0**-12
"""The damping of the first variant in 1/s, and how much more each one has than the one before: exact sums."""
_STEP_SIZE = 0.002
_SOURCE = Path(__file__).with_suffix(".c")
_HEADERS = Path(fmpy.__file__).parent / "c-code"
_DEADLINE_S = 100


def run(task: Task) -> Outcome:
    """The program times itself, from the start of its processes to their end; `points` is the number of variants.

    Raises:
        RuntimeError: there is no compiler, an FMU failed, or a value is not that of the plain loop.
    """
    program, compiler = compiled(_SOURCE, f"-I{_HEADERS}", "-ldl")
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        command = [str(program), "2", str(task.points), FIRST.hex(), STEP.hex(), str(POINTS), _STEP_SIZE.hex()]
        for member in _system(0).members:
            command += _instance(member, f"{folder}/{member.name}")
        done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=_DEADLINE_S)
    if done.returncode:
        msg = f"exit code {done.returncode}: {done.stderr.strip()}"
        raise RuntimeError(msg)
    seconds, *values = done.stdout.split()
    check([float.fromhex(value) for value in values])
    return Outcome(float(seconds), {}, {**compiler, **versions("fmpy")})


def check(values: list[float]) -> None:
    """Compare the first, the middle and the last value with the plain loop over FMPy.

    Raises:
        RuntimeError: one differs in any bit.
    """
    for number in (0, len(values) // 2, len(values) - 1):
        rows, _ = rows_of(Task(_system(number), POINTS))
        if (expected := max(row[0] for row in rows)) != values[number]:
            msg = f"variant {number} has {values[number]!r}, and a loop over FMPy {expected!r}"
            raise RuntimeError(msg)


def _system(number: int) -> System:
    pendulum = {"a": 1.3, "l": 1.0, "d": FIRST + number * STEP}
    members = (
        Member("pendulum", "DampedPendulum", "d", "a", pendulum),
        Member("delay", "TransportDelay", "x", "y", {"d": 2.33}),
    )
    return System("chain", "gauss_seidel", _STEP_SIZE, members)


def _instance(member: Member, folder: str) -> list[str]:
    """The arguments for one instance; its FMU is unpacked into the folder."""
    path = str(FMUS / f"{member.fmu}.fmu")
    description = fmpy.read_model_description(path, validate=False)
    references = {variable.name: str(variable.valueReference) for variable in description.modelVariables}
    fmpy.extract(path, folder)
    name = f"{description.coSimulation.modelIdentifier}{fmpy.sharedLibraryExtension}"
    starts = {name: value for name, value in member.start_values.items() if name != member.input}
    return [
        f"{folder}/binaries/{fmpy.platform}/{name}",
        description.guid,
        Path(folder, "resources").as_uri(),
        references[member.input],
        references[member.output],
        str(len(starts)),
        *(text for name, value in starts.items() for text in (references[name], float(value).hex())),
    ]


if __name__ == "__main__":
    main(run)
