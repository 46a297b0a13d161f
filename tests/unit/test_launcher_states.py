"""What the launcher decides, in the orders of events that are hard to get from real processes: no process, no clock."""

from __future__ import annotations

import signal
from collections.abc import Sequence

import pytest

from fmu_mesh.config.deadlines import Deadlines
from fmu_mesh.config.mesh import TimeoutsConfig
from fmu_mesh.errors import DeadlineExceeded, FmuMeshError, Interrupted, MeshLost, StepFailed
from fmu_mesh.run.events import Event, Status
from fmu_mesh.run.launcher_states import (
    GATEWAY,
    SERVER,
    THE_MASTER,
    Action,
    FinishServer,
    LaunchStates,
    LaunchTerms,
    Look,
    Signal,
    Start,
)
from fmu_mesh.run.outcome import Outcome
from fmu_mesh.wire.host_processes import STOPPED
from fmu_mesh.wire.views import MeshState, MeshStatus

LIMITS = Deadlines.of(TimeoutsConfig(start=60.0, step=5.0, link=30.0, stop=10.0))
DONE = Outcome("done", 100, 1.0, 0.5, 101, "pair.csv")


class Launch:
    """A launch without processes: those that run are in a set, and the time is a number."""

    def __init__(self, *, gateway: bool = False) -> None:
        nodes = {"pendulum": ["pendulum"], "both": ["delay", "gain"]}
        self.states = LaunchStates(LaunchTerms(nodes, LIMITS, has_gateway=gateway))
        self.now = 0.0
        self.running: set[str] = set()
        self.stopped: set[str] = set()
        self.done: list[Action] = []
        self._do(self.states.begin())

    def ended(self, *ends: tuple[str, int]) -> None:
        for name, code in ends:
            self.running.discard(name)
            self.states.ended(name, code, self.now)
            self._go_on()

    def reported(self, event: Event) -> None:
        self.states.reported(event, self.now)
        self._go_on()

    def gateway_ready(self) -> None:
        self._do(self.states.gateway_ready())
        self._go_on()

    def interrupted(self) -> None:
        self._do(self.states.interrupted(self.now))
        self._go_on()

    def ends_silently(self, name: str) -> None:
        """A process ends, and no event says it."""
        self.running.discard(name)

    def passes(self, seconds: float, *, quiet: bool = True) -> None:
        """Time passes in steps that are as long as the launcher waits for an event."""
        until = self.now + seconds
        while self.now < until and not self.states.is_over:
            self.now = min(self.now + self.states.wait_s, until)
            self._go_on(quiet=quiet)

    def status(self, state: MeshState = "running", point: int = 7) -> None:
        self.reported(Status(MeshStatus("pair", state, point, 100, point / 100, 0.0, 0.0, {})))

    def fails(self, error: FmuMeshError, *, by: str | None = None) -> None:
        self.reported(Outcome("failed", 9, 0.09, 0.5, 10, "pair.csv", error.report(), signal=by))

    def ends(self) -> Sequence[Action]:
        """Let the time pass until the end, which has to come; returns what was done for it."""
        self.done.clear()
        self._do(self.states.end(self.now))
        self.passes(2 * LIMITS.finish)
        assert self.states.is_over
        return [action for action in self.done if action != Look()]

    def raised(self) -> FmuMeshError:
        error = self.states.error()
        assert error is not None
        return error

    def _go_on(self, *, quiet: bool = False) -> None:
        self._do(self.states.go_on(self.now, quiet=quiet))

    def _do(self, actions: Sequence[Action]) -> None:
        for action in actions:
            self.done.append(action)
            match action:
                case Start(name):
                    assert name not in self.running
                    self.running.add(name)
                case Look():
                    self.states.seen(self.running, sorted(self.stopped & self.running), self.now)


@pytest.fixture
def launch() -> Launch:
    launch = Launch()
    launch.status("running")
    return launch


def test_the_server_starts_first_then_the_master_then_the_nodes() -> None:
    assert Launch().done == [Start(SERVER), Start(THE_MASTER), Start("pendulum"), Start("both")]


def test_nodes_wait_for_the_gateway() -> None:
    launch = Launch(gateway=True)
    assert launch.done == [Start(SERVER), Start(THE_MASTER), Start(GATEWAY)]

    launch.gateway_ready()

    assert launch.done[3:] == [Start("pendulum"), Start("both")]


def test_a_gateway_that_is_ready_too_late_starts_nothing() -> None:
    launch = Launch(gateway=True)
    launch.ended((THE_MASTER, 1))
    assert launch.states.is_ending

    launch.gateway_ready()

    assert Start("pendulum") not in launch.done


def test_a_run_that_ends_in_order_sends_no_signal(launch: Launch) -> None:
    launch.reported(DONE)
    assert not launch.states.is_ending  # the master may still have something to say

    launch.ended(("pendulum", 0), ("both", 0), (THE_MASTER, 0), (SERVER, 0))

    assert launch.states.is_over
    assert launch.states.error() is None
    assert launch.states.outcome == DONE
    assert [action for action in launch.done[4:] if action != Look()] == [FinishServer()]


def test_a_node_that_dies_before_it_registers_is_named() -> None:
    launch = Launch()
    launch.status("starting", 0)

    launch.ended(("both", -signal.SIGSEGV))
    launch.passes(LIMITS.report + LIMITS.look)

    assert launch.states.is_ending
    assert launch.raised().message == "node 'both' was lost: its process was ended by SIGSEGV"
    assert (launch.raised().instance, launch.raised().point) == ("delay, gain", 0)


def test_the_master_gets_the_time_to_say_which_point_it_was(launch: Launch) -> None:
    launch.ended(("pendulum", -signal.SIGKILL))
    launch.passes(LIMITS.report / 2)
    assert not launch.states.is_ending

    launch.fails(MeshLost("node 'pendulum' was lost: its process does not answer any more", instance="x", point=9))
    launch.ended((THE_MASTER, 4))

    assert launch.states.is_ending
    assert launch.raised().message == "node 'pendulum' was lost: its process was ended by SIGKILL"
    assert launch.raised().point == 9


def test_the_words_of_a_node_that_has_said_why_stay(launch: Launch) -> None:
    launch.fails(StepFailed("doStep returned error", instance="pendulum", point=9))
    launch.ended(("pendulum", 3), (THE_MASTER, 3))

    assert type(launch.raised()) is StepFailed
    assert launch.raised().message == "doStep returned error"


def test_after_a_failed_model_the_master_may_wait_for_the_recorder(launch: Launch) -> None:
    launch.ended(("pendulum", StepFailed.exit_code))
    launch.passes(LIMITS.report_of_failure - 1.0)
    assert not launch.states.is_ending

    launch.passes(1.0 + LIMITS.look)

    assert launch.states.is_ending


def test_of_two_that_die_at_once_the_cause_is_named(launch: Launch) -> None:
    launch.ended(("both", MeshLost.exit_code), ("pendulum", -signal.SIGKILL))
    launch.passes(LIMITS.report + LIMITS.look)

    assert launch.raised().message == "node 'pendulum' was lost: its process was ended by SIGKILL"


def test_a_master_that_dies_with_a_node_is_named(launch: Launch) -> None:
    launch.ended((THE_MASTER, -signal.SIGKILL), ("pendulum", MeshLost.exit_code))

    assert launch.states.is_ending
    assert launch.raised().message == "the master was lost: its process was ended by SIGKILL"
    assert (launch.raised().point, launch.raised().time) == (7, 0.07)


def test_a_lost_recorder_is_what_the_master_says_of_it(launch: Launch) -> None:
    launch.fails(MeshLost("the recorder was lost", point=9))
    launch.ended(("pendulum", 4), ("both", 4), (THE_MASTER, 4))

    assert launch.raised().message == "the recorder was lost"
    assert [action for action in launch.ends() if isinstance(action, Signal)] == [Signal(SERVER, signal.SIGKILL)]


def test_a_node_lost_while_the_mesh_stops_is_left_to_the_master(launch: Launch) -> None:
    launch.status("stopping", 100)
    launch.ended(("pendulum", -signal.SIGSEGV))
    launch.passes(LIMITS.report + LIMITS.look)
    assert not launch.states.is_ending

    warning = "node 'pendulum' was lost: its process does not answer any more after the last row"

    assert launch.states.with_how(warning) == (
        "node 'pendulum' was lost: its process was ended by SIGSEGV after the last row"
    )


def test_a_silent_master_is_lost_after_the_deadline_of_a_step(launch: Launch) -> None:
    launch.passes(LIMITS.no_event)
    assert not launch.states.is_ending

    launch.passes(2 * LIMITS.look)

    assert launch.states.is_ending
    assert launch.raised().message == "the master was lost: its process does not answer any more"


def test_silence_does_not_count_while_events_wait_to_be_handled(launch: Launch) -> None:
    launch.passes(10 * LIMITS.no_event, quiet=False)

    assert not launch.states.is_ending


def test_a_master_that_never_reports_is_lost_at_the_start_deadline() -> None:
    launch = Launch()

    launch.passes(LIMITS.start)
    assert not launch.states.is_ending
    launch.passes(LIMITS.look)

    assert launch.states.is_ending
    assert type(launch.raised()) is MeshLost


def test_the_end_of_a_master_is_seen_without_an_event(launch: Launch) -> None:
    launch.ends_silently(THE_MASTER)
    launch.passes(LIMITS.report + 2 * LIMITS.look)

    assert launch.states.is_ending


@pytest.mark.parametrize("name", ["pendulum", THE_MASTER])
def test_a_process_that_is_stopped_before_the_run_is_named(name: str) -> None:
    launch = Launch()
    launch.stopped.add(name)

    launch.passes(LIMITS.link + 3 * LIMITS.look)

    assert launch.states.is_ending
    assert launch.raised().message.endswith(f"was lost: its process {STOPPED}")
    assert name in launch.raised().message


def test_a_process_that_goes_on_in_time_is_not_lost() -> None:
    launch = Launch()
    for second in range(100):
        launch.stopped = {"pendulum"} if second % 20 else set()
        launch.passes(1.0)
        launch.status("starting", 0)

    assert not launch.states.is_ending


def test_an_interrupt_asks_the_master_and_the_run_ends_in_order(launch: Launch) -> None:
    launch.interrupted()
    assert launch.done[-1] == Signal(THE_MASTER, signal.SIGTERM)

    launch.fails(Interrupted("SIGTERM was received"), by="SIGTERM")
    launch.ended((THE_MASTER, 130))

    assert launch.states.is_ending
    assert (type(launch.raised()), launch.raised().message) == (Interrupted, "interrupted")
    assert launch.raised().point == 9


def test_a_second_interrupt_does_not_wait_for_the_master(launch: Launch) -> None:
    launch.interrupted()
    assert not launch.states.is_ending

    launch.interrupted()

    assert launch.states.is_ending
    assert type(launch.raised()) is Interrupted
    assert launch.done.count(Signal(THE_MASTER, signal.SIGTERM)) == 1


def test_a_master_that_does_not_hear_the_interrupt_is_not_waited_for(launch: Launch) -> None:
    launch.interrupted()
    launch.passes(4 * LIMITS.look)

    assert launch.states.is_ending
    assert launch.ends()[:2] == [
        Signal("both", signal.SIGTERM),
        Signal("pendulum", signal.SIGTERM),
    ]


def test_a_signal_that_others_sent_to_the_master_is_a_loss(launch: Launch) -> None:
    launch.fails(Interrupted("SIGTERM was received"), by="SIGTERM")
    launch.ended((THE_MASTER, 130))

    assert type(launch.raised()) is MeshLost
    assert launch.raised().message == "the master was lost: its process received SIGTERM"


def test_two_interrupts_at_the_start_end_all_processes() -> None:
    launch = Launch()
    launch.interrupted()
    launch.interrupted()

    assert launch.states.is_ending
    assert {action.name for action in launch.ends() if isinstance(action, Signal)} >= {"pendulum", "both", THE_MASTER}


def test_an_interrupt_at_the_end_waits_no_longer_for_a_gateway() -> None:
    launch = Launch(gateway=True)
    launch.gateway_ready()
    launch.reported(DONE)
    launch.ended(("pendulum", 0), ("both", 0), (THE_MASTER, 0))
    assert launch.states.is_ending
    assert Signal(GATEWAY, signal.SIGTERM) not in launch.done

    launch.interrupted()

    assert launch.done[-1] == Signal(GATEWAY, signal.SIGTERM)
    assert launch.states.error() is None


def test_processes_that_do_not_end_get_a_signal_and_then_another_one(launch: Launch) -> None:
    launch.ended((THE_MASTER, -signal.SIGKILL))

    done = launch.ends()

    assert done == [
        Signal("both", signal.SIGTERM),
        Signal("pendulum", signal.SIGTERM),
        Signal("both", signal.SIGKILL),
        Signal("pendulum", signal.SIGKILL),
        Signal(SERVER, signal.SIGKILL),
    ]


def test_a_signal_of_the_launcher_is_not_the_reason(launch: Launch) -> None:
    launch.ended((THE_MASTER, -signal.SIGKILL))
    launch.passes(LIMITS.leave_lost)
    assert Signal("pendulum", signal.SIGTERM) in launch.done

    launch.fails(Interrupted("SIGTERM was received"), by="SIGTERM")
    launch.ended(("pendulum", -signal.SIGTERM))

    assert launch.raised().message == "the master was lost: its process was ended by SIGKILL"
    assert launch.states.with_how("node 'pendulum' was lost: its process does not answer any more").endswith("any more")


def test_an_end_is_seen_though_the_pipes_are_still_open(launch: Launch) -> None:
    launch.reported(DONE)
    launch.ended(("pendulum", 0), (THE_MASTER, 0))
    launch.ends_silently("both")
    launch.passes(2 * LIMITS.look_at_end)
    launch.ended((SERVER, 0))

    assert launch.states.is_over
    assert not any(isinstance(action, Signal) for action in launch.done)


def test_a_lost_server_is_the_reason_whatever_the_master_says(launch: Launch) -> None:
    launch.ended((SERVER, -signal.SIGKILL))
    launch.fails(MeshLost("node 'pendulum' was lost: its process does not answer any more", instance="pendulum"))
    launch.ended((THE_MASTER, 4))

    assert launch.raised().message == "the fork server was lost: its process was ended by SIGKILL"


def test_a_server_lost_after_the_last_point_takes_nothing_away(launch: Launch) -> None:
    launch.reported(DONE)
    launch.ended((SERVER, -signal.SIGKILL), ("pendulum", 4), ("both", 4), (THE_MASTER, 4))
    launch.ends()

    assert launch.states.error() is None


def test_a_server_that_does_not_answer_is_killed(launch: Launch) -> None:
    for name in (THE_MASTER, "pendulum", "both"):
        launch.ends_silently(name)

    launch.passes(LIMITS.report + 2 * LIMITS.look)
    assert launch.ends() == [Signal(SERVER, signal.SIGKILL)]

    assert "the fork server, which knows how, does not answer" in launch.raised().message


def test_a_gateway_that_ends_before_the_mesh_is_lost() -> None:
    launch = Launch(gateway=True)
    launch.gateway_ready()
    launch.status("running")
    launch.ended((GATEWAY, 0))
    assert not launch.states.is_ending

    launch.now += LIMITS.gateway + 0.1
    launch.status("running")

    assert launch.states.is_ending
    assert launch.raised().message == "the gateway to ROS was lost: its process ended with exit code 0"
    assert launch.raised().hint is not None


def test_a_gateway_that_is_not_ready_at_the_deadline_is_named() -> None:
    launch = Launch(gateway=True)
    launch.status("starting", 0)
    launch.fails(DeadlineExceeded("not all nodes have registered", instance="pendulum"))
    launch.ended((THE_MASTER, 4))

    assert launch.raised().message == "the gateway to ROS was not ready within 60 s"


def test_a_start_that_failed_is_ended_like_any_other() -> None:
    launch = Launch()
    launch.running = {SERVER, THE_MASTER}  # the third process could not be started

    done = launch.ends()

    assert done[:2] == [FinishServer(), Signal(THE_MASTER, signal.SIGTERM)]


def test_an_end_that_comes_after_everything_is_still_told(launch: Launch) -> None:
    launch.fails(Interrupted("SIGTERM was received"))
    launch.ended(*((name, 0) for name in ("pendulum", "both", THE_MASTER)))
    launch.ends_silently(SERVER)
    launch.passes(1.0)
    assert launch.states.is_over

    launch.ended((SERVER, 1))

    assert launch.raised().message == "the fork server was lost: its process ended with exit code 1"
