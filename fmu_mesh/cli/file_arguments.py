"""The arguments of the commands for files. Owns no work: `--help` imports this and little else."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from .arguments import (
    PACKAGE,
    QUIET,
    RULED,
    SSD,
    Parsers,
    argument,
    group,
    json_switch,
    positive_seconds,
    reaching,
    switch,
    tolerance,
)
from .run_options import options

__all__ = ["CONFIGURATION", "PARSERS", "SHELLS", "TIMES"]

CONFIGURATION: Final = "mesh.yaml"
"""What `new` writes."""
TIMES: Final = ("algorithm", "step_size", "stop_time")
"""The options of `convert`, which replace what its source says."""
SHELLS: Final = ("bash", "zsh", "fish")

PARSERS: Parsers = {
    "new": (
        argument("models", "FMU", "a folder with FMUs, or FMUs; default: this folder", nargs="*", type=Path),
        argument("--output", "FILE.yaml", f"the configuration; default: {CONFIGURATION} beside the FMUs", type=Path),
        switch("--force", text="overwrite files that exist"),
        QUIET,
    ),
    "graph": (
        argument(
            "of",
            "CONFIG|MESH",
            "a configuration file or a package of SSP, or the name or key of a running mesh; default: the only one "
            "that runs",
            nargs="?",
        ),
        argument(
            "--output",
            "FILE.svg",
            "write it into a .svg, .png, .pdf or .txt file; default: text on the terminal",
            type=Path,
        ),
        *PACKAGE,
        options(*TIMES, "start_values", "config_values", "allow_code"),
        QUIET,
        json_switch("JSON: one object with all instances and connections"),
        *reaching(),
    ),
    "convert": (
        argument("source", "SOURCE", "a package of SSP, a world of Gazebo, or a configuration file", type=Path),
        argument("target", "TARGET", "the new file: .yaml, or .ssp", type=Path),
        *PACKAGE,
        argument(
            "--version",
            "1.0|2.0",
            "version of SSP; default: that of SOURCE if it is a package, otherwise 1.0",
            choices=("1.0", "2.0"),
        ),
        group("instead of what SOURCE says", options(*TIMES)),
        switch("--force", text="overwrite TARGET"),
        QUIET,
    ),
    "inspect": (
        argument(
            "fmu", "MODEL.fmu|PACKAGE", "the FMU, or the folder of an unpacked one; or a package of SSP", type=Path
        ),
        argument("variables", "VARIABLE", "show only these variables, or patterns, such as 'x*'", nargs="*"),
        switch("--all", text="show all variables, and not only the first of each causality"),
        SSD,
        json_switch("print everything as one JSON object"),
    ),
    "plot": (
        argument("results", "RESULTS.csv", "result files, or the folder of a sweep", type=Path, nargs="+"),
        argument("--output", "FILE.png", "file of the picture; default: beside the result file", type=Path),
        argument(
            "--variables",
            "INSTANCE.VARIABLE",
            "plot only these, or patterns such as 'motor.*'; default: all of the file",
            nargs="+",
        ),
        argument("--x", "NAME", "the variable on the horizontal axis; default: time"),
        switch("--difference", text="also draw the differences of the other files to the first one"),
        argument("--title", "TEXT", "the title; default: the names of the files"),
        group(
            "of a sweep",
            argument(
                "--colour", "NAME", "the parameter or column that colours the curves; default: the first parameter"
            ),
            argument("--heat-map", "COLUMN", "draw a column over two parameters, such as max(pendulum.a)"),
            argument("--axes", "NAME", "the two parameters of the heat map; default: the first two", nargs=2),
        ),
        QUIET,
    ),
    "compare": (
        argument("first", "RESULTS.csv", "a result file, whose times and units hold", type=Path),
        argument("second", "RESULTS.csv", "the other result file", type=Path),
        argument("--rtol", "X", "relative tolerance; default: 0, bit for bit", type=tolerance, default=0.0),
        argument("--atol", "X", "absolute tolerance, in the unit of each variable", type=tolerance, default=0.0),
        argument(
            "--variables",
            "INSTANCE.VARIABLE",
            "compare only these, or patterns such as 'motor.*'; default: all",
            nargs="+",
            default=(),
        ),
        argument("--plot", "FILE.png", "draw both and their difference: the variables that differ most", type=Path),
        QUIET,
        json_switch("JSON: one object with all differences"),
    ),
    "security": (
        argument(
            "what",
            "init|add|renew|remove|show",
            "init: make an authority in an empty folder; add: certify a person or a host, and write the folder "
            "DIR/NAME to hand over; renew: with a new certificate; remove: take the role away; show: who, which role, "
            "until when",
            choices=("init", "add", "renew", "remove", "show"),
        ),
        argument("folder", "DIR", "the folder of the authority; for show also that of one name", type=Path),
        argument("name", "NAME", "a person or a host: of add, renew and remove", nargs="?"),
        group(
            "add and renew",
            argument(
                "--role",
                "ROLE",
                "observer (reads), operator (also sets and commands) or node (all that belongs to a run: who launches, "
                "each host, a router); add only",
                choices=("observer", "operator", "node"),
            ),
            argument(
                "--days",
                "N",
                "how long the certificate lasts; default: 90; 0.5 are 12 hours",
                type=positive_seconds,
            ),
            argument(
                "--host",
                "HOST",
                "a name or an address by which others reach a node; repeatable; default: those of this host, or those "
                "that it has",
                action="append",
                default=[],
            ),
        ),
        group(
            "show",
            switch("--table", text="what each role may do"),
            switch("--zenohd", text="the rules for a router of your own, as JSON of Zenoh"),
            *RULED,
            json_switch("JSON, one object for each name"),
        ),
    ),
    "doctor": (json_switch("JSON, one object with all checks"),),
    "recover": (
        argument("results", "FILE", "the result file, as the run was given it", type=Path),
        QUIET,
    ),
    "completion": (argument("shell", "SHELL", " or ".join(SHELLS), choices=SHELLS),),
}
