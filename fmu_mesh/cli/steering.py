"""`pause`, `resume`, `step`, `stop` and `wait`: a running mesh is told what to do, and waited for."""

from __future__ import annotations

import argparse
import re
import time
from typing import Final

from ..api.attaching import attach
from ..api.run_handle import Run
from ..errors import ConfigurationError
from .arguments import Runs, whole
from .output.json_output import print_json

__all__ = ["RUNS"]

_TIMEOUT_S = 5.0


def _command(arguments: argparse.Namespace) -> int:
    name, points = arguments.mesh, getattr(arguments, "points", None)
    if arguments.command == "step" and points is None and name is not None and _NUMBER.fullmatch(name):
        name, points = None, name  # `step 10`: no mesh has a number as its name
    number = whole(points) if points is not None else 1
    if number < 1:
        raise ConfigurationError(f"N: '{points}' is not a whole number of 1 or more")
    with attach(name, connect=arguments.connect, timeout=arguments.timeout) as run:
        answer = run.step(number) if arguments.command == "step" else _COMMANDS[arguments.command](run)
    assert answer is not None  # that of a mesh that was found
    if arguments.json:
        print_json(answer)
        return 0
    what = "is stopping" if answer.command == "stop" else f"is {answer.state}"
    print(f"mesh '{run.name}' {what} at point {answer.point}")
    return 0


_COMMANDS: Final = {"pause": Run.pause, "resume": Run.resume, "stop": Run.stop}
_NUMBER: Final = re.compile(r"[-+]?[0-9.].*")


def _wait(arguments: argparse.Namespace) -> int:
    # A mesh with a note is running or about to end; an endpoint may appear later.
    patience_s = arguments.timeout if arguments.connect else min(arguments.timeout, _TIMEOUT_S)
    end = time.monotonic() + arguments.timeout
    with attach(arguments.mesh, connect=arguments.connect, timeout=patience_s, wait=arguments.timeout) as run:
        status = run.wait_for(arguments.state, end - time.monotonic())
    if arguments.json:
        print_json(status)
    else:
        print(f"mesh '{status.mesh}' is {status.state} at point {status.point}")
    return 0


RUNS: Runs = {"wait": _wait, **dict.fromkeys(("pause", "resume", "step", "stop"), _command)}
