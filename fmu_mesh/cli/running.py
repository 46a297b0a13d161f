"""`launch`, `node`, `master`, `gateway` and `router`: the commands that start processes of a mesh."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from pathlib import Path
from types import FrameType
from typing import Any

from msgspec.structs import replace

from ..errors import ConfigurationError, MeshLost
from ..run.events import Event, Reachable
from ..run.gateway_role import run_gateway
from ..run.in_process import InProcessRun
from ..run.launcher import Launcher
from ..run.options import Options
from ..run.outcome import Outcome
from ..run.preparing import plan_run
from ..run.process import ended_by_signals
from ..run.roles import run_master, run_node
from ..run.run_plan import RunPlan
from ..system.plan import Plan
from ..wire.session import run_router
from .arguments import add_command, add_options, count, endpoint, read_options
from .output.display import Display, say, stdout_as_stderr, summary, warn
from .output.profile_table import show_profile
from .plotting import check_plot, plot_results, plotted_where_it_ends

__all__ = ["add_commands", "finish", "run_launcher"]


def add_commands(commands: argparse._SubParsersAction[Any], common: argparse.ArgumentParser) -> None:
    """Add the commands of this module."""
    launch = add_command(commands, "launch", "run a mesh: one process per node, and the master", [common])
    _add_config(launch, "paused", "allow_code", "view", "video", "profile")
    launch.add_argument("--local", action="store_true", help="run everything in this one process")
    launch.add_argument("--plot", type=Path, metavar="FILE.png", help="plot the result at the end")
    launch.add_argument(
        "--restarts",
        type=count,
        default=0,
        metavar="N",
        help="restart from the first point when a node or the master is lost, at most N times",
    )
    launch.add_argument("--no-progress", action="store_true", help="no progress line")
    launch.set_defaults(run_command=_launch)

    node = add_command(commands, "node", "start one node manually", [common])
    _add_config(node, "allow_code", "view", "video")
    node.add_argument("node", metavar="INSTANCE", help="name of the instance, or of its group")
    node.set_defaults(run_command=_node)

    master = add_command(commands, "master", "start the master and the recorder manually", [common])
    _add_config(master, "paused", "allow_code", "profile")
    master.add_argument("--plot", type=Path, metavar="FILE.png", help="plot the result at the end")
    master.add_argument("--no-progress", action="store_true", help="no progress line")
    master.set_defaults(run_command=_master)

    gateway = add_command(commands, "gateway", "start the gateway to ROS manually", [common])
    _add_config(gateway, "allow_code")
    gateway.set_defaults(run_command=_gateway)

    router = add_command(commands, "router", "run a Zenoh router", [common])
    router.add_argument(
        "--listen",
        type=endpoint,
        action="append",
        metavar="ENDPOINT",
        help="endpoint where others can connect; repeatable; default: tcp/127.0.0.1:7447",
    )
    router.set_defaults(run_command=_router)


def _add_config(parser: argparse.ArgumentParser, *options: str) -> None:
    parser.add_argument("config", type=Path, metavar="CONFIG", help="the configuration file")
    instead = parser.add_argument_group("instead of what CONFIG says")
    add_options(instead, "window", "start_values", "real_time_factor", "output", "listen", "connect")
    add_options(parser, *options)


def _options(arguments: argparse.Namespace) -> Options:
    """The options of a command.

    Raises:
        ConfigurationError: two of them cannot be combined.
    """
    options = read_options(arguments)
    if options.view and options.video is not None:
        raise ConfigurationError("--view and --video do not go together", hint="Leave one of them out.")
    return options


def _launch(arguments: argparse.Namespace) -> int:
    options = _options(arguments)
    if arguments.local and options.paused:
        raise ConfigurationError("--paused is for a mesh that others can reach, and --local has none of it.")
    if arguments.local and options.profile:
        raise ConfigurationError("--profile measures nodes, and --local has none", hint="Leave one of them out.")
    if arguments.restarts and (arguments.local or options.paused):
        other = "--local" if arguments.local else "--paused"
        raise ConfigurationError(f"--restarts and {other} do not go together", hint="Leave one of them out.")
    run = _planned(arguments, options)
    with (
        plotted_where_it_ends(run.plan, arguments.plot),
        Display(run.plan, show_progress=not arguments.no_progress) as display,
    ):
        outcome = _run_local(run, display) if arguments.local else _run_processes(run, arguments.restarts, display)
    finish(run.plan, outcome, arguments)
    return 0


def _planned(arguments: argparse.Namespace, options: Options) -> RunPlan:
    """Plan the run of a command, and check what it shows at the end."""
    run = plan_run(arguments.config, options, say)
    warn(run.plan)
    if arguments.plot is not None:
        check_plot(arguments.plot, run.plan.system.result_file)
    return run


def _run_processes(run: RunPlan, most_restarts: int, display: Display) -> Outcome:
    """Run the mesh; if a process of it is lost, run it again from its first point, as often as `--restarts` allows."""
    while True:
        try:
            return run_launcher(Launcher(run, display.event))
        except MeshLost as error:
            if run.restarts == most_restarts or type(error) is not MeshLost:
                raise
            run = replace(run, restarts=run.restarts + 1)
            again = f"The run starts again from its first point (restart {run.restarts} of {most_restarts})."
            say(str(error.instead_of_hint(again)))


def run_launcher(launcher: Launcher | InProcessRun) -> Outcome:
    """Run it; Ctrl-C and SIGTERM end the run instead of this process."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        launcher.interrupt()

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        return launcher.run()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _run_local(run: RunPlan, display: Display) -> Outcome:
    with stdout_as_stderr():
        outcome = run_launcher(InProcessRun(run, display.event))
    display.event(outcome)
    return outcome


def finish(plan: Plan, outcome: Outcome, arguments: argparse.Namespace) -> None:
    """Show what the options of the command ask for, and print the summary."""
    if outcome.profile is not None:
        show_profile(plan, outcome.profile, outcome.seconds, arguments.profile)
    if (video := getattr(arguments, "video", None)) is not None:
        print(f"video: {video}")
    plot = getattr(arguments, "plot", None)
    if plot is not None and outcome.file is not None:
        plot_results(Path(outcome.file), plot, plan)
    for line in summary(plan, outcome):
        print(line)


def _node(arguments: argparse.Namespace) -> int:
    run_node(plan_run(arguments.config, _options(arguments)).node(arguments.node))
    return 0


def _master(arguments: argparse.Namespace) -> int:
    run = _planned(arguments, _options(arguments))
    with (
        plotted_where_it_ends(run.plan, arguments.plot),
        Display(run.plan, show_progress=not arguments.no_progress, waits_for_nodes=False) as display,
    ):
        outcome = run_master(run, display.event)
    finish(run.plan, outcome, arguments)
    return 0


def _gateway(arguments: argparse.Namespace) -> int:
    def show(event: Event) -> None:
        if isinstance(event, Reachable):
            print(f"topics of ROS at {', '.join(event.endpoints)}", flush=True)

    run_gateway(plan_run(arguments.config, _options(arguments)), show)
    return 0


def _router(arguments: argparse.Namespace) -> int:
    stop = threading.Event()
    endpoints = arguments.listen or ["tcp/127.0.0.1:7447"]
    with ended_by_signals(lambda _reason: stop.set(), lambda: None, watch_stdin=False), run_router(endpoints) as where:
        print(f"router at {', '.join(where)}", flush=True)
        stop.wait()
    sys.stdout.flush()
    return 0
