"""`plot`, `compare` and `recover`: result files; and the option `--plot` of the commands that run a mesh."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec.structs import asdict

from ..api.result import Result
from ..errors import ConfigurationError, FmuMeshError
from ..installing import require
from ..pictures.drawing import draw
from ..results.formats import recover, require_readable
from ..run.overriding import memory_of
from ..run.run_plan import RunPlan
from ..system.plan import Plan
from ..text import listed
from .arguments import Runs
from .output.json_output import print_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..sweeps.sweep_result import SweepResult

__all__ = ["RUNS", "check_plot", "plot_results", "plotted_where_it_ends"]

_DIFFERENT = 1
"""The exit code for results that differ."""


def _plot(arguments: argparse.Namespace) -> int:
    from ..sweeps.sweep_folder import is_sweep  # noqa: PLC0415 the commands that run a mesh need none
    from ..sweeps.sweep_result import SweepResult  # noqa: PLC0415 as above

    require("matplotlib")
    first, *others = arguments.results
    sweeps = [str(path) for path in arguments.results if is_sweep(path)]
    of_curves = arguments.x or arguments.difference or arguments.title
    if sweeps and (others or of_curves):
        raise ConfigurationError(
            f"'{sweeps[0]}' is the folder of a sweep, which is drawn alone, over time and with its own title.",
            hint="Leave other files, --x, --difference and --title out.",
        )
    if sweeps:
        figure, name = _of_sweep(SweepResult.read(first), arguments)
        default = first / f"{name.replace('/', '_')}.png"
    elif arguments.colour or arguments.heat_map or arguments.axes:
        raise ConfigurationError(f"'{first}' is not the folder of a sweep, which --colour and --heat-map are for.")
    else:
        figure, default = _of_files(arguments), first.with_suffix(".png")
    output = arguments.output if arguments.output is not None else default
    draw(figure, output)
    print(f"plot: {output}")
    return 0


def _of_files(arguments: argparse.Namespace) -> Figure:
    result, *others = (Result(path.stem, file=path) for path in arguments.results)
    if arguments.difference and (not others or arguments.x is not None):
        hint = "Name two result files." if not others else "Leave --x out."
        raise ConfigurationError("--difference draws the difference of two result files over time.", hint=hint)
    return result.plot(
        *(arguments.variables or ()),
        title=arguments.title,
        x=arguments.x,
        others=others,
        difference=arguments.difference,
    )


def _of_sweep(sweep: SweepResult, arguments: argparse.Namespace) -> tuple[Figure, str]:
    """A picture of a sweep, and what it shows."""
    variables: Sequence[str] = arguments.variables or ()
    if arguments.heat_map is not None:
        if variables or arguments.colour:
            raise ConfigurationError("--heat-map draws no curves", hint="Leave --variables and --colour out.")
        x, y = arguments.axes or (None, None)
        return sweep.heat_map(arguments.heat_map, x=x, y=y), arguments.heat_map
    if len(variables) != 1:
        hint = f"There are {listed(sweep.variables)}."
        raise ConfigurationError("--variables has to name the one variable whose curves to draw.", hint=hint)
    return sweep.plot(variables[0], colour=arguments.colour), variables[0]


def check_plot(plot: Path, plan: RunPlan | None = None) -> None:
    """Check before a run that its result, or without a plan another picture, can be drawn at its end.

    Raises:
        ConfigurationError: matplotlib is not installed, it has no such format, or the result cannot be drawn.
    """
    require("matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415  matplotlib is an extra, and slow to import

    formats = FigureCanvasAgg.get_supported_filetypes()
    if plot.suffix.removeprefix(".").lower() not in formats:
        raise ConfigurationError(f"a plot cannot be written as '{plot}'.", hint="Name it .png, .svg or .pdf.")
    if plan is None:
        return
    if (result := plan.plan.system.result_file) is None:
        raise ConfigurationError("nothing is recorded, so there is nothing to plot.", hint="Name a file with --output.")
    if memory_of(plan) is None:
        require_readable(Path(result))


def plot_results(result: Path | Result, plot: Path, plan: Plan) -> None:
    """Draw the result of a run, or its file, with one axes for each unit of its plan."""
    if isinstance(result, Path):
        result = Result(plan.system.config.mesh, file=result, system=plan.system)
    draw(result.plot(), plot)
    print(f"plot: {plot}")


@contextmanager
def plotted_where_it_ends(plan: Plan, plot: Path | None) -> Iterator[None]:
    """Inside, a run: if it ends early, what it recorded up to then is drawn, and never what an earlier run has left."""
    file = Path(plan.system.result_file or "")  # the current folder is no file

    def state() -> tuple[int, int, int] | None:
        """What changes when something is written into the file."""
        status = file.stat() if file.is_file() else None
        return (status.st_ino, status.st_size, status.st_mtime_ns) if status is not None else None

    before = state()
    try:
        yield
    except FmuMeshError as error:
        if plot is not None and state() != before:
            plot_results(file, plot, plan)
        elif plot is not None and isinstance(error.result, Result) and len(error.result.times):  # it is in memory
            plot_results(error.result, plot, plan)
        raise


def _compare(arguments: argparse.Namespace) -> int:
    if arguments.plot is not None:
        require("matplotlib")
    first, second = (Result(path.stem, file=path) for path in (arguments.first, arguments.second))
    comparison = first.compare(second, rtol=arguments.rtol, atol=arguments.atol, variables=tuple(arguments.variables))
    code = 0 if comparison.equal else _DIFFERENT
    if arguments.json:
        fields = {name: value for name, value in asdict(comparison).items() if name != "drawn"}
        print_json({"equal": comparison.equal, "exit_code": code, **fields})
    else:
        print(comparison.text)
    if arguments.plot is not None:
        draw(comparison.plot(), arguments.plot)
        if not arguments.json:
            print(f"plot: {arguments.plot}")
    return code


def _recover(arguments: argparse.Namespace) -> int:
    print(f"{arguments.results}: {recover(arguments.results)} rows")
    return 0


RUNS: Runs = {"plot": _plot, "compare": _compare, "recover": _recover}
