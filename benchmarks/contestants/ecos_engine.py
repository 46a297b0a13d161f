"""ecos: a C++ engine in this process, with the FMUs in this process or one `proxyfmu` process per FMU.

Its fixed-step algorithm is Jacobi and its time a running sum of step sizes, with which its values are compared.
Nothing is recorded and no Python runs during the steps. In one process, several threads step the instances. Option
`processes`: `one`, or `own` for `proxyfmu` over Unix sockets.
"""

from __future__ import annotations

import importlib.util
import stat
from pathlib import Path
from time import perf_counter

from benchmarks.contestants.entry import FMUS, main, versions
from benchmarks.task import Outcome, Task

__all__: list[str] = []


def run(task: Task) -> Outcome:
    """Step in one call; that call is what is timed."""
    own = task.options["processes"] == "own"
    if own:
        _make_executable()
    import ecospy  # type: ignore[import-not-found] # noqa: PLC0415 - it loads a library, which looks for the program

    system = task.system
    with ecospy.EcosSimulationStructure() as structure:
        starts: dict[str, float] = {}
        for index, member in enumerate(system.members):
            path = f"{FMUS / member.fmu}.fmu"
            structure.add_model(member.name, f"proxyfmu://localhost?file={path}" if own else path)
            starts |= {f"{member.name}::{name}": value for name, value in member.start_values.items()}
            source = system.source_of(index)
            if source is not None:
                feeding = system.members[source]
                structure.make_real_connection(f"{feeding.name}::{feeding.output}", f"{member.name}::{member.input}")
        structure.add_parameter_set("start", starts)
        with ecospy.EcosSimulation(structure=structure, step_size=system.step_size) as simulation:
            simulation.init(parameter_set="start")
            started = perf_counter()
            simulation.step(task.points)
            seconds = perf_counter() - started
            last = {m.column: simulation.get_real(f"{m.name}::{m.output}") for m in system.members}
            simulation.terminate()
    return Outcome(seconds, last, versions("ecospy", "tbb"))


def _make_executable() -> None:
    """The package has the program without its run bit."""
    found = importlib.util.find_spec("ecospy")
    if found is None or found.origin is None:
        msg = "ecospy is not installed"
        raise RuntimeError(msg)
    program = Path(found.origin).parent / "binaries" / "proxyfmu"
    program.chmod(program.stat().st_mode | stat.S_IXUSR)


if __name__ == "__main__":
    main(run)
