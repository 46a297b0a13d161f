"""`launch`, `rerun`, `node`, `master`, `gateway` and `router`: the commands that start processes of a mesh."""

# Signals: the first SIGINT or SIGTERM ends the run in order, and the second does not wait for its processes. The run
# has a thread of its own (`fmu_mesh.api.run_thread`), so the handler only tells it; before there is one, the handler
# raises KeyboardInterrupt. The handlers of before come back with the end of the run.
#
# A thread: Zenoh writes its log on the descriptor of standard output, and no callback gets it. So where strangers may
# knock, "refusals" reads what comes there (`_refusals_told`), until the descriptor is that of before.

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Final

from msgspec.structs import replace

from ..api.mesh_builder import Mesh
from ..api.result import Result, result_of
from ..api.run_handle import Run
from ..config.access_sections import given_folder, has_tls, why_open
from ..errors import ConfigurationError, FmuMeshError
from ..run.events import Event, EventWriter, Reachable, Status
from ..run.options import RerunOptions
from ..run.outcome import Outcome, outcome_at
from ..run.process import ended_by_signals
from ..run.run_plan import RunPlan
from ..run.wiring import identity_of, warnings_of
from ..system.plan import Plan
from ..wire.refused_links import RefusedLinks
from ..wire.session import Wiring, run_router
from .arguments import Runs
from .output.display import Display, summary, warn
from .output.profile_table import show_profile
from .output.reports import RunReporter
from .output.terminal import say, say_warning, stdout_as_stderr
from .plotting import check_plot, plot_results, plotted_where_it_ends
from .run_options import given_options, mesh_of

if TYPE_CHECKING:
    from ..sweeps.sweeping import Sweep

__all__ = ["RUNS", "finish", "interrupted_by_signals", "planned_run", "run_mesh"]

_STATUS_S: Final = 1.0
_STATUS_SHARE: Final = 0.002
"""Time between two statuses in a file, in s, and as a share of the run: a day has some three thousand of them."""
_READ_S: Final = 1.0
"""How long the end of a listener waits until its last refusals are said."""


def _launch(arguments: argparse.Namespace) -> int:
    with RunReporter(wanted=arguments.json) as reporter:
        options, how = given_options(arguments), _how(arguments)
        run_mesh(mesh_of(arguments), options, arguments, reporter, how)
    return 0


def _how(arguments: argparse.Namespace) -> dict[str, Any]:
    """How a run is started; refuses options that cannot be combined."""
    local = arguments.processes is False
    if local and arguments.paused:
        raise ConfigurationError("--paused is for a mesh that others can reach, and --local has none of it.")
    if local and arguments.profile:
        raise ConfigurationError("--profile measures nodes, and --local has none", hint="Leave one of them out.")
    if arguments.restarts and local:
        raise ConfigurationError("--restarts and --local do not go together", hint="Leave one of them out.")
    if arguments.resume and local:
        raise ConfigurationError("--resume and --local do not go together", hint="Leave one of them out.")
    return {"processes": not local, "restarts": arguments.restarts, "resume": arguments.resume is True}


def run_mesh(
    mesh: Mesh, options: dict[str, Any], arguments: argparse.Namespace, reporter: RunReporter, how: dict[str, Any]
) -> None:
    """Run a mesh, show its events, and at the end what the arguments ask for."""
    plan = planned_run(mesh, options, arguments)
    own = plan.loaded.config.recovery
    for given, value, none in ("mode", own.restarts and "restart", "stop"), ("directory", own.directory, "null"):
        if value and not how.get("processes", True):
            text = f"`recovery.{given}: {value}` and --local do not go together: all of it runs in one process"
            raise ConfigurationError(text, hint=f"Leave --local out, or add `--set-config recovery.{given}={none}`.")
    with (
        plotted_where_it_ends(plan.plan, getattr(arguments, "plot", None)),
        nullcontext() if how.get("processes", True) else stdout_as_stderr(),
    ):
        result = _shown(plan, arguments, reporter, how)
    finish(plan.plan, result, arguments)


def _shown(
    plan: RunPlan,
    arguments: argparse.Namespace,
    reporter: RunReporter,
    how: dict[str, Any],
    drive: Callable[[Run], None] = lambda _run: None,
) -> Result:
    """The result of a run whose events are shown; ``drive`` is called when it has started."""
    reporter.planned(plan)
    with (
        Display(
            plan.plan, show_progress=not arguments.no_progress, quiet=arguments.quiet, file=str(plan.loaded.file)
        ) as display,
        interrupted_by_signals() as runs,
    ):
        write = _also_written(lambda _event: None, getattr(arguments, "events", None))

        def show(event: Event) -> None:
            reporter.event(event)
            display.event(event)
            if not isinstance(event, Outcome):  # this process knows more than the master
                write(event)

        try:
            run = Run.start(plan, **how, on_event=show)
            runs.append(run)
            drive(run)
            result = run.wait()
        except FmuMeshError as error:
            known = error.result.outcome if error.result is not None else None
            write(replace(known or outcome_at(plan.plan, 0), state="failed", error=error.report()))
            raise
        assert result.outcome is not None  # it has run
        write(result.outcome)
        return result


def planned_run(mesh: Mesh, options: dict[str, Any], arguments: argparse.Namespace) -> RunPlan:
    """Plan the run of a command, and check what it shows at the end."""
    plan = mesh.plan(**options)
    _warn(plan, quiet=arguments.quiet)
    if getattr(arguments, "plot", None) is not None:
        check_plot(arguments.plot, plan)
    return plan


def _warn(plan: RunPlan, *, quiet: bool = False, every: bool = True) -> None:
    """Show the warnings before a run; of one process of several only those that concern its connections."""
    told = warnings_of(plan)  # also where nothing is said: a wrong certificate is found before anything is started
    if quiet:
        return
    if every:
        warn(plan.plan)
        told = [text for text in told if text not in map(str, plan.plan.system.warnings)]
    for text in told:
        say_warning(text)


@contextmanager
def interrupted_by_signals() -> Iterator[list[Run | Sweep]]:
    """Inside, Ctrl-C and SIGTERM end the run in the list that this yields, instead of this process."""
    runs: list[Run | Sweep] = []

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        if not runs:
            raise KeyboardInterrupt
        runs[0].interrupt()

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield runs
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def finish(plan: Plan, result: Result, arguments: argparse.Namespace) -> None:
    """Show what the arguments ask for of a run that has ended, and its summary."""
    outcome = result.outcome
    assert outcome is not None  # it has run
    if outcome.profile is not None:
        file = arguments.profile if isinstance(arguments.profile, Path) else None
        show_profile(plan, outcome.profile, outcome.seconds, file)
    if (video := getattr(arguments, "video", None)) is not None:
        print(f"video: {video}")
    if (plot := getattr(arguments, "plot", None)) is not None:
        plot_results(result, plot, plan)
    for line in summary(plan, outcome):
        print(line)


def _node(arguments: argparse.Namespace) -> int:
    from ..run.host_nodes import nodes_on, run_nodes  # noqa: PLC0415  only this command needs it
    from ..run.roles import run_node  # noqa: PLC0415 `launch` has the fork server for it

    if arguments.node is not None and arguments.host is not None:
        raise ConfigurationError("--host starts all nodes of a host, and INSTANCE one", hint="Leave one of them out.")
    plan = mesh_of(arguments).plan(**given_options(arguments))
    names = [arguments.node] if arguments.node is not None else nodes_on(plan, arguments.host)
    _warn(plan, every=False)
    if len(names) > 1:
        return run_nodes(plan, names, say)
    run_node(plan.node(names[0]))
    return 0


def _master(arguments: argparse.Namespace) -> int:
    from ..run.roles import run_master  # noqa: PLC0415 as above

    plan = planned_run(mesh_of(arguments), given_options(arguments), arguments)
    with (
        plotted_where_it_ends(plan.plan, arguments.plot),
        Display(
            plan.plan,
            show_progress=not arguments.no_progress,
            quiet=arguments.quiet,
            waits_for_nodes=False,
            file=str(plan.loaded.file),
        ) as display,
        _refusals_told() if identity_of(plan) is not None else nullcontext(),
    ):
        outcome = run_master(plan, _also_written(display.event, arguments.events))
    finish(plan.plan, result_of(plan, outcome), arguments)
    return 0


def _also_written(show: Callable[[Event], None], file: Path | None) -> Callable[[Event], None]:
    """What takes events, and also writes them into a file; a status once a second, and in a long run less often."""
    if file is None:
        return show
    try:
        write = EventWriter(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600))
    except OSError as error:
        raise ConfigurationError(f"the events cannot be written into '{file}': {error.strerror}") from error
    began = due = time.monotonic()

    def taken(event: Event) -> None:
        nonlocal due
        show(event)
        now = time.monotonic()
        if not isinstance(event, Status) or now >= due:
            due = now + max(_STATUS_S, _STATUS_SHARE * (now - began))
            write(event)

    return taken


def _gateway(arguments: argparse.Namespace) -> int:
    from ..run.gateway_role import run_gateway  # noqa: PLC0415 as above

    def show(event: Event) -> None:
        if isinstance(event, Reachable):
            print(f"topics of ROS at {', '.join(event.endpoints)}", flush=True)

    plan = mesh_of(arguments).plan(**given_options(arguments))
    _warn(plan, quiet=arguments.quiet, every=False)
    run_gateway(plan, show)
    return 0


def _router(arguments: argparse.Namespace) -> int:
    stop = threading.Event()
    wiring = _router_wiring(arguments)
    with (
        ended_by_signals(lambda _reason: stop.set(), lambda: None, watch_stdin=False),
        _refusals_told() if wiring.identity is not None else nullcontext(),
        run_router(wiring) as where,
    ):
        for _, text in why_open({"--listen": wiring.listen}, secured=wiring.identity is not None):
            say_warning(text)
        print(f"router at {', '.join(where)}", flush=True)
        stop.wait()
    sys.stdout.flush()
    return 0


def _router_wiring(arguments: argparse.Namespace) -> Wiring:
    """Where a router listens, and who may do what there; warns of a certificate that ends soon."""
    if arguments.insecure and arguments.security is not None:
        raise ConfigurationError("--security and --insecure do not go together", hint="Leave one of them out.")
    listen = tuple(arguments.listen or ["tcp/127.0.0.1:7447"])
    folder = given_folder(arguments.security) if arguments.security or any(map(has_tls, listen)) else None
    own = None
    if folder is not None and not arguments.insecure:
        from ..wire.security.certificates import identity_in  # noqa: PLC0415  most routers have no certificate
        from ..wire.security.identity import warnings_about  # noqa: PLC0415  as above

        own = identity_in(folder)
        for text in warnings_about(own):
            say_warning(text)
    root, ends = f"{arguments.key_prefix}/*", tuple(arguments.end)
    return Wiring(listen=listen, insecure=arguments.insecure, identity=own, root=root, ends=ends)


@contextmanager
def _refusals_told() -> Iterator[None]:
    """In the block, what Zenoh writes on standard output about links that it has refused goes to standard error."""
    sys.stdout.flush()
    stdout = os.dup(1)
    reading, writing = os.pipe()
    os.dup2(writing, 1)
    os.close(writing)

    def read() -> None:
        with os.fdopen(reading, "rb") as lines:
            links = RefusedLinks()
            for line in lines:
                refused = links.told(line.decode(errors="replace").rstrip())
                if refused:
                    say(refused)
                elif refused is None:
                    os.write(stdout, line)

    reader = threading.Thread(target=read, name="refusals", daemon=True)
    reader.start()
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(stdout, 1)
        reader.join(_READ_S)
        os.close(stdout)


def _rerun(arguments: argparse.Namespace) -> int:
    from ..api.rerunning import planned_rerun  # noqa: PLC0415 as above

    with RunReporter(wanted=arguments.json) as reporter:
        again = planned_rerun(arguments.result, **given_options(arguments, RerunOptions))
        plan = again.plan.plan
        if not arguments.quiet:
            warn(plan)
        outcome = _shown(again.plan, arguments, reporter, {}, again.drive).outcome
        assert outcome is not None  # it has run
        for line in summary(plan, outcome):
            print(line)
        assert outcome.file is not None  # it records what the first run has recorded
        comparison = again.first.compare(Result.read(outcome.file))
        if not comparison.equal:
            print(comparison.text)
            raise FmuMeshError(f"the values are not those of '{arguments.result}'.")
        # It was to end where the first run has ended, which may have been stopped.
        reporter.event(replace(outcome, state="done"))
        print(f"every value is that of '{arguments.result}'")
    return 0


RUNS: Runs = {
    "launch": _launch,
    "node": _node,
    "master": _master,
    "gateway": _gateway,
    "router": _router,
    "rerun": _rerun,
}
