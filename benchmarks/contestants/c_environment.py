"""The limit of an environment that a program steps: a program in C that calls the cart pole, and does nothing else."""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

import fmpy

from benchmarks.contestants.entry import FMUS, compiled, main, versions
from benchmarks.task import Outcome, Task

__all__ = ["INPUT", "OUTPUT", "OUTPUTS", "run"]

INPUT, OUTPUT = "force", "theta"
OUTPUTS = (OUTPUT, "x", "der(x)", "der(theta)")
"""What is read of each copy of a batch."""

_SOURCE = Path(__file__).with_suffix(".c")
_HEADERS = Path(fmpy.__file__).parent / "c-code"
_DEADLINE_S = 100


def run(task: Task) -> Outcome:
    """The program times itself; `what` is `steps`, `batch`, `state` or `values`.

    Raises:
        RuntimeError: there is no compiler, or the FMU failed.
    """
    program, compiler = compiled(_SOURCE, f"-I{_HEADERS}", "-ldl")
    path = str(FMUS / "CartPole.fmu")
    description = fmpy.read_model_description(path, validate=False)
    references = {variable.name: str(variable.valueReference) for variable in description.modelVariables}
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        fmpy.extract(path, folder)
        library = f"{folder}/binaries/{fmpy.platform}/CartPole{fmpy.sharedLibraryExtension}"
        command = [str(program), task.options["what"], library, description.guid]
        command += [references[INPUT], references[OUTPUT], str(task.points), repr(task.system.step_size)]
        if copies := task.options.get("copies"):
            command += [str(copies), *(references[name] for name in OUTPUTS[1:])]
        done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=_DEADLINE_S)
    if done.returncode:
        msg = f"exit code {done.returncode}: {done.stderr.strip()}"
        raise RuntimeError(msg)
    seconds, last = done.stdout.split()
    return Outcome(float(seconds), {f"cart.{OUTPUT}": float.fromhex(last)}, {**compiler, **versions("fmpy")})


if __name__ == "__main__":
    main(run)
