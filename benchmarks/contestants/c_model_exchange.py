"""The limit of model exchange: a program in C that steps two oscillators in a chain, with the solver of the project.

It has no rings, no checks and no result; everything else is the same, so its floats are ours.
"""

from __future__ import annotations

import hashlib
import subprocess
import tempfile
from pathlib import Path

import fmpy

from benchmarks.contestants.entry import compiled, main, versions
from benchmarks.contestants.fmu_mesh_kinds import BUILT, STEP_SIZE
from benchmarks.task import Outcome, Task
from tests.fmus.event_fmus import build_event_fmu

__all__ = ["TOLERANCE", "run"]

TOLERANCE = 1e-6
_SOURCE = Path(__file__).with_suffix(".c")
_HEADERS = Path(fmpy.__file__).parent / "c-code"
_SOLVER = Path(__file__).resolve().parents[2] / "fmu_mesh" / "rings" / "model_exchange.c"
_DEADLINE_S = 100


def run(task: Task) -> Outcome:
    """The program times itself, from the first to the last step.

    Raises:
        RuntimeError: there is no compiler, or an FMU failed.
    """
    digest = hashlib.sha256(_SOLVER.read_bytes()).hexdigest()  # so that another solver is another program
    includes = f'-DSOLVER="{_SOLVER}"', f'-DDIGEST="{digest}"', f"-I{_HEADERS}", f"-I{_SOLVER.parent}"
    program, compiler = compiled(_SOURCE, *includes, "-ffp-contract=off", "-ldl")
    path = build_event_fmu("Oscillator", 2, BUILT)
    description = fmpy.read_model_description(str(path))
    references = {variable.name: variable.valueReference for variable in description.modelVariables}
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        fmpy.extract(str(path), folder)
        library = f"{folder}/binaries/{fmpy.platform}/Oscillator{fmpy.sharedLibraryExtension}"
        command = [str(program), library, description.guid, str(references["u"]), str(references["x"])]
        command += [str(task.points), repr(STEP_SIZE), repr(TOLERANCE)]
        done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=_DEADLINE_S)
    if done.returncode:
        msg = f"exit code {done.returncode}: {done.stderr.strip()}"
        raise RuntimeError(msg)
    seconds, first, second = done.stdout.split()
    last = {"first.x": float.fromhex(first), "second.x": float.fromhex(second)}
    return Outcome(float(seconds), last, {**compiler, **versions("fmpy")})


if __name__ == "__main__":
    main(run)
