"""`launch`, `node`, `master`, `gateway` and `router`: the commands that start processes of a mesh."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from pathlib import Path
from types import FrameType
from typing import Any

from ..config.loading import LoadedConfig
from ..errors import ConfigurationError, FmuError, FmuMeshError, MeshLost
from ..instances.contract import LogMessage, Showing
from ..run.events import End, Event, EventWriter, Ready
from ..run.gateway_role import run_gateway
from ..run.launcher import Launcher
from ..run.local import LocalMesh
from ..run.options import Options
from ..run.preparing import prepare
from ..run.process import ended_by_signals
from ..run.roles import BY_HAND, run_master, run_node
from ..system.plan import Plan
from ..wire.runtime import enter_run_folder, fmu_folder, leave_run_folder, remove_stale_folders, run_folder
from ..wire.session import run_router
from ..wire.time_profile import MeshProfile
from ..wire.views import LogLine
from .arguments import add_command, add_options, count, endpoint, read_options
from .output.display import Display, say, stdout_as_stderr, summary, warn
from .output.profile_table import show_profile
from .plotting import check_plot, plot_results, plotted_where_it_ends

__all__ = ["add_commands", "close", "run_launcher"]


def add_commands(commands: argparse._SubParsersAction[Any], common: argparse.ArgumentParser) -> None:
    """Add the commands of this module."""
    launch = add_command(commands, "launch", "run a mesh: one process per node, and the master", [common])
    _add_config(launch, "paused", "view", "video", "profile")
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
    _add_config(node, "view", "video")
    node.add_argument("node", metavar="INSTANCE", help="name of the instance, or of its group")
    node.add_argument("--plan", type=Path, help=argparse.SUPPRESS)
    node.add_argument("--run", default=BY_HAND, help=argparse.SUPPRESS)
    node.set_defaults(run_command=_node)

    master = add_command(commands, "master", "start the master and the recorder manually", [common])
    _add_config(master, "paused", "profile")
    master.add_argument("--plot", type=Path, metavar="FILE.png", help="plot the result at the end")
    master.add_argument("--no-progress", action="store_true", help="no progress line")
    master.add_argument("--events", action="store_true", help=argparse.SUPPRESS)
    master.add_argument("--run", default=BY_HAND, help=argparse.SUPPRESS)
    master.set_defaults(run_command=_master)

    gateway = add_command(commands, "gateway", "start the gateway to ROS manually", [common])
    _add_config(gateway)
    gateway.add_argument("--events", action="store_true", help=argparse.SUPPRESS)
    gateway.add_argument("--run", default=BY_HAND, help=argparse.SUPPRESS)
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
        ConfigurationError: `--view` or `--video` is not possible on this host.
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
    plan = prepare(arguments.config, options, say)
    warn(plan)
    if arguments.plot is not None:
        check_plot(arguments.plot, plan.system.result_file)
    profile: MeshProfile | None = None
    with (
        plotted_where_it_ends(plan, arguments.plot),
        Display(plan, show_progress=not arguments.no_progress) as display,
    ):
        if arguments.local:
            point, seconds, rows = _run_local(plan, arguments.config, display, options.showing)
        else:
            end = _run_processes(plan, arguments, options, display)
            point, seconds, rows, profile = end.status.point, end.seconds, end.rows, end.profile
    if profile is not None:
        show_profile(plan, profile, seconds, options.profile or Path())
    if arguments.video is not None:
        print(f"video: {arguments.video}")
    close(plan, point, seconds, rows, arguments.plot)
    return 0


def _run_processes(plan: Plan, arguments: argparse.Namespace, options: Options, display: Display) -> End:
    """Run the mesh, and again from its first point as often as `--restarts` allows if a process of it is lost."""
    restarts = 0
    while True:
        launcher = Launcher(plan, arguments.config, options, display.event, display.output, restarts=restarts)
        try:
            return run_launcher(launcher)
        except MeshLost as error:
            if restarts == arguments.restarts or type(error) is not MeshLost:
                raise
            restarts += 1
            error.hint = f"The run starts again from its first point (restart {restarts} of {arguments.restarts})."
            say(str(error))


def run_launcher(launcher: Launcher) -> End:
    """Run it; Ctrl-C and SIGTERM end the run instead of this process."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        launcher.interrupt()

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        return launcher.run()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _run_local(plan: Plan, config: Path, display: Display, showing: Showing) -> tuple[int, float, int]:
    def log(message: LogMessage) -> None:
        line = LogLine(message.instance, message.status, message.category, message.message, mesh.point)
        display.log(line)

    def clean_up() -> None:
        mesh.clean_up()
        leave_run_folder(folder)

    def end(error: FmuError) -> None:
        """The thread in the FMU cannot be got back."""
        clean_up()
        display.flush(str(error))
        print(f"fmu-mesh: {error}", file=sys.stderr, flush=True)
        os._exit(error.exit_code)

    remove_stale_folders()
    folder = run_folder(plan.system.config.mesh, BY_HAND)
    enter_run_folder(folder, f"local {os.getpid()}")
    fmus = fmu_folder(folder)
    fmus.mkdir(parents=True, exist_ok=True)
    mesh = LocalMesh(
        plan,
        log,
        display.progress,
        on_hang=end,
        parent=fmus,
        showing=showing,
        loaded=LoadedConfig(plan.system.config, config),
    )
    try:
        with stdout_as_stderr(), ended_by_signals(mesh.interrupt, clean_up, watch_stdin=False):
            mesh.run()
    finally:
        leave_run_folder(folder)
    if mesh.ended_by is not None:
        display.ended(mesh.ended_by)
    return mesh.point, mesh.seconds, mesh.rows


def close(plan: Plan, point: int, seconds: float, rows: int, plot: Path | None) -> None:
    """Plot if wanted, and print the summary."""
    result = plan.system.result_file
    if plot is not None and result is not None:
        plot_results(Path(result), plot, plan)
    for line in summary(plan, point=point, seconds=seconds, rows=rows, result_file=result):
        print(line)


def _node(arguments: argparse.Namespace) -> int:
    run_node(arguments.config, arguments.node, _options(arguments), plan_file=arguments.plan, run=arguments.run)
    return 0


def _master(arguments: argparse.Namespace) -> int:
    options = _options(arguments)
    if arguments.events:
        try:
            run_master(arguments.config, options, EventWriter(), run=arguments.run)
        except FmuMeshError as error:
            return error.exit_code  # the launcher has the event, and tells
        return 0
    plan = prepare(arguments.config, options, say)
    warn(plan)
    if arguments.plot is not None:
        check_plot(arguments.plot, plan.system.result_file)
    ends: list[End] = []

    def show(event: Event) -> None:
        display.event(event)
        if isinstance(event, End):
            ends.append(event)

    with (
        plotted_where_it_ends(plan, arguments.plot),
        Display(plan, show_progress=not arguments.no_progress, waits_for_nodes=False) as display,
    ):
        run_master(arguments.config, options, show, plan=plan)
    if ends[0].profile is not None:
        show_profile(plan, ends[0].profile, ends[0].seconds, options.profile or Path())
    close(plan, ends[0].status.point, ends[0].seconds, ends[0].rows, arguments.plot)
    return 0


def _gateway(arguments: argparse.Namespace) -> int:
    def show(event: Event) -> None:
        if isinstance(event, Ready):
            print(f"topics of ROS at {', '.join(event.endpoints)}", flush=True)

    emit = EventWriter() if arguments.events else show
    run_gateway(arguments.config, _options(arguments), emit, run=arguments.run)
    return 0


def _router(arguments: argparse.Namespace) -> int:
    stop = threading.Event()
    endpoints = arguments.listen or ["tcp/127.0.0.1:7447"]
    with ended_by_signals(lambda _reason: stop.set(), lambda: None, watch_stdin=False), run_router(endpoints) as where:
        print(f"router at {', '.join(where)}", flush=True)
        stop.wait()
    sys.stdout.flush()
    return 0
