"""`check` and `schema`: the plan of a configuration, and its JSON Schema."""

from __future__ import annotations

import argparse
import sys

import msgspec

from ..api.mesh_check import AccessView
from ..config.structure import schema_text
from ..errors import FmuMeshError
from ..instances.configuration import installed_config
from ..pictures.plan_view import PlanView
from .arguments import Runs
from .output.flag_words import in_flags
from .output.json_output import Failure, failure_of, print_json
from .run_options import given_options, mesh_of

__all__ = ["RUNS", "CheckReport"]


class CheckReport(msgspec.Struct, frozen=True):
    """The output of `check --json`."""

    file: str  # the configuration as it was given
    exit_code: int
    plan: PlanView | msgspec.Raw | None = None  # what would run; None if the configuration is wrong
    error: Failure | None = None  # what is wrong, with all findings
    round_trip: list[str] = []  # what --round-trip costs, in sentences
    access: AccessView | None = None  # who may do what


def _check(arguments: argparse.Namespace) -> int:
    plan, access, costs = None, None, []
    try:
        check = mesh_of(arguments).check(**given_options(arguments))
        access = check.access
        if arguments.json and check.run is not None:
            plan = msgspec.Raw(in_flags(msgspec.json.encode(check.plan).decode()).encode())
        elif check.run is not None:
            print(in_flags(str(check or check.page)))
        check.require()
        if arguments.round_trip is not None:
            costs = check.at_round_trip(arguments.round_trip)
    except FmuMeshError as error:
        if arguments.json:
            print_json(CheckReport(str(arguments.config), error.exit_code, plan, failure_of(error), access=access))
        raise
    if arguments.json:
        print_json(CheckReport(str(arguments.config), 0, plan, round_trip=costs, access=access))
    elif costs:
        print("", f"Between hosts, with a round trip of {arguments.round_trip:g} s", *costs, sep="\n")
    return 0


def _schema(_arguments: argparse.Namespace) -> int:
    sys.stdout.write(schema_text(installed_config()))
    return 0


RUNS: Runs = {"check": _check, "schema": _schema}
