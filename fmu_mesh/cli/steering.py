"""`pause`, `resume`, `step`, `reset`, `stop`, `checkpoint`, `wait`, `logs`, `play`: a running mesh is steered."""

from __future__ import annotations

import argparse
import os
import re
import sys
import time
from pathlib import Path
from typing import Final

from ..api.attaching import attach
from ..api.run_handle import Run
from ..errors import ConfigurationError, Interrupted
from ..printing import printable
from ..ros.bags.play_options import PlayOptions
from ..run.options import ResetOptions
from ..text import did_you_mean, listed, short_path
from ..wire.views import AuditView, CommandAnswer
from .arguments import Runs, reach, whole
from .mesh_arguments import LEVELS
from .output.json_output import print_json
from .run_options import given_options

__all__ = ["RUNS"]

_TIMEOUT_S = 5.0


def _command(arguments: argparse.Namespace) -> int:
    name, points = arguments.mesh, getattr(arguments, "points", None)
    if arguments.command == "step" and points is None and name is not None and _NUMBER.fullmatch(name):
        name, points = None, name  # `step 10`: no mesh has a number as its name
    number = whole(points) if points is not None else 1
    if number < 1:
        raise ConfigurationError(f"N: '{points}' is not a whole number of 1 or more")
    with attach(name, **reach(arguments)) as run:
        match arguments.command:
            case "step":
                answer: CommandAnswer | None = run.step(number)
            case "reset":
                answer = run.reset(**given_options(arguments, ResetOptions))
            case other:
                answer = _COMMANDS[other](run)
    assert answer is not None  # that of a mesh that was found
    if arguments.json:
        print_json(answer)
        return 0
    what = "is stopping" if answer.command == "stop" else f"is {answer.state}"
    print(f"mesh '{run.name}' {what} at point {answer.point}")
    return 0


_COMMANDS: Final = {"pause": Run.pause, "resume": Run.resume, "stop": Run.stop}
_NUMBER: Final = re.compile(r"[-+]?[0-9.].*")


def _checkpoint(arguments: argparse.Namespace) -> int:
    with attach(arguments.mesh, **reach(arguments)) as run:
        file = arguments.output or Path(f"{run.name}.state")
        point = run.checkpoint(file)
    if arguments.json:
        print_json({"mesh": run.name, "point": point, "file": str(file.absolute())})
    else:
        print(f"state of mesh '{run.name}' at point {point}: {short_path(file)}")
    return 0


def _wait(arguments: argparse.Namespace) -> int:
    # A mesh with a note is running or about to end; an endpoint may appear later.
    patience_s = arguments.timeout if arguments.connect else min(arguments.timeout, _TIMEOUT_S)
    end = time.monotonic() + arguments.timeout
    with attach(arguments.mesh, **{**reach(arguments), "timeout": patience_s}, wait=arguments.timeout) as run:
        status = run.wait_for(arguments.state, end - time.monotonic())
    if arguments.json:
        print_json(status)
    else:
        print(f"mesh '{status.mesh}' is {status.state} at point {status.point}")
    return 0


def _logs(arguments: argparse.Namespace) -> int:
    with attach(arguments.mesh, **reach(arguments)) as run:
        if arguments.instance not in {None, "mesh"} and arguments.instance not in (names := run.info().instances):
            hint = did_you_mean(arguments.instance, names, f"There are: {listed(names)}.")
            raise ConfigurationError(f"mesh '{run.name}' has no instance '{arguments.instance}'.", hint=hint)
        if arguments.audit:
            return _audit(run.audit(), as_json=arguments.json)
        try:
            for line in run.logs(follow=arguments.follow):
                if arguments.instance in (None, line.instance) and _rank(line.status) >= _rank(arguments.level):
                    if arguments.json:
                        print_json(line)
                        continue
                    text = " ".join(line.message.split())
                    print(f"{line.instance} at point {line.point}: {line.status.lower()}: {text}", flush=True)
        except KeyboardInterrupt:
            sys.stdout.flush()
            os._exit(Interrupted.exit_code)  # as `watch` does: closing a session in order can take long
    return 0


def _audit(audit: AuditView, *, as_json: bool) -> int:
    if audit.left_out:
        print(f"fmu-mesh: {audit.left_out} older entries are left out", file=sys.stderr)
    for entry in audit.entries:
        print_json(entry) if as_json else print(printable(f"{entry.time} at point {entry.point}: {entry}"))
    return 0


def _rank(status: str) -> int:
    """How severe a status is; one that FMI does not know is the least."""
    return LEVELS.index(status.lower()) if status.lower() in LEVELS else 0


def _play(arguments: argparse.Namespace) -> int:
    from ..ros.bags.bag import Bag  # noqa: PLC0415 only this needs it

    with (
        Bag(arguments.bag) as bag,  # first: what is wrong with it is told before anything about meshes
        attach(arguments.mesh, **reach(arguments)) as run,
    ):
        played = run.play(bag, **given_options(arguments, PlayOptions))
    names = ", ".join(played.topics)
    print(f"played {played.values} values of {names} from point {played.first} to point {played.last}")
    for several, why in (
        (played.merged, "were followed by another one for the same point"),
        (played.past, "were past already, and followed by another one"),
        (played.beyond, "are at or after the end of the simulation"),
    ):
        if several:
            print(f"{several} values {why}")
    return 0


RUNS: Runs = {
    "wait": _wait,
    "logs": _logs,
    "checkpoint": _checkpoint,
    "play": _play,
    **dict.fromkeys(("pause", "resume", "step", "reset", "stop"), _command),
}
