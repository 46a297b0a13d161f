"""`launch`, `node`, `master`, `gateway` and `router`: the commands that run something."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from pathlib import Path
from types import FrameType
from typing import Any

from msgspec.structs import replace

from ..errors import ConfigurationError, FmuError, FmuMeshError, MeshLost
from ..instances.mujoco import check_film, check_window
from ..instances.registry import Showing
from ..run.events import Event, EventWriter, Reachable
from ..run.gateway_role import run_gateway
from ..run.launcher import PLANNED, Launcher
from ..run.options import Options
from ..run.outcome import Outcome
from ..run.preparing import plan_run
from ..run.process import ended_by_signals
from ..run.roles import run_local, run_master, run_node
from ..run.run_plan import RunPlan, read_node, read_run
from ..system.plan import Plan
from ..wire.router import run_router
from .arguments import add_command, add_window, count, endpoint, number
from .output.display import Display, say, stdout_as_stderr, summary, warn
from .output.profile_table import add_profile, show_profile
from .plotting import check_plot, plot_results, plotted_where_it_ends

__all__ = ["add_commands", "finish", "run_launcher"]


def add_commands(commands: argparse._SubParsersAction[Any], common: argparse.ArgumentParser) -> None:
    """Add the commands of this module."""
    launch = add_command(commands, "launch", "run a mesh: one process per node, and the master", [common])
    _add_config(launch)
    launch.add_argument("--local", action="store_true", help="run everything in this one process")
    _add_paused(launch)
    launch.add_argument("--plot", type=Path, metavar="FILE.png", help="plot the result when done")
    launch.add_argument(
        "--restarts",
        type=count,
        default=0,
        metavar="N",
        help="start again from the first point when a node or the master is lost, N times at most",
    )
    launch.add_argument("--no-progress", action="store_true", help="no progress line")
    _add_showing(launch)
    add_profile(launch)
    launch.set_defaults(run_command=_launch)

    node = add_command(commands, "node", "run one node by hand", [common])
    _add_config(node)
    node.add_argument("node", metavar="INSTANCE", help="name of the instance, or of its group")
    _add_showing(node)
    node.add_argument(PLANNED, action="store_true", help=argparse.SUPPRESS)
    node.set_defaults(run_command=_node)

    master = add_command(commands, "master", "run the master and the recorder by hand", [common])
    _add_config(master)
    _add_paused(master)
    master.add_argument("--plot", type=Path, metavar="FILE.png", help="plot the result when done")
    master.add_argument("--no-progress", action="store_true", help="no progress line")
    add_profile(master)
    master.add_argument(PLANNED, action="store_true", help=argparse.SUPPRESS)
    master.set_defaults(run_command=_master)

    gateway = add_command(commands, "gateway", "run the gateway to ROS by hand", [common])
    _add_config(gateway)
    gateway.add_argument(PLANNED, action="store_true", help=argparse.SUPPRESS)
    gateway.set_defaults(run_command=_gateway)

    router = add_command(commands, "router", "run a Zenoh router", [common])
    router.add_argument(
        "--listen",
        type=endpoint,
        action="append",
        metavar="ENDPOINT",
        help="listen there; repeatable; default: tcp/127.0.0.1:7447",
    )
    router.set_defaults(run_command=_router)


def _add_config(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("config", type=Path, metavar="CONFIG", help="the configuration file")
    add_window(parser)
    parser.add_argument(
        "--set", action="append", default=[], metavar="INSTANCE.VARIABLE=VALUE", help="another start value; repeatable"
    )
    parser.add_argument(
        "--real-time-factor",
        type=number,
        metavar="F",
        help="1: wall clock; 2: twice as fast; 0: as fast as possible; default: that of the configuration",
    )
    parser.add_argument("--output", type=Path, metavar="FILE", help="another result file, .csv or .mcap")
    parser.add_argument(
        "--connect",
        type=endpoint,
        action="append",
        default=[],
        metavar="ENDPOINT",
        help="connect there, such as tcp/HOST:PORT, instead of to zenoh.connect of the configuration; repeatable",
    )
    parser.add_argument(
        "--listen",
        type=endpoint,
        action="append",
        default=[],
        metavar="ENDPOINT",
        help="let the master listen there, such as at tcp/0.0.0.0:7447, instead of at zenoh.listen; repeatable",
    )


def _add_showing(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--view", action="store_true", help="show the world of the physics engine in a window")
    parser.add_argument(
        "--video", type=Path, metavar="FILE.mp4", help="make a film of that world, .mp4 or .gif; needs no screen"
    )


def _showing(arguments: argparse.Namespace) -> Showing:
    """What `--view` and `--video` ask for, if it can be done here."""
    video: Path | None = getattr(arguments, "video", None)
    showing = Showing(view=getattr(arguments, "view", False), video=video.absolute() if video is not None else None)
    if showing.view and showing.video is not None:
        raise ConfigurationError("--view and --video do not go together", hint="Leave one of them out.")
    if showing.view:
        check_window()
    if showing.video is not None:
        check_film(showing.video)
    return showing


def _add_paused(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--paused", action="store_true", help="rest at the first point until `resume`, `step` or `play`"
    )


def _options(arguments: argparse.Namespace) -> Options:
    return Options(
        start_values=tuple(arguments.set),
        window=arguments.window,
        real_time_factor=arguments.real_time_factor,
        output=arguments.output,
        connect=tuple(arguments.connect),
        listen=tuple(arguments.listen),
        profile=getattr(arguments, "profile", None) is not None,
        showing=_showing(arguments),
        paused=getattr(arguments, "paused", False),
    )


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
            return run_launcher(Launcher(run, display.event, display.output))
        except MeshLost as error:
            if run.restarts == most_restarts or type(error) is not MeshLost:
                raise
            run = replace(run, restarts=run.restarts + 1)
            error.hint = None
            again = f"The run starts again from its first point (restart {run.restarts} of {most_restarts})."
            say(str(error.with_hint(again)))


def run_launcher(launcher: Launcher) -> Outcome:
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
    def show_hang(error: FmuError) -> None:
        display.flush(str(error))
        print(f"fmu-mesh: {error}", file=sys.stderr, flush=True)

    with stdout_as_stderr():
        outcome = run_local(run, display.log, display.progress, show_hang)
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
    if arguments.planned:
        run_node(read_node(arguments.config, arguments.node))
    else:
        run_node(plan_run(arguments.config, _options(arguments)).node(arguments.node))
    return 0


def _master(arguments: argparse.Namespace) -> int:
    if arguments.planned:
        try:
            run_master(read_run(arguments.config), EventWriter())
        except FmuMeshError as error:
            raise error.already_reported()  # noqa: B904 the launcher has the event and shows it
        return 0
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

    if arguments.planned:
        run_gateway(read_run(arguments.config), EventWriter())
    else:
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
