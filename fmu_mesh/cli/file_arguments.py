"""The arguments of the commands for files. Owns no work: `--help` imports this and little else."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from .arguments import CommandParser, Parsers, add_json, add_package, add_quiet, add_reaching, add_ssd, tolerance
from .run_options import add_options

__all__ = ["CONFIGURATION", "PARSERS", "SHELLS", "TIMES"]

CONFIGURATION: Final = "mesh.yaml"
"""What `new` writes."""
TIMES: Final = ("algorithm", "step_size", "stop_time")
"""The options of `convert`, which replace what its source says."""
SHELLS: Final = ("bash", "zsh", "fish")


def _add_new(parser: CommandParser) -> None:
    parser.add_argument(
        "models", nargs="*", type=Path, metavar="FMU", help="a folder with FMUs, or FMUs; default: this folder"
    )
    parser.add_argument(
        "--output", type=Path, metavar="FILE.yaml", help=f"the configuration; default: {CONFIGURATION} beside the FMUs"
    )
    parser.add_argument("--force", action="store_true", help="overwrite files that exist")
    add_quiet(parser)


def _add_graph(parser: CommandParser) -> None:
    parser.add_argument(
        "of",
        nargs="?",
        metavar="CONFIG|MESH",
        help="a configuration file or a package of SSP, or the name or key of a running mesh; default: the only one "
        "that runs",
    )
    parser.add_argument(
        "--output",
        type=Path,
        metavar="FILE.svg",
        help="write it into a .svg, .png, .pdf or .txt file; default: text on the terminal",
    )
    add_package(parser)
    add_options(parser, *TIMES, "start_values", "config_values", "allow_code")
    add_quiet(parser)
    add_json(parser, "JSON: one object with all instances and connections")
    add_reaching(parser)


def _add_convert(parser: CommandParser) -> None:
    parser.add_argument("source", type=Path, metavar="SOURCE", help="a package of SSP, or a configuration file")
    parser.add_argument("target", type=Path, metavar="TARGET", help="the new file: .yaml, or .ssp")
    add_package(parser)
    parser.add_argument(
        "--version",
        choices=("1.0", "2.0"),
        metavar="1.0|2.0",
        help="version of SSP; default: that of SOURCE if it is a package, otherwise 1.0",
    )
    add_options(parser.add_argument_group("instead of what SOURCE says"), *TIMES)
    parser.add_argument("--force", action="store_true", help="overwrite TARGET")
    add_quiet(parser)


def _add_inspect(parser: CommandParser) -> None:
    text = "the FMU, or the folder of an unpacked one; or a package of SSP"
    parser.add_argument("fmu", type=Path, metavar="MODEL.fmu|PACKAGE", help=text)
    parser.add_argument(
        "variables",
        nargs="*",
        metavar="VARIABLE",
        help="show only these variables, or patterns, such as 'x*'",
    )
    parser.add_argument(
        "--all", action="store_true", help="show all variables, and not only the first of each causality"
    )
    add_ssd(parser)
    add_json(parser, "print everything as one JSON object")


def _add_plot(parser: CommandParser) -> None:
    parser.add_argument(
        "results", type=Path, nargs="+", metavar="RESULTS.csv", help="result files, or the folder of a sweep"
    )
    parser.add_argument(
        "--output", type=Path, metavar="FILE.png", help="file of the picture; default: beside the result file"
    )
    parser.add_argument(
        "--variables",
        nargs="+",
        metavar="INSTANCE.VARIABLE",
        help="plot only these, or patterns such as 'motor.*'; default: all of the file",
    )
    parser.add_argument("--x", metavar="NAME", help="the variable on the horizontal axis; default: time")
    parser.add_argument(
        "--difference", action="store_true", help="also draw the differences of the other files to the first one"
    )
    parser.add_argument("--title", metavar="TEXT", help="the title; default: the names of the files")
    sweep = parser.add_argument_group("of a sweep")
    sweep.add_argument(
        "--colour", metavar="NAME", help="the parameter or column that colours the curves; default: the first parameter"
    )
    sweep.add_argument(
        "--heat-map", metavar="COLUMN", help="draw a column over two parameters, such as max(pendulum.a)"
    )
    sweep.add_argument(
        "--axes", nargs=2, metavar="NAME", help="the two parameters of the heat map; default: the first two"
    )
    add_quiet(parser)


def _add_compare(parser: CommandParser) -> None:
    parser.add_argument("first", type=Path, metavar="RESULTS.csv", help="a result file, whose times and units hold")
    parser.add_argument("second", type=Path, metavar="RESULTS.csv", help="the other result file")
    parser.add_argument(
        "--rtol", type=tolerance, default=0.0, metavar="X", help="relative tolerance; default: 0, bit for bit"
    )
    parser.add_argument(
        "--atol", type=tolerance, default=0.0, metavar="X", help="absolute tolerance, in the unit of each variable"
    )
    parser.add_argument(
        "--variables",
        nargs="+",
        default=(),
        metavar="INSTANCE.VARIABLE",
        help="compare only these, or patterns such as 'motor.*'; default: all",
    )
    parser.add_argument(
        "--plot", type=Path, metavar="FILE.png", help="draw both and their difference: the variables that differ most"
    )
    add_quiet(parser)
    add_json(parser, "JSON: one object with all differences")


def _add_recover(parser: CommandParser) -> None:
    parser.add_argument("results", type=Path, metavar="FILE", help="the result file, as the run was given it")
    add_quiet(parser)


def _add_completion(parser: CommandParser) -> None:
    parser.add_argument("shell", choices=SHELLS, metavar="SHELL", help=" or ".join(SHELLS))


PARSERS: Parsers = {
    "new": _add_new,
    "graph": _add_graph,
    "convert": _add_convert,
    "inspect": _add_inspect,
    "plot": _add_plot,
    "compare": _add_compare,
    "recover": _add_recover,
    "completion": _add_completion,
}
