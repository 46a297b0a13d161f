"""The options of a sweep. Owns no work: the help of the command imports this."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from ..config.call_options import Option
from ..run.options import BeginOptions, SweepForce, SweepResume, Workers

if TYPE_CHECKING:
    from ..api.result import Result

__all__ = ["Own", "SweepOptions"]

Own = Callable[["Result"], object]
"""A reduction of the user: a function of a module, since workers import it."""


class SweepOptions(BeginOptions, frozen=True, kw_only=True):
    """What `fmu_mesh.sweep` takes beside the mesh and what varies."""

    executor: Annotated[
        Executor | None,
        Option(
            "where the variants run, such as `dask.distributed.Client(...).get_executor()`; it is not shut down; None: "
            "processes of this host"
        ),
    ] = None
    workers: Workers = None
    sampler: Annotated[
        str | None,
        Option(
            "choose COUNT variants, spread over the ranges: lhs, sobol, halton or random, as in lhs:64; None: all "
            "combinations",
            "--sampler",
            "NAME:COUNT",
        ),
    ] = None
    seed: Annotated[
        int, Option("seed of the sampler; the same one chooses the same values", "--seed", "N", least=0)
    ] = 0
    reduce: Annotated[
        Sequence[str | Own],
        Option(
            "columns of the table, such as max(pendulum.a); in a program also functions of a `Result` in a module; "
            "default: the last value of each variable",
            "--reduce",
            "FUNCTION(VARIABLE)",
        ),
    ] = ()
    folder: Annotated[
        str | Path | None,
        Option("folder of the sweep; default: MESH_sweep beside the result file", "--folder", "FOLDER"),
    ] = None
    curves: Annotated[bool, Option("False: keep the table only", "--no-curves")] = True
    resume: SweepResume = False
    force: SweepForce = False
    processes: Annotated[bool, Option("deprecated: run each variant in processes, as `Mesh.run` does")] = False
    reset: Annotated[bool, Option("reset the instances of FMUs between two runs (fmi2Reset)", "--reset")] = False
    max_instances: Annotated[
        Mapping[str, int] | Iterable[Any],
        Option(
            "at most so many instances of a model file at a time, as its licence may ask",
            "--max-instances",
            "MODEL.fmu=N",
        ),
    ] = ()
