"""`run` and `simulate`: one FMU without a configuration file, in real time until it is stopped, or fast to its end.

Owns the configuration of this mesh of one instance; everything else is as for any mesh.
"""

from __future__ import annotations

import argparse
import re

from ..api.mesh_builder import Mesh
from ..api.simulating import as_given, experiment_of
from ..config.base import NAME_PATTERN
from ..errors import CallRefused, ConfigurationError, LoadFailed
from ..run.options import SimulateOptions
from .arguments import Runs
from .output.reports import RunReporter
from .output.terminal import teller
from .run_arguments import SIMULATION
from .run_options import given_options
from .running import run_mesh

__all__ = ["RUNS"]


def _simulate(arguments: argparse.Namespace) -> int:
    with RunReporter(wanted=arguments.json) as reporter:
        try:
            options = SimulateOptions(**given_options(arguments, SimulateOptions))
            mesh, given = experiment_of(arguments.fmu, options)
        except (LoadFailed, CallRefused) as error:  # a wrong argument: nothing was going to run
            raise ConfigurationError(error.message, hint=error.hint) from error
        how = {"processes": given.pop("processes", True)}
        try:
            run_mesh(mesh, given, arguments, reporter, how)
        except ConfigurationError as error:
            raise as_given(error, f"{mesh.name}.") from error
    return 0


def _run(arguments: argparse.Namespace) -> int:
    with RunReporter(wanted=arguments.json) as reporter:
        mesh, options = _mesh(arguments), given_options(arguments)
        front = f"{mesh.name}."  # the only instance has the name of the mesh
        options["start_values"] = [(f"{front}{name}", value) for name, value in options.get("start_values", ())]
        try:
            run_mesh(mesh, options, arguments, reporter, {})
        except ConfigurationError as error:
            raise as_given(error, front) from error
    return 0


def _mesh(arguments: argparse.Namespace) -> Mesh:
    simulation = {"stop_time": None, **SIMULATION}
    if arguments.step_size is not None:
        simulation["step_size"] = arguments.step_size
    try:
        mesh = Mesh.from_fmu(
            arguments.fmu,
            name=arguments.name,
            simulation=simulation,
            on_notice=teller(quiet=arguments.quiet),
            interpolation=arguments.interpolation,
        )
    except LoadFailed as error:  # a wrong argument: nothing was going to run
        raise ConfigurationError(error.message, hint=error.hint) from error
    except CallRefused as error:
        raise ConfigurationError(error.message, hint="Give one with `step_size=...`.") from error
    if re.search(NAME_PATTERN, mesh.name) is None:
        what = "a name of letters, digits, _ and - that starts with a letter or _"
        raise ConfigurationError(f"'{mesh.name}' is not {what}", hint="Give the mesh such a name with --name.")
    for variable, key in arguments.subscribe:
        mesh.subscribe(key, f"{mesh.name}.{variable}", take="newest" if "*" in key else "all")
    for variable, key in arguments.publish:
        mesh.publish(f"{mesh.name}.{variable}", key)
    return mesh


RUNS: Runs = {"run": _run, "simulate": _simulate}
