"""What a master decides, without a process, a session or a clock: events go in, actions come out."""

from __future__ import annotations

from pathlib import Path

import pytest
from msgspec.structs import replace

from fmu_mesh.errors import (
    DeadlineExceeded,
    Interrupted,
    MeshLost,
    MessageRefused,
    NotFinite,
    ProtocolBroken,
    RunReset,
    StepFailed,
    TerminationRequested,
)
from fmu_mesh.master.actions import Action, AnswerAll, Commanded, EndAll, FollowClock, RaiseGrant, SendToAll
from fmu_mesh.master.checkpoints import Checkpoints
from fmu_mesh.master.master_states import MasterStates
from fmu_mesh.master.mesh_server import MasterSettings
from fmu_mesh.simtime import ENDLESS
from fmu_mesh.system.plan import RECORDER, Plan
from fmu_mesh.wire.membership import NodeReady, Registration
from fmu_mesh.wire.messages import FINISH, GRANT, SAVE, InstanceState, NodeReport, encode_state, sealed
from fmu_mesh.wire.refusals import Refusals
from fmu_mesh.wire.views import Command
from fmu_mesh.wire.ways import Ways
from tests.helpers import write_config
from tests.planning import prepare

ALL = ("pendulum", "delay", RECORDER)
LAST = 1000


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Plan:
    """Two nodes and the recorder, 1000 points, deadlines of 4 s for the start and 8 s for a step."""
    timeouts = {"start": 4.0, "initialize": 5.0, "step": 8.0, "stop": 1.0, "terminate": 2.0}
    simulation = {"window": 64}
    return prepare(write_config(tmp_path_factory.mktemp("plan"), timeouts=timeouts, simulation=simulation))


@pytest.fixture(scope="module")
def endless(tmp_path_factory: pytest.TempPathFactory) -> Plan:
    """The same without a stop time."""
    return prepare(write_config(tmp_path_factory.mktemp("endless"), simulation={"stop_time": None}))


class Driven:
    """A run whose time and events come from a test, up to the given state."""

    def __init__(
        self,
        plan: Plan,
        *,
        paused: bool = False,
        sharing: bool = True,
        replays_to: int = 0,
        commanded: Commanded | None = None,
    ) -> None:
        self.states = MasterStates(plan, paused=paused, replays_to=replays_to, commanded=commanded)
        self.now = 0.0
        self._sharing = sharing

    def decide(self, paced: int | None = None, stopped: tuple[str, ...] = ()) -> list[Action]:
        """All actions until there is nothing to do, without the messages that only show that the master lives."""
        found = []
        while actions := self.states.decide(self.now, self.states.wanted if paced is None else paced, stopped):
            found += actions
        return [action for action in found if action != SendToAll(GRANT, 0)]

    def register(self, *nodes: str) -> list[str | None]:
        return [self.states.registrations.register(registration(self.states.plan, node)) for node in nodes]

    def ready(self, *nodes: str) -> None:
        for node in nodes:
            self.states.registrations.take_ready(node, NodeReady(self._sharing, sealed(f"secret of {node}")))

    def at(self, point: int, *nodes: str) -> None:
        """These nodes, or all, are at a point."""
        self.states.progress((node, point) for node in nodes or ALL)

    def command(self, name: str, *, claimed: int = 0, points: int = 1) -> tuple[str, int | None]:
        """The state and the pause that the answer says."""
        answer = self.states.command(Command(name, points), claimed)  # type: ignore[arg-type]  # any of the four
        return answer.state, answer.hold

    def fails_with(self, kind: type[Exception], *parts: str) -> None:
        *_, last = self.decide()
        assert isinstance(last, EndAll)
        assert isinstance(last.error, kind)
        assert [part for part in parts if part not in str(last.error)] == []
        assert (self.states.state, self.states.failure) == ("failed", last.error)
        assert self.decide() == []


def registration(plan: Plan, node: str, secret: str | None = None) -> Registration:
    seal = sealed(sealed(secret or f"secret of {node}"))
    return Registration(node, plan.digest, pid=7, host="here", seal=seal)


def initializing(plan: Plan, *, paused: bool = False, sharing: bool = True) -> Driven:
    run = Driven(plan, paused=paused, sharing=sharing)
    run.register(*ALL)
    run.ready(*ALL)
    run.decide()
    return run


def running(plan: Plan, *, paused: bool = False, sharing: bool = True) -> Driven:
    run = initializing(plan, paused=paused, sharing=sharing)
    run.at(0)
    run.decide()
    return run


def stopping(plan: Plan) -> Driven:
    run = running(plan)
    run.at(LAST)
    run.decide()
    return run


def ended(node: str, point: int = LAST) -> NodeReport:
    return NodeReport(node, point)


def test_nodes_are_answered_when_the_last_one_is_ready(plan: Plan) -> None:
    run = Driven(plan)

    assert run.register(*ALL) == [None] * 3
    run.ready("pendulum", "delay")
    assert run.decide() == []
    run.ready(RECORDER)
    assert run.decide() == [AnswerAll(Ways(ALL))]
    assert run.states.state == "initializing"


def test_a_process_may_register_again_if_it_got_no_answer(plan: Plan) -> None:
    assert Driven(plan).register("delay", "delay") == [None, None]


def test_a_second_process_of_a_node_is_refused_and_run_goes_on(plan: Plan) -> None:
    run = running(plan)

    reason = run.states.registrations.register(registration(plan, "delay", "another process"))

    assert reason == "node 'delay' is there already; two processes run it"
    assert run.decide() == []


def test_a_node_of_another_plan_or_name_is_refused(plan: Plan) -> None:
    nodes = Driven(plan).states.registrations

    assert nodes.register(registration(plan, "stranger")) == "this mesh has no node 'stranger'"
    other = replace(registration(plan, "delay"), digest="0" * len(plan.digest))
    assert str(nodes.register(other)).endswith("not that of the master")


@pytest.mark.parametrize("secret", ["", "that of another"])
def test_only_the_process_that_registered_may_be_ready(plan: Plan, secret: str) -> None:
    run = Driven(plan)
    run.register("delay")

    with pytest.raises(MessageRefused):
        run.states.registrations.take_ready("delay", NodeReady(opened=sealed(secret)))
    assert run.states.registrations.missing == [*ALL]


def test_nodes_that_do_not_come_are_named_at_the_deadline(plan: Plan) -> None:
    run = Driven(plan)
    run.register("pendulum", "delay")
    run.ready("pendulum")
    run.now = 4.0
    assert run.decide() == []

    run.now = 4.1
    run.fails_with(DeadlineExceeded, "not ready within 4 s: node 'delay'", "Started, but not ready: delay.")


def test_the_last_point_is_granted_when_all_are_at_the_first(plan: Plan) -> None:
    run = initializing(plan)
    run.at(0, "pendulum", "delay")
    assert run.decide() == []

    run.at(0, RECORDER)
    assert run.decide() == [FollowClock(0), RaiseGrant(LAST)]
    assert (run.states.state, run.states.moves) == ("running", True)


def test_a_node_that_stays_in_initialization_mode_is_named_at_the_deadline(plan: Plan) -> None:
    run = initializing(plan)
    run.at(0, "pendulum", RECORDER)
    run.now = 5.1

    run.fails_with(DeadlineExceeded, "Initialization Mode is not over in node 'delay' within 5 s")


def test_the_wall_clock_limits_the_grant(plan: Plan) -> None:
    run = initializing(plan)
    run.at(0)

    assert run.decide(paced=3) == [FollowClock(0), RaiseGrant(3)]
    assert run.decide(paced=3) == []
    assert run.decide(paced=4) == [RaiseGrant(4)]


def test_a_recorder_that_is_behind_is_no_delay_of_the_wall_clock(plan: Plan) -> None:
    """It writes many rows at once: with `catch_up: 0`, each time points of the wall clock were given up."""
    run = running(plan)
    run.at(20, *(node for node in ALL if node != RECORDER))

    assert run.states.granting.slowest == 0
    assert run.states.granting.reached == 20


def test_who_waits_for_the_wall_clock_does_not_wait_for_progress(plan: Plan) -> None:
    run = initializing(plan)
    run.at(0)
    run.decide(paced=3)
    granting, wanted = run.states.granting, run.states.wanted

    assert granting.wake_at(wanted) is None  # what is granted next depends on the clock alone
    assert granting.wake_at(granting.grant) is not None
    run.decide(paced=wanted)
    assert granting.wake_at(wanted) is not None


def test_nodes_elsewhere_get_the_grant_by_messages_that_hold_the_window(plan: Plan) -> None:
    run = running(plan, sharing=False)
    window = plan.nodes["delay"].window
    sent = run.states.granting.reaches_all
    assert 0 < sent <= window

    run.at(sent)
    further = [action.point for action in run.decide() if isinstance(action, SendToAll)]
    assert further
    assert sent < further[-1] <= sent + window


def test_the_master_shows_twice_a_second_that_it_lives(plan: Plan) -> None:
    run = running(plan)
    assert run.states.decide(run.now, LAST) == []
    run.now += 0.5

    assert run.states.decide(run.now, LAST) == [SendToAll(GRANT, 0)]
    assert run.states.decide(run.now, LAST) == []


def test_a_pause_holds_at_the_furthest_claimed_point(plan: Plan) -> None:
    run = running(plan)
    run.at(10)

    assert run.command("pause", claimed=13) == ("paused", 13)
    assert run.decide() == [RaiseGrant(13)]
    assert run.states.moves
    run.at(13)
    assert run.decide() == []
    assert not run.states.moves


def test_a_pause_does_not_take_back_what_was_sent(plan: Plan) -> None:
    run = running(plan, sharing=False)
    sent = run.states.granting.reaches_all

    assert run.command("pause") == ("paused", sent)


def test_a_resumed_run_follows_the_wall_clock_from_where_it_is(plan: Plan) -> None:
    run = running(plan)
    run.command("pause", claimed=13)
    run.at(13)
    run.decide()

    assert run.command("resume", claimed=13) == ("running", None)
    assert run.decide() == [RaiseGrant(13), FollowClock(13), RaiseGrant(LAST)]


def test_the_wall_clock_begins_anew_before_more_is_granted(plan: Plan) -> None:
    run = running(plan, paused=True)
    run.command("resume")

    # The point that the caller gives here is still that of the clock from before the pause.
    assert run.states.decide(run.now, LAST) == [RaiseGrant(0), FollowClock(0)]
    assert run.states.decide(run.now, 1) == [RaiseGrant(1)]


def test_steps_are_counted_from_the_pause_and_not_from_the_progress(plan: Plan) -> None:
    run = running(plan)
    run.at(10)
    run.command("pause", claimed=13)

    assert run.command("step", claimed=12, points=5) == ("paused", 18)
    assert run.decide()[-1] == RaiseGrant(18)


def test_a_step_of_a_running_mesh_pauses_it(plan: Plan) -> None:
    run = running(plan)

    assert run.command("step", claimed=4, points=2) == ("paused", 6)


def test_a_step_may_ignore_the_wall_clock_until_the_next_command(plan: Plan) -> None:
    run = running(plan, paused=True)

    run.states.command(Command("step", 5, paced=False), 0)
    assert FollowClock(0, paced=False) in run.states.decide(run.now, LAST)
    run.states.command(Command("resume"), 5)
    assert FollowClock(0) in run.states.decide(run.now, LAST)


def test_a_step_beyond_the_end_grants_the_last_point(plan: Plan) -> None:
    run = running(plan, paused=True)
    run.command("step", points=10 * LAST)

    assert run.decide()[-1] == RaiseGrant(LAST)


def test_a_run_that_begins_paused_grants_nothing(plan: Plan) -> None:
    run = initializing(plan, paused=True)
    run.at(0)

    assert run.decide() == [FollowClock(0)]
    assert (run.states.state, run.states.moves) == ("paused", False)


def test_a_stop_before_the_stop_time_is_an_interruption(plan: Plan) -> None:
    run = running(plan)
    run.at(10)
    run.command("stop", claimed=11)

    run.fails_with(Interrupted, "stopped by a command before its stop time of 1 s")


def test_a_stop_without_a_stop_time_is_a_normal_end(endless: Plan) -> None:
    run = running(endless)
    run.command("stop", claimed=11)
    assert run.decide() == [RaiseGrant(11)]

    run.at(11)
    assert run.decide() == [SendToAll(FINISH, 11)]
    assert isinstance(run.states.ended_by, TerminationRequested)


def back(plan: Plan, commanded: Commanded | None = None) -> Driven:
    """A run that has started again, and was at point 100 before."""
    run = Driven(plan, replays_to=100, commanded=commanded)
    run.register(*ALL)
    run.ready(*ALL)
    run.decide()
    run.at(0)
    return run


def test_a_run_that_comes_back_is_not_paced_until_it_is_there(tmp_path: Path) -> None:
    run = back(prepare(write_config(tmp_path, simulation={"real_time_factor": 1.0})))
    assert run.decide() == [FollowClock(0, paced=False), RaiseGrant(100)]
    assert run.states.is_replaying

    run.at(100)

    assert run.states.decide(run.now, ENDLESS) == [FollowClock(100)]  # no grant by a clock that was not followed
    assert not run.states.is_replaying
    assert run.decide(paced=101) == [RaiseGrant(101)]


def test_a_run_that_comes_back_pauses_where_it_was_paused(plan: Plan) -> None:
    run = back(plan, Commanded("step", 120))

    assert run.decide() == [FollowClock(0, paced=False), RaiseGrant(120)]
    assert run.states.state == "paused"


def test_a_run_that_comes_back_is_stopped_again(plan: Plan) -> None:
    run = back(plan, Commanded("stop", None, LAST))
    run.decide()
    run.at(100)

    run.fails_with(Interrupted, "stopped by a command before its stop time of 1 s")


def test_a_run_without_end_that_comes_back_ends_at_same_point(endless: Plan) -> None:
    run = back(endless, Commanded("stop", None, 111))
    run.decide()
    run.at(111)

    assert run.decide() == [FollowClock(100 + 11), SendToAll(FINISH, 111)]
    assert isinstance(run.states.ended_by, TerminationRequested)


@pytest.mark.parametrize(("paused", "hold"), [(False, None), (True, 0)])
def test_a_reset_ends_the_run_and_the_next_begins_as_paused(plan: Plan, paused: bool, hold: int | None) -> None:  # noqa: FBT001  pytest gives it
    run = running(plan, paused=paused)
    run.at(0)

    assert run.command("reset", claimed=0) == ("paused" if paused else "running", hold)
    run.fails_with(RunReset, "reset by a command at point 0")
    assert (run.states.hold is not None) is paused


def test_a_failure_before_a_reset_is_the_reason_of_the_end(plan: Plan) -> None:
    run = running(plan)
    run.states.report(NodeReport("delay", 3, StepFailed("no", instance="delay", point=3).report()))
    run.command("reset", claimed=5)

    run.fails_with(StepFailed, "no")


def test_an_fmu_that_ends_the_simulation_ends_it_for_all(plan: Plan) -> None:
    run = running(plan)
    run.at(10)
    run.states.report(NodeReport("delay", 20, TerminationRequested("enough", point=20).report()))

    run.at(20)
    assert run.decide() == [SendToAll(FINISH, 20)]


def test_the_earliest_of_two_early_ends_counts(plan: Plan) -> None:
    run = running(plan)
    for node, point in (("delay", 20), ("pendulum", 15), ("delay", 30)):
        run.states.report(NodeReport(node, point, TerminationRequested(node, point=point).report()))

    assert run.states.granting.last_point == 15
    assert "pendulum" in str(run.states.ended_by)


def test_a_value_that_is_not_finite_fails_the_run_at_point_before(plan: Plan) -> None:
    run = running(plan)
    run.states.report(NodeReport("delay", 20, NotFinite("y is NaN", instance="delay", point=20).report()))
    assert run.decide() == []

    run.at(19)
    run.fails_with(NotFinite, "y is NaN")


def test_a_failed_step_ends_the_run_at_once(plan: Plan) -> None:
    run = running(plan)
    run.states.report(NodeReport("delay", 20, StepFailed("fmi2Error", instance="delay", point=20).report()))

    run.fails_with(StepFailed, "fmi2Error")


def test_the_first_of_two_failures_is_the_reason(plan: Plan) -> None:
    run = running(plan)
    run.states.report(NodeReport("delay", 20, StepFailed("fmi2Error", instance="delay", point=20).report()))
    run.states.lose("pendulum")

    run.fails_with(StepFailed, "fmi2Error")


def test_a_lost_node_ends_the_run_with_its_point(plan: Plan) -> None:
    run = running(plan)
    run.at(12)
    run.states.lose("delay")

    run.fails_with(MeshLost, "node 'delay' was lost: its process does not answer any more", "delay", "point 12")


def test_a_lost_router_is_named_before_the_node(plan: Plan) -> None:
    run = running(plan)
    run.states.lose("delay", "the link to the router at tcp/a:1 was lost")

    run.fails_with(MeshLost, "the link to the router at tcp/a:1 was lost, and node 'delay' with it")


def test_a_node_lost_after_its_last_row_is_a_warning(plan: Plan) -> None:
    run = stopping(plan)
    run.states.lose("delay")
    run.states.report(ended("pendulum"))
    run.states.report(ended(RECORDER))

    assert run.decide() == []
    assert run.states.state == "done"
    assert [text for text in run.states.warnings if "All rows are recorded." in text]


def test_a_recorder_lost_after_the_last_point_is_a_failure(plan: Plan) -> None:
    run = stopping(plan)
    run.states.lose(RECORDER)

    run.fails_with(MeshLost, "the recorder was lost")


@pytest.mark.parametrize("point", [-2, LAST + 1])
def test_a_node_where_it_cannot_be_ends_the_run(plan: Plan, point: int) -> None:
    run = running(plan)
    run.at(point, "delay")

    run.fails_with(ProtocolBroken, f"node 'delay' says that it is at point {point}", f"granted point {LAST}")


def test_no_node_may_be_beyond_the_grant(plan: Plan) -> None:
    run = initializing(plan)
    run.at(0)
    run.decide(paced=3)
    run.at(4, "delay")

    run.fails_with(ProtocolBroken, "granted point 3")


def test_a_node_that_ends_while_the_run_goes_on_ends_it(plan: Plan) -> None:
    run = running(plan)
    run.states.report(ended("delay", 10))

    run.fails_with(ProtocolBroken, "node 'delay' says that it has ended at point 10")


def test_an_early_end_beyond_the_grant_is_no_early_end(plan: Plan) -> None:
    run = running(plan)
    run.states.report(NodeReport("delay", 20, TerminationRequested("enough", point=LAST + 1).report()))

    run.fails_with(ProtocolBroken, f"ends the simulation at point {LAST + 1}")


def silent(run: Driven, seconds: float) -> float:
    """Let time go by; returns for how long there was no progress."""
    run.now += seconds
    return run.states.silent_s(run.now)


def test_a_stopped_process_is_named_after_the_deadline_of_a_step(plan: Plan) -> None:
    run = running(plan)
    run.at(3, "pendulum", RECORDER)  # as far as its window lets it
    run.decide()
    silent(run, 4.0)
    run.at(4, "pendulum", RECORDER)
    run.decide()
    assert silent(run, 4.1) == pytest.approx(4.1)
    assert run.states.slowest_silent_s(run.now) == pytest.approx(8.1)  # seconds add up

    *_, last = run.decide(stopped=("delay",))
    assert isinstance(last, EndAll)
    assert "node 'delay', point 0, t = 0 s: no progress for 8.1 s: its process is stopped" in str(last.error)


def test_a_slow_node_has_three_times_the_deadline(plan: Plan) -> None:
    run = running(plan)
    run.at(3, "pendulum", RECORDER)
    run.decide()
    silent(run, 24.0)
    assert run.decide() == []

    silent(run, 0.1)
    run.fails_with(DeadlineExceeded, "node 'delay'", "no progress for 24.1 s")


def test_any_progress_begins_the_deadline_again(plan: Plan) -> None:
    run = running(plan)
    silent(run, 20.0)
    run.at(1, "pendulum")
    run.decide()

    assert silent(run, 20.0) == 20.0


def test_neither_a_pause_nor_the_wall_clock_is_silence(plan: Plan) -> None:
    paused, paced = running(plan, paused=True), initializing(plan)
    paced.at(0)
    paced.decide(paced=3)
    paced.at(3)
    paced.decide(paced=3)

    assert (silent(paused, 1000.0), silent(paced, 1000.0)) == (0.0, 0.0)
    assert paced.decide(paced=4) == [RaiseGrant(4)]
    assert silent(paced, 1.0) == 1.0


def test_the_run_is_done_when_all_have_reported(plan: Plan) -> None:
    run = running(plan)
    run.at(LAST)
    assert run.decide() == [SendToAll(FINISH, LAST)]
    for node in ALL:
        assert not run.states.is_over
        run.states.report(ended(node))
        run.decide()

    assert (run.states.state, run.states.is_over, run.states.failure) == ("done", True, None)


def test_a_node_that_does_not_report_its_end_is_named(plan: Plan) -> None:
    run = stopping(plan)
    run.states.report(ended("pendulum"))
    run.states.report(ended(RECORDER))
    run.now += 3.1

    run.fails_with(DeadlineExceeded, "the end was not reported by node 'delay' within 3 s")


@pytest.mark.parametrize("begin", [Driven, initializing, running, stopping])
def test_an_interruption_ends_the_run_in_every_state(plan: Plan, begin: type[Driven]) -> None:
    run = begin(plan)
    run.states.fail(Interrupted("interrupted by a person"))

    run.fails_with(Interrupted, "interrupted by a person")


def test_a_state_has_at_most_fifteen_attributes(plan: Plan) -> None:
    states = MasterStates(plan)

    assert {
        type(item).__name__ for item in (states, states.granting, states.registrations) if len(vars(item)) > 15
    } == set()


def test_all_nodes_are_held_at_a_common_point_until_saved(plan: Plan) -> None:
    run = running(plan)
    run.at(10)
    run.decide()

    assert run.states.save(claimed=13, every=4)

    assert (run.states.saves_at, run.states.wanted, run.states.state) == (16, 16, "running")
    assert SendToAll(SAVE, 16) in run.decide()
    run.at(16)
    assert RaiseGrant(LAST) not in run.decide()
    assert (run.states.granting.grant, run.states.moves) == (16, False)
    run.now += 100.0  # longer than each deadline of a step: whoever asks for the states looks at the time
    assert run.decide() == [SendToAll(GRANT, 0)] or run.states.failure is None
    run.states.saved()
    run.decide()
    assert run.states.granting.grant > 16


def test_states_in_parts_are_put_together_and_refused_beyond_a_limit(
    plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, kept = running(plan), list[tuple[int, bytes]]()
    settings = MasterSettings(
        as_file=lambda _point, states: b"|".join(states.values()),
        checkpoint_s=0.2,
        keep=lambda point, data: kept.append((point, data)),
    )
    checkpoints = Checkpoints("pair", run.states, lambda: 13, settings, Refusals())

    def come(state: bytes) -> None:
        """A checkpoint to which `pendulum` gives this state, and `delay` three bytes."""
        run.now += 100.0
        checkpoints.settle(run.now)
        at = run.states.saves_at
        assert at is not None
        for name, own in (("pendulum", state), ("delay", b"abc")):
            for message in encode_state(InstanceState(name, own), at):
                assert len(message) < 200
                checkpoints.take(name, at, message)
        checkpoints.settle(run.now)
        checkpoints.answer()

    monkeypatch.setattr("fmu_mesh.wire.messages._PART", 10)
    come(bytes(range(25)))
    assert [data for _, data in kept] == [bytes(range(25)) + b"|abc"]

    monkeypatch.setattr("fmu_mesh.master.checkpoints.MAX_STATES_SIZE", 25)
    come(bytes(25))
    assert run.states.saves_at is None
    assert len(kept) == 1


def test_a_pause_before_a_common_point_saves_nothing(plan: Plan) -> None:
    run = running(plan)
    run.at(10)
    run.command("pause", claimed=13)

    assert not run.states.save(claimed=13, every=4)

    assert (run.states.saves_at, run.states.hold) == (None, 13)


def test_a_run_does_not_end_before_its_last_point_is_saved(plan: Plan) -> None:
    run = running(plan)
    assert run.states.save(claimed=LAST, every=1)
    run.at(LAST)
    run.decide()
    states = [run.states.state]
    run.states.saved()
    run.decide()
    assert [*states, run.states.state] == ["running", "stopping"]
