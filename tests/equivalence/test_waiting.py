"""`wait`, the address that `launch` prints, and the answers to `pause` and `stop`: what a script can rely on."""

from __future__ import annotations

import json
import os
import re
import signal
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.helpers import DEADLINE_S, FMUS, Launched, Place, braked, free_port, rows_of, wait_until, write_config

FAR_S = 1e6
PACED = {"real_time_factor": 1.0, "step_size": 0.01}


def point_in(text: str) -> int:
    """The point that a command tells."""
    return int(re.findall(r"at point (\d+)", text)[0])


def status_of(place: Place, mesh: str = "pair") -> dict[str, object]:
    status: dict[str, object] = json.loads(place.run("status", mesh, "--json").output)
    return status


def running(place: Place, *options: str) -> Launched:
    """A mesh by the wall clock, as soon as it runs."""
    launched = place.start("launch", write_config(place.folder, stop_time=FAR_S, simulation=PACED), *options)
    launched.wait_for_error_line("mesh 'pair' at")
    return launched


# --- wait


@pytest.mark.parametrize("name", [["pair"], ["fmu_mesh/pair"], []], ids=["name", "key", "nothing"])
def test_a_mesh_that_is_not_there_yet_is_waited_for(place: Place, name: Sequence[str]) -> None:
    wait = place.start("wait", *name)
    wait_until((place.folder / "run").exists, "a look into the runtime folder")

    mesh = place.start("launch", write_config(place.folder, stop_time=FAR_S, simulation=PACED), "--no-progress")

    assert wait.wait() == 0, wait.errors
    assert wait.output.startswith("mesh 'pair' is running at point ")
    assert status_of(place)["state"] == "running"
    mesh.signal(signal.SIGINT)
    assert mesh.wait() == 130


def test_a_mesh_at_an_endpoint_where_nobody_is_yet_is_waited_for(place: Place) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    wait = place.start("wait", "pair", "--connect", endpoint, "--state", "paused", "--json")
    other = place.run("wait", "pair", "--connect", endpoint, "--timeout", "0.3")

    place.start("launch", write_config(place.folder), "--listen", endpoint, "--paused", "--no-progress")

    assert wait.wait() == 0, wait.errors
    status = json.loads(wait.output)
    assert (status["mesh"], status["state"], status["point"]) == ("pair", "paused", 0)
    assert other.wait() == 4
    assert "nobody answered at" in other.message


def test_a_router_that_has_no_mesh_yet_is_watched(place: Place) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = place.start("router", "--listen", endpoint)
    wait_until(lambda: router.output, "the router")
    wait = place.start("wait", "--connect", endpoint)
    assert place.run("wait", "--connect", endpoint, "--timeout", "0.5").message == (
        "fmu-mesh: there is no mesh after 0.5 s. A larger `--timeout` waits longer."
    )

    config = write_config(place.folder, stop_time=FAR_S, simulation=PACED)
    place.start("launch", config, "--connect", endpoint, "--no-progress")

    assert wait.wait() == 0, wait.errors
    assert wait.output.startswith("mesh 'pair' is running at point ")


def following(place: Place, *arguments: str) -> Launched:
    """A `wait` that has found its mesh: there is one connection more to the master's socket (Linux)."""
    socket_path = place.note().endpoints[0].partition("/")[2]

    def connections() -> int:
        return Path("/proc/net/unix").read_text(encoding="ascii").count(socket_path)

    least = connections()
    wait = place.start("wait", *arguments)

    def is_there() -> bool:
        nonlocal least
        now = connections()
        least = min(least, now)  # a connection that an earlier process has left may end only now
        return now > least

    wait_until(is_there, "a connection to the master")
    return wait


@pytest.mark.parametrize(
    ("end", "code", "said"),
    [
        ("done", 0, "mesh 'pair' is done at point 1000\n"),
        (
            "failed",
            3,
            "instance faulty, point 500, t = 0.5 s: mesh 'pair' has failed and does not become done: fmi2DoS",
        ),
        ("stop", 130, "point 0, t = 0 s: mesh 'pair' has failed and does not become done: stopped by a command before"),
        ("kill", 4, "fmu-mesh: mesh 'pair' is gone, and does not become done any more"),
    ],
)
def test_the_end_of_a_mesh_has_the_exit_code_of_launch(
    place: Place, faulty: Path, end: str, code: int, said: str
) -> None:
    instances = {"faulty": {"fmu": str(faulty), "start_values": {"fail_at": 0.5 if end == "failed" else FAR_S}}}
    launched = place.start("launch", write_config(place.folder, instances=instances, connections=[]), "--paused")
    assert place.run("wait", "--state", "paused").wait() == 0
    done, runs = following(place, "--state", "done"), following(place, "--state", "stopping")

    if end == "kill":
        launched.child("master").kill()
    else:
        place.run("stop" if end == "stop" else "resume", "pair")

    assert (launched.wait(), done.wait()) == (code, code)
    assert said in (done.output if end == "done" else done.message)
    assert runs.wait() == code


def test_state_that_mesh_cannot_come_to_any_more_is_told_at_once(place: Place) -> None:
    running(place)

    for state in ("starting", "initializing"):
        wait = place.run("wait", "--state", state)
        assert wait.wait() == 4
        assert f", and does not become {state} any more" in wait.message


def test_a_wait_in_vain_ends_at_its_deadline(place: Place) -> None:
    nothing = place.run("wait", "pair", "--timeout", "0.3")
    running(place, "--paused")
    paused = place.run("wait", "--timeout", "0.5")
    unknown = place.run("wait", "--state", "asleep")

    assert [wait.wait() for wait in (nothing, paused, unknown)] == [4, 4, 2]
    assert nothing.message == "fmu-mesh: there is no mesh 'pair' after 0.3 s. A larger `--timeout` waits longer."
    assert (
        paused.message
        == "fmu-mesh: mesh 'pair' is paused, and was not running in time. A larger `--timeout` waits longer."
    )
    assert "invalid choice: 'asleep'" in unknown.errors


def test_of_several_meshes_one_has_to_be_named(place: Place) -> None:
    running(place)
    place.start("launch", write_config(place.folder, name="other", stop_time=FAR_S), "--paused", "--no-progress")
    assert place.run("wait", "other", "--state", "paused").wait() == 0

    wait = place.run("wait")

    assert wait.wait() == 2
    assert "2 meshes are running: other, pair" in wait.message


# --- the address


GATE = """
from pathlib import Path
import fmu_mesh

folder = Path(__file__).parent
try:
    (folder / "described").touch(exist_ok=False)
except FileExistsError:
    (folder / "gate").open().close()  # the node loads it: wait until somebody opens the other end

class Gate(fmu_mesh.Component):
    y = fmu_mesh.Output()

    def step(self, time, step_size):
        self.y = time
"""


def test_the_address_is_shown_when_all_instances_answer(place: Place) -> None:
    os.mkfifo(place.folder / "gate")
    (place.folder / "gate.py").write_text(GATE, encoding="utf-8")
    instances = {"pendulum": {"fmu": "DampedPendulum"}, "gate": {"python": "gate.py:Gate"}}
    config = write_config(place.folder, instances=instances, connections=[], stop_time=FAR_S, simulation=PACED)
    launched = place.start("launch", config)
    assert place.run("wait", "--state", "starting").wait() == 0
    assert "mesh 'pair' at" not in launched.errors
    (place.folder / "gate").open("w", encoding="utf-8").close()  # waits until the node waits

    launched.wait_for_error_line("mesh 'pair' at")

    with place.session() as session:
        for name in ("pendulum/out/a", "gate/out/y"):
            replies = session.get(f"fmu_mesh/pair/{name}", timeout=DEADLINE_S)
            assert [str(reply.ok.key_expr) for reply in replies if reply.ok is not None] == [f"fmu_mesh/pair/{name}"]


def test_a_mesh_that_never_answers_shows_no_address(place: Place, faulty: Path) -> None:
    instances = {"faulty": {"fmu": str(faulty), "start_values": {"fail_in_init": True}}}

    launched = place.run("launch", write_config(place.folder, instances=instances, connections=[]))

    assert launched.wait() == 3
    assert "mesh 'pair' at" not in launched.errors


# --- pause and stop


def test_pause_and_step_tell_the_point_where_the_mesh_really_rests(place: Place) -> None:
    # As fast as possible: it is far beyond the point at which the command comes.
    launched = place.start("launch", write_config(place.folder, stop_time=FAR_S), "--no-progress")
    launched.wait_for_error_line("mesh 'pair' at")

    for command in (("pause", "pair"), ("step", "pair", "5000"), ("step", "pair")):
        done = place.run(*command)
        assert done.wait() == 0, done.errors
        point = point_in(done.output)
        assert done.output == f"mesh 'pair' is paused at point {point}\n"
        progress = status_of(place)["progress"]
        assert isinstance(progress, dict)
        assert set(progress.values()) == {point}
        assert json.loads(place.run("get", "pendulum.a", "--json").output)["point"] == point


def test_a_mesh_that_pauses_too_late_says_where_it_is_going(place: Place) -> None:
    running(place)

    step = place.run("step", "pair", "1000", "--timeout", "0.5")  # 10 s by the wall clock

    assert step.wait() == 4
    words = (
        r"mesh 'pair' is at point (\d+), on its way to point (\d+), where it is going to rest; "
        r"node '\w+' is at point (\d+), and the wall clock allows point (\d+). A larger `--timeout` waits longer."
    )
    found = re.search(words, step.message)
    assert found is not None, step.message
    at, goal, node_at, allowed = map(int, found.groups())
    assert at <= node_at <= allowed < goal
    wait_until(lambda: status_of(place)["point"] == goal, "the mesh at rest")
    assert point_in(place.run("pause", "pair").output) == goal


def test_a_mesh_that_comes_to_its_end_before_it_rests_says_so(place: Place) -> None:
    place.start("launch", write_config(place.folder), "--paused", "--no-progress")
    assert place.run("wait", "--state", "paused").wait() == 0

    step = place.run("step", "pair", "2000")

    assert step.wait() == 4
    assert re.search("mesh 'pair' is (stopping|done) at point 1000, and does not come to rest any more", step.message)


@pytest.mark.parametrize("paused", [[], ["--paused"]], ids=["running", "paused"])
def test_stop_is_the_normal_end_of_a_run_without_a_stop_time(place: Place, paused: list[str]) -> None:
    simulation = {"stop_time": None, "step_size": 0.01}
    config = write_config(place.folder, instances=braked(place.folder), simulation=simulation)
    launched = place.start("launch", config, "--no-progress", *paused)
    assert place.run("wait", "--state", "paused" if paused else "running").wait() == 0

    stop = place.run("stop", "pair")

    assert stop.output.startswith("mesh 'pair' is stopping at point ")
    assert launched.wait() == 0
    rows = rows_of(config.with_suffix(".csv"))
    assert [row[0] for row in rows] == [point * 0.01 for point in range(len(rows))]
    last = len(rows) - 1
    assert (
        f"point {last}, t = {last * 0.01:.12g} s: stopped by a command, the normal end of a run without a stop time"
        in (launched.errors)
    )
    assert f"({len(rows)} rows)" in launched.output
    assert f"\n{last} points in " in launched.output
    place.assert_nothing_left()


def test_a_stop_of_a_free_running_fmu_is_its_normal_end(place: Place) -> None:
    codes, errors = [], []
    for options in ([], ["--stop-time", "1000"]):
        run = place.start("run", FMUS / "Gain.fmu", "--no-progress", *options)
        assert place.run("wait").wait() == 0
        place.run("stop", "Gain")
        codes.append(run.wait())
        errors.append(run.errors)

    assert codes == [0, 130]
    assert "stopped by a command, the normal end of a run without a stop time" in errors[0]
    assert "stopped by a command before its stop time of 1000 s" in errors[1]


def test_stop_ends_processes_started_by_hand_in_order(place: Place) -> None:
    config = write_config(place.folder, simulation={"stop_time": None, "real_time_factor": 1.0})
    parts = [place.start("master", config, "--no-progress")]
    parts[0].wait_for_error_line("mesh 'pair' at")  # they need it before they are there
    parts += [place.start("node", config, name) for name in ("pendulum", "delay")]
    assert place.run("wait").wait() == 0

    place.run("stop", "pair")

    assert [part.wait() for part in parts] == [0, 0, 0]
    place.assert_nothing_left()
