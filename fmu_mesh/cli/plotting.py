"""`plot`: draws a result file; and the option `--plot` of the commands that run a mesh."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..api.drawing import draw, require_matplotlib
from ..api.result import Result
from ..api.result_reading import require_csv
from ..errors import ConfigurationError, FmuMeshError
from ..system.plan import Plan
from .arguments import CommandParser, Parsers, add_quiet

__all__ = ["PARSERS", "check_plot", "plot_results", "plotted_where_it_ends"]


def _add_plot(parser: CommandParser) -> None:
    parser.add_argument("results", type=Path, metavar="RESULTS.csv", help="the result file")
    parser.add_argument(
        "--output", type=Path, metavar="FILE.png", help="file of the picture; default: beside the result file"
    )
    parser.add_argument(
        "--variables", nargs="+", metavar="INSTANCE.VARIABLE", help="plot only these; default: all of the file"
    )
    add_quiet(parser)
    parser.set_defaults(run_command=_plot)


def _plot(arguments: argparse.Namespace) -> int:
    require_matplotlib()
    output = arguments.output if arguments.output is not None else arguments.results.with_suffix(".png")
    draw(Result.read(arguments.results).plot(*arguments.variables or ()), output)
    print(f"plot: {output}")
    return 0


def check_plot(plot: Path, result: str | None) -> None:
    """Check before a run that its result can be plotted at its end.

    Args:
        plot: the file of the picture.
        result: the result file, or None if nothing is recorded.

    Raises:
        ConfigurationError: matplotlib is not installed, it has no such format, or the result cannot be drawn.
    """
    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415  matplotlib is an extra, and slow to import

    formats = FigureCanvasAgg.get_supported_filetypes()
    if plot.suffix.removeprefix(".").lower() not in formats:
        raise ConfigurationError(f"a plot cannot be written as '{plot}'.", hint="Name it .png, .svg or .pdf.")
    if result is None:
        raise ConfigurationError("nothing is recorded, so there is nothing to plot.", hint="Name a file with --output.")
    require_csv(Path(result))


def plot_results(result: Path, plot: Path, plan: Plan) -> None:
    """Draw the result file of a run, with one axes for each unit of its plan.

    Raises:
        ConfigurationError: the result cannot be read, or the plot cannot be written.
    """
    draw(Result(plan.system.config.mesh, file=result, system=plan.system).plot(), plot)
    print(f"plot: {plot}")


@contextmanager
def plotted_where_it_ends(plan: Plan, plot: Path | None) -> Iterator[None]:
    """Inside, a run: if it ends early, what it recorded up to then is drawn, and never what an earlier run has left."""
    result = plan.system.result_file
    before = _state_of(result)
    try:
        yield
    except FmuMeshError:
        if plot is not None and result is not None and _state_of(result) != before:
            plot_results(Path(result), plot, plan)
        raise


def _state_of(result: str | None) -> tuple[int, int, int] | None:
    """What changes of a file when something is written into it."""
    if result is None or not Path(result).is_file():
        return None
    status = Path(result).stat()
    return status.st_ino, status.st_size, status.st_mtime_ns


PARSERS: Parsers = {"plot": _add_plot}
