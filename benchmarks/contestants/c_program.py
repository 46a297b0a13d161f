"""The limit: a program in C that does nothing but step the FMUs, in one process or in one process per FMU.

Between processes, outputs pass through shared memory, and who waits for a value spins. It has no messages, no master,
no errors with names, and it records nothing. Option `processes`: `one`, or `own` for a process per FMU; `transport`:
`tcp` for sockets over loopback in place of shared memory.
"""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

import fmpy

from benchmarks.contestants.entry import FMUS, compiled, main, versions
from benchmarks.task import Outcome, Task

__all__ = ["run"]

_SOURCE = Path(__file__).with_suffix(".c")
_HEADERS = Path(fmpy.__file__).parent / "c-code"
_DEADLINE_S = 100


def run(task: Task) -> Outcome:
    """The program times itself, from the first step of the first process to the last step of the last one.

    Raises:
        RuntimeError: there is no compiler, or an FMU failed.
    """
    system = task.system
    program, compiler = compiled(_SOURCE, f"-I{_HEADERS}", "-ldl")
    count = 1 if task.options["processes"] == "one" else len(system.members)
    lead = 0 if system.algorithm == "jacobi" else 1
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        transport = task.options.get("transport", "memory")
        command = [str(program), str(count), transport, str(lead), str(task.points), system.step_size.hex()]
        for index in range(len(system.members)):
            command += _instance(task, index, f"{folder}/{index}")
        done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=_DEADLINE_S)
    if done.returncode:
        msg = f"exit code {done.returncode}: {done.stderr.strip()}"
        raise RuntimeError(msg)
    seconds, *last = done.stdout.split()
    names = [member.column for member in system.members]
    values = dict(zip(names, map(float.fromhex, last), strict=True))
    return Outcome(float(seconds), values, {**compiler, **versions("fmpy")})


def _instance(task: Task, index: int, folder: str) -> list[str]:
    """The arguments for one instance; its FMU is unpacked into the folder."""
    member, source, initial = task.system.members[index], task.system.source_of(index), task.initial_inputs[index]
    path = str(FMUS / f"{member.fmu}.fmu")
    description = fmpy.read_model_description(path, validate=False)
    references = {variable.name: str(variable.valueReference) for variable in description.modelVariables}
    fmpy.extract(path, folder)
    name = f"{description.coSimulation.modelIdentifier}{fmpy.sharedLibraryExtension}"
    starts = [text for name, value in member.start_values.items() for text in (references[name], float(value).hex())]
    return [
        f"{folder}/binaries/{fmpy.platform}/{name}",
        description.guid,
        Path(folder, "resources").as_uri(),
        str(-1 if source is None else source),
        references[member.input],
        references[member.output],
        float(initial or 0.0).hex(),
        str(len(member.start_values)),
        *starts,
    ]


if __name__ == "__main__":
    main(run)
