"""`launch`, `node`, `master`, `gateway` and `router`: the commands that start processes of a mesh."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from pathlib import Path
from types import FrameType

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
from .arguments import CommandParser, Parsers, add_json, add_quiet, count, endpoint
from .output.display import Display, say, stdout_as_stderr, summary, teller, warn
from .output.profile_table import show_profile
from .output.reports import RunReporter
from .plotting import check_plot, plot_results, plotted_where_it_ends
from .run_options import add_configuration, add_options, read_options

__all__ = ["PARSERS", "add_output", "finish", "run_launcher"]


def _add_launch(parser: CommandParser) -> None:
    add_configuration(parser)
    add_options(parser, "paused", "view", "video", "profile")
    parser.add_argument("--local", action="store_true", help="run everything in this one process")
    _add_plot(parser)
    parser.add_argument(
        "--restarts",
        type=count,
        default=0,
        metavar="N",
        help="restart from the first point when a node or the master is lost, at most N times",
    )
    add_output(parser)
    add_json(parser, "print the outcome as one JSON object, and nothing else on standard output")
    parser.set_defaults(run_command=_launch)


def _add_node(parser: CommandParser) -> None:
    add_configuration(parser)
    add_options(parser, "view", "video")
    parser.add_argument("node", metavar="INSTANCE", help="name of the instance, or of its group")
    parser.set_defaults(run_command=_node)


def _add_master(parser: CommandParser) -> None:
    add_configuration(parser)
    add_options(parser, "paused", "profile")
    _add_plot(parser)
    add_output(parser)
    parser.set_defaults(run_command=_master)


def _add_gateway(parser: CommandParser) -> None:
    add_configuration(parser)
    add_quiet(parser)
    parser.set_defaults(run_command=_gateway)


def _add_router(parser: CommandParser) -> None:
    parser.add_argument(
        "--listen",
        type=endpoint,
        action="append",
        metavar="ENDPOINT",
        help="endpoint where others can connect; repeatable; default: tcp/127.0.0.1:7447",
    )
    add_quiet(parser)
    parser.set_defaults(run_command=_router)


def _add_plot(parser: CommandParser) -> None:
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="plot the result at the end")


def add_output(parser: CommandParser) -> None:
    """Add the flags for what a run prints."""
    parser.add_argument("--no-progress", action="store_true", help="no progress line")
    add_quiet(parser)


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
    with RunReporter(wanted=arguments.json) as reporter:
        run = _planned(arguments, _launch_options(arguments))
        with (
            plotted_where_it_ends(run.plan, arguments.plot),
            Display(run.plan, show_progress=not arguments.no_progress, quiet=arguments.quiet) as display,
        ):
            if arguments.local:
                outcome = _run_local(run, display, reporter)
            else:
                outcome = _run_processes(run, arguments.restarts, display, reporter)
        finish(run.plan, outcome, arguments)
    return 0


def _launch_options(arguments: argparse.Namespace) -> Options:
    options = _options(arguments)
    if arguments.local and options.paused:
        raise ConfigurationError("--paused is for a mesh that others can reach, and --local has none of it.")
    if arguments.local and options.profile:
        raise ConfigurationError("--profile measures nodes, and --local has none", hint="Leave one of them out.")
    if arguments.restarts and (arguments.local or options.paused):
        other = "--local" if arguments.local else "--paused"
        raise ConfigurationError(f"--restarts and {other} do not go together", hint="Leave one of them out.")
    return options


def _planned(arguments: argparse.Namespace, options: Options) -> RunPlan:
    """Plan the run of a command, and check what it shows at the end."""
    run = plan_run(arguments.config, options, teller(quiet=arguments.quiet))
    if not arguments.quiet:
        warn(run.plan)
    if arguments.plot is not None:
        check_plot(arguments.plot, run.plan.system.result_file)
    return run


def _run_processes(run: RunPlan, most_restarts: int, display: Display, reporter: RunReporter) -> Outcome:
    """Run the mesh; if a process of it is lost, run it again from its first point, as often as `--restarts` allows."""
    while True:
        try:
            return run_launcher(Launcher(run, display.event), run, reporter)
        except MeshLost as error:
            if run.restarts == most_restarts or type(error) is not MeshLost:
                raise
            run = replace(run, restarts=run.restarts + 1)
            again = f"The run starts again from its first point (restart {run.restarts} of {most_restarts})."
            say(str(error.instead_of_hint(again)))


def run_launcher(launcher: Launcher | InProcessRun, run: RunPlan, reporter: RunReporter) -> Outcome:
    """Run it; Ctrl-C and SIGTERM end the run instead of this process."""
    reporter.started(run, launcher)

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        launcher.interrupt()

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        return launcher.run()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _run_local(run: RunPlan, display: Display, reporter: RunReporter) -> Outcome:
    with stdout_as_stderr():
        outcome = run_launcher(InProcessRun(run, display.event), run, reporter)
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
        Display(
            run.plan, show_progress=not arguments.no_progress, quiet=arguments.quiet, waits_for_nodes=False
        ) as display,
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


PARSERS: Parsers = {
    "launch": _add_launch,
    "node": _add_node,
    "master": _add_master,
    "gateway": _add_gateway,
    "router": _add_router,
}
