"""Looking into a running mesh: with the commands, and with nothing but a plain Zenoh session.

Every mesh runs in processes of its own with a runtime folder of its own, paced by the wall clock so that it lives long
enough to be looked at; nothing here waits by the clock.
"""

from __future__ import annotations

import csv
import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh

import fmu_mesh
from fmu_mesh.cli.main import main
from tests.helpers import DEADLINE_S, Place, wait_until, write_config

FMUS = Path(__file__).parents[2] / "fmus"
ROOT = "fmu_mesh/looked_at"
_RUNS = 20

CONFIG = """\
mesh: looked_at
simulation: {{stop_time: {stop_time}, step_size: 0.01, real_time_factor: {factor}}}
instances:
  pendulum: {{fmu: {fmus}/DampedPendulum.fmu, start_values: {{a: 1.3}}}}
  gain: {{fmu: {fmus}/Gain.fmu, start_values: {{k: 2.0}}}}
  free: {{fmu: {fmus}/Integrator.fmu}}
connections: [pendulum.a -> gain.u]
record: {{file: {folder}/result.csv}}
zenoh: {{listen: ["tcp/127.0.0.1:0"]}}
"""

Call = Callable[..., tuple[int, str, str]]
Stamped = tuple[int, float, Any]
"""Point, time in s, and value."""


class Mesh:
    """A mesh that runs in processes of its own."""

    def __init__(self, folder: Path, process: subprocess.Popen[str], first_line: str) -> None:
        self.folder = folder
        self.result = folder / "result.csv"
        self.process = process
        self.endpoint = first_line.rpartition(" at ")[2].strip()
        self.lines = [first_line]
        self._reader = threading.Thread(target=lambda: self.lines.extend(process.stderr or ()), daemon=True)
        self._reader.start()

    def end(self) -> int:
        """Wait for its end and return the exit code."""
        code = self.process.wait(DEADLINE_S)
        self._reader.join(DEADLINE_S)
        return code


@contextmanager
def running(*, stop_time: float = 600.0, factor: float = 1.0) -> Iterator[Mesh]:
    """A mesh from its first sign of life to its end, which comes with the block's at the latest."""
    # Not `tmp_path`: the path of a Unix socket has to be short.
    folder = Path(tempfile.mkdtemp(prefix="fmu-"))
    config = folder / "mesh.yaml"
    config.write_text(CONFIG.format(stop_time=stop_time, factor=factor, fmus=FMUS, folder=folder), encoding="utf-8")
    environment = {**os.environ, "FMU_MESH_RUNTIME_DIR": str(folder / "run")}
    command = [sys.executable, "-m", "fmu_mesh", "launch", str(config), "--no-progress"]
    null = subprocess.DEVNULL
    try:
        with subprocess.Popen(
            command, env=environment, text=True, stdin=null, stdout=null, stderr=subprocess.PIPE
        ) as process:
            try:
                assert process.stderr is not None
                first_line = process.stderr.readline()
                while (
                    ": warning: " in first_line.partition("mesh '")[0]
                ):  # every user of this host can connect to such a port
                    first_line = process.stderr.readline()
                assert " at tcp/127.0.0.1:" in first_line, first_line + process.stderr.read()
                yield Mesh(folder, process, first_line)
            finally:
                if process.poll() is None:
                    process.terminate()
                try:
                    process.wait(DEADLINE_S)
                except subprocess.TimeoutExpired:
                    process.kill()
    finally:
        shutil.rmtree(folder)


@contextmanager
def plain_session(mesh: Mesh, mode: str = "client") -> Iterator[zenoh.Session]:
    """A session as any program would open it."""
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", json.dumps([mesh.endpoint]))
    with zenoh.open(config) as session:
        yield session


def ask(session: zenoh.Session, key: str, payload: str | None = None) -> list[zenoh.Sample | zenoh.ReplyError]:
    """All answers to one query, sent when somebody is there to answer."""
    matched = threading.Event()
    with session.declare_querier(key, timeout=DEADLINE_S) as querier:
        listener = querier.declare_matching_listener(lambda status: matched.set() if status.matching else None)
        if not querier.matching_status.matching:  # type: ignore[attr-defined]  # the stub is wrong
            assert matched.wait(DEADLINE_S)
        answers = [reply.ok or reply.err for reply in querier.get(payload=payload)]
        listener.undeclare()
    return [answer for answer in answers if answer is not None]


def ask_one(session: zenoh.Session, key: str, payload: str | None = None) -> Any:  # noqa: ANN401 (it is JSON)
    """The JSON of the only answer."""
    (answer,) = ask(session, key, payload)
    assert isinstance(answer, zenoh.Sample), answer.payload.to_string()
    return json.loads(answer.payload.to_bytes())


def stamped(sample: zenoh.Sample) -> Stamped:
    assert sample.attachment is not None
    stamp = json.loads(sample.attachment.to_bytes())
    return stamp["point"], stamp["time"], json.loads(sample.payload.to_bytes())


class Samples:
    """What a plain subscriber receives, from its first sample to the end of the mesh."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._queue: queue.SimpleQueue[zenoh.Sample | None] = queue.SimpleQueue()
        self._token = session.liveliness().declare_subscriber(f"{ROOT}/mesh", self._token_changed, history=True)
        self._subscriber = session.declare_subscriber(key, self._queue.put)

    def _token_changed(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.DELETE:
            self._queue.put(None)

    def __iter__(self) -> Iterator[zenoh.Sample]:
        while (sample := self._queue.get(timeout=DEADLINE_S)) is not None:
            yield sample

    def until(self, reached: Callable[[zenoh.Sample], bool]) -> zenoh.Sample:
        """The first sample for which something holds."""
        return next(sample for sample in self if reached(sample))


def wait_until_running(session: zenoh.Session) -> None:
    Samples(session, f"{ROOT}/mesh/status").until(
        lambda sample: json.loads(sample.payload.to_bytes())["state"] == "running"
    )


@pytest.fixture(scope="module")
def mesh() -> Iterator[Mesh]:
    """A mesh that lives as long as these tests need it."""
    with running() as mesh:
        with plain_session(mesh) as session:
            wait_until_running(session)
        yield mesh


@pytest.fixture
def session(mesh: Mesh) -> Iterator[zenoh.Session]:
    with plain_session(mesh) as session:
        yield session


@pytest.fixture
def call(mesh: Mesh, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    """Run a command of the command line; returns exit code, output and errors."""
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(mesh.folder / "run"))

    def call(*arguments: str) -> tuple[int, str, str]:
        code = main(arguments)
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


# --- the commands


def test_ls_shows_the_mesh_its_instances_and_their_variables(mesh: Mesh, call: Call) -> None:
    code, out, _ = call("ls")
    assert code == 0
    assert "looked_at  running" in out
    assert mesh.endpoint in out
    assert [line.split()[0] for line in out.splitlines()[3:]] == ["instance", "pendulum", "gain", "free"]

    code, out, _ = call("ls", "-l", "--connect", mesh.endpoint)
    assert code == 0
    assert f"\n{ROOT}/pendulum\n" in out
    assert "\n  out/der(a,2)  Real  continuous   rad/s2" in out

    code, out, _ = call("ls", "gain")
    assert out.splitlines()[0] == f"{ROOT}/gain"
    assert [line.split()[0] for line in out.splitlines()[2:]] == ["in/u", "out/y", "param/k"]


def test_status_and_info_name_meshes_and_instances_in_every_form(call: Call) -> None:
    for key in ("looked_at", ROOT, f"{ROOT}/mesh/status", "looked_at/mesh"):
        status = json.loads(call("status", key, "--json")[1])
        assert (status["mesh"], status["state"], status["last_point"]) == ("looked_at", "running", 60_000)
        assert set(status["progress"]) == {"pendulum", "gain", "free", "@record"}
    for key in ("gain", "looked_at/gain", f"{ROOT}/gain", f"{ROOT}/gain/info"):
        info = json.loads(call("info", key, "--json")[1])
        assert (info["instance"], info["model_name"]) == ("gain", "Gain")
        ends = {"from": "pendulum.a", "to": "gain.u", "delay": 0, "factor": 1.0, "offset": 0.0}
        assert info["connections"] == [{**ends, "map": [], "initial_only": False, "way": "ring"}]
    assert json.loads(call("info", "looked_at", "--json")[1])["instances"] == ["pendulum", "gain", "free"]
    assert call("status")[1].startswith("mesh   looked_at\nstate  running\npoint  ")
    assert "fed by       pendulum.a -> gain.u\n" in call("info", "gain")[1]
    assert "state      running\n" in call("status", "gain")[1]


def test_start_values_are_those_in_effect(call: Call) -> None:
    for command in (("info", "gain"), ("ls", "gain"), ("ls", "-l")):
        assert "\n  param/k   Real  tunable      yes       2.0    Gain\n" in call(*command)[1]
    views = json.loads(call("info", "pendulum", "--json")[1])["variables"]
    starts = {view["name"]: view.get("start") for view in views}
    assert starts == {"a": 1.3, "der(a)": 0.0, "der(a,2)": None, "l": 1.0, "d": 0.1, "g": 9.81}


def test_views_say_what_a_running_mesh_lets_one_set(call: Call) -> None:
    for instance in ("pendulum", "gain", "free"):
        for view in json.loads(call("info", instance, "--json")[1])["variables"]:
            refused = call("set", f"{instance}.{view['name']}", "no number")[2]

            assert view.get("settable", False) == ("expected a number" in refused), refused


def test_setting_an_unknown_name_offers_what_can_be_set(call: Call) -> None:
    near, other = (call("set", f"gain.{name}", "1")[2] for name in ("kk", "z"))

    assert near.endswith("instance 'gain' has no variable 'kk'. Did you mean 'k'?\n")
    assert other.endswith("instance 'gain' has no variable 'z'. There are: k.\n")


def test_get_takes_names_keys_and_wildcards(call: Call) -> None:
    code, out, _ = call("get", "pendulum.l", f"{ROOT}/pendulum/out/der(a,2)")
    assert code == 0
    (key, value, unit, *_), (other, *_) = (line.split() for line in out.splitlines())
    assert (key, value, unit) == (f"{ROOT}/pendulum/param/l", "1.0", "m")
    assert other == f"{ROOT}/pendulum/out/der(a,2)"

    readings = [json.loads(line) for line in call("get", "--json", f"{ROOT}/*/out/*", "*.u")[1].splitlines()]
    names = [f"{reading['instance']}.{reading['variable']}" for reading in readings]
    outputs = ["pendulum.a", "pendulum.der(a)", "pendulum.der(a,2)", "gain.y", "free.y"]
    assert names == [*outputs, "gain.u", "free.u"]
    assert all(reading["time"] == reading["point"] * 0.01 for reading in readings)


@pytest.mark.parametrize(
    ("pattern", "names"),
    [
        ("gain.*", ["gain.u", "gain.y", "gain.k"]),
        ("*n.y", ["gain.y"]),
        ("????.y", ["gain.y", "free.y"]),
        ("pendulum.der(?)", ["pendulum.der(a)"]),
        ("looked_at/re:(gain|free)[.][uy]", ["gain.u", "gain.y", "free.u", "free.y"]),
    ],
)
def test_a_pattern_means_here_what_it_means_in_a_record(call: Call, pattern: str, names: list[str]) -> None:
    lines = call("get", "--json", pattern)[1].splitlines()

    found = [f"{reading['instance']}.{reading['variable']}" for reading in map(json.loads, lines)]
    assert sorted(found) == sorted(names)


def test_a_short_key_names_the_mesh_in_front(call: Call) -> None:
    def key_of(reference: str) -> str:
        key: str = json.loads(call("get", "--json", reference)[1])["key"]
        return key

    short = ("looked_at/pendulum.der(a,2)", "looked_at/*.der(a,2)", "looked_at/pendulum/out/der(a,2)")
    assert {key_of(reference) for reference in short} == {f"{ROOT}/pendulum/out/der(a,2)"}
    assert call("set", "looked_at/free.u", "0.75")[1].startswith(f"{ROOT}/free/set/u holds from point ")
    assert len(call("watch", "looked_at/gain.y", "--count", "2")[1].splitlines()) == 2

    code, _, err = call("get", "loked_at/gain.y")
    assert (code, err) == (2, "fmu-mesh: no mesh 'loked_at/gain.y' is running. Did you mean 'looked_at/gain.y'?\n")


def test_log_messages_from_before_are_shown_and_chosen_by_instance_and_level(
    call: Call, session: zenoh.Session
) -> None:
    refused = Samples(session, f"{ROOT}/mesh/log")
    for key in ("gain/set/u", "gain/set/y", "pendulum/set/l"):
        session.put(f"{ROOT}/{key}", "1")
    told = [json.loads(refused.until(lambda _: True).payload.to_bytes()) for _ in range(3)]

    lines = [json.loads(line) for line in call("logs", "--json")[1].splitlines()]

    assert lines[-3:] == told
    assert [line["number"] for line in lines] == [*range(1, len(lines) + 1)]
    own = call("logs", "looked_at", "--instance", "pendulum")[1].splitlines()
    assert own
    assert all(line.startswith("pendulum at point ") and ": warning: " in line for line in own)
    assert call("logs", "--level", "error") == (0, "", "")
    assert "Did you mean 'gain'?" in call("logs", "--instance", "gian")[2]


def test_of_a_long_log_the_newest_messages_are_kept(call: Call, session: zenoh.Session) -> None:
    published = Samples(session, f"{ROOT}/mesh/log")
    line = {"instance": "gain", "status": "warning", "category": "test", "message": "again", "point": 0}
    for _ in range(1100):
        session.put(f"{ROOT}/gain/log", json.dumps(line), congestion_control=zenoh.CongestionControl.BLOCK)
    first = json.loads(published.until(lambda _: True).payload.to_bytes())["number"]
    published.until(lambda sample: json.loads(sample.payload.to_bytes())["number"] >= first + 1099)

    numbers = [json.loads(line)["number"] for line in call("logs", "--json")[1].splitlines()]

    assert numbers == [*range(numbers[-1] - 999, numbers[-1] + 1)]
    assert numbers[-1] >= first + 1099


def test_set_takes_effect_at_the_point_that_it_answers(call: Call) -> None:
    for name, value in (("free.u", "0.75"), ("gain.k", "-3")):
        code, out, _ = call("set", name, value, "--json")
        assert code == 0
        point = json.loads(out)["point"]
        reading = json.loads(call("get", name, "--json")[1])
        assert reading["value"] == float(value)
        assert reading["point"] >= point


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("gain.u", "1", "'gain.u' is connected to 'pendulum'; only unconnected inputs can be set"),
        ("pendulum.l", "1", "'pendulum.l' is a fixed parameter; only tunable ones can be set while it runs"),
        ("gain.y", "1", "'gain.y' is no input and no parameter, so it cannot be set"),
        ("gain.k", "true", "'gain.k': true is no Real value for it"),
        ("gain.k", "fast", "'gain.k': \"fast\" is no Real value for it"),
        ("gain.*", "1", "'gain.*' means 3 variables: gain.u, gain.y, gain.k"),
    ],
)
def test_what_cannot_be_set_is_refused_with_the_reason(call: Call, name: str, value: str, reason: str) -> None:
    code, out, err = call("set", name, value)
    assert (code, out) == (2, "")
    assert reason in err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("get", "gian.y"), "mesh 'looked_at' has no instance 'gian'. Did you mean 'gain'?"),
        (("get", "pendulum.der(b)"), "instance 'pendulum' has no variable 'der(b)'. Did you mean 'der(a)'?"),
        (("get", f"{ROOT}/gain/out/z"), f"no variable has the key '{ROOT}/gain/out/z'. Did you mean"),
        (("get", "gain"), "'gain' names no variable. Write 'gain.VARIABLE', or 'gain.*' for all."),
        (("get", "*.z"), "mesh 'looked_at' has no variable '*.z'. There are: "),
        (("get", "re:(gain"), "'re:(gain' is no regular expression: missing ), unterminated subpattern at position 0."),
        (("set", "free.*", "1.0"), "'free.*' means 3 variables: "),
        (("get", "fmu_mesh/other/a/out/y"), "no mesh 'fmu_mesh/other/a/out/y' is running."),
        (("get", f"{ROOT}//y"), f"'{ROOT}//y' is no key expression"),
        (("pause", "loked_at"), "no mesh 'loked_at' is running. Did you mean 'looked_at'?"),
    ],
)
def test_an_unknown_name_is_refused_with_the_nearest_one(call: Call, arguments: tuple[str, ...], words: str) -> None:
    code, _, err = call(*arguments)
    assert code == 2
    assert words in err


def test_watch_shows_consecutive_points(call: Call) -> None:
    code, out, _ = call("watch", "gain.y", "--count", "20", "--json")
    assert code == 0
    points = [json.loads(line)["point"] for line in out.splitlines()]
    assert points == list(range(points[0], points[0] + 20))


def test_a_paused_mesh_steps_answers_and_runs_on(call: Call, session: zenoh.Session) -> None:
    statuses = Samples(session, f"{ROOT}/mesh/status")

    def decoded(sample: zenoh.Sample) -> tuple[str, int]:
        status = json.loads(sample.payload.to_bytes())
        return status["state"], min(status["progress"].values())

    try:
        paused = json.loads(call("pause", "looked_at", "--json")[1])
        assert paused["state"] == "paused"
        assert call("set", "free.k", "1")[0] == 0
        held = json.loads(call("get", "free.y", "--json")[1])["point"]
        code, out, _ = call("step", "looked_at", "7")
        assert (code, held) == (0, paused["point"])
        assert out == f"mesh 'looked_at' is paused at point {held + 7}\n"
        statuses.until(lambda sample: decoded(sample)[1] >= held + 7)
        assert json.loads(call("status", "--json")[1])["state"] == "paused"
    finally:
        code, out, _ = call("resume", ROOT)
    assert (code, out.split(" at ")[0]) == (0, "mesh 'looked_at' is running")
    statuses.until(lambda sample: decoded(sample) >= ("running", held + 20))


def test_the_only_mesh_needs_no_name_and_a_number_alone_means_points(call: Call) -> None:
    try:
        paused = json.loads(call("pause", "--json")[1])
        stepped = json.loads(call("step", "10", "--json")[1])
        assert (paused["state"], stepped["point"]) == ("paused", paused["point"] + 10)
        assert json.loads(call("step", "looked_at", "2", "--json")[1])["point"] == stepped["point"] + 2
        assert json.loads(call("step", "--json")[1])["point"] == stepped["point"] + 3
        for number in ("0", "-1", "1.5"):
            assert call("step", number) == (2, "", f"fmu-mesh: N: '{number}' is not a whole number of 1 or more\n")
    finally:
        assert call("resume", "--quiet") == (0, "", "")


def test_clock_stands_while_mesh_rests_after_step_given_while_it_ran(call: Call) -> None:
    def status() -> dict[str, Any]:
        view: dict[str, Any] = json.loads(call("status", "looked_at", "--json")[1])
        return view

    try:
        goal = json.loads(call("step", "looked_at", "5", "--json")[1])["hold"]
        wait_until(lambda: status()["point"] == goal, "the end of the step")
        assert len({status()["points_per_second"] for _ in range(3)}) == 1
    finally:
        assert call("resume", ROOT)[0] == 0


def test_an_instance_that_does_not_answer_is_named_within_the_deadline(call: Call) -> None:
    pid = json.loads(call("info", "free", "--json")[1])["pid"]
    os.kill(pid, signal.SIGSTOP)
    try:
        code, _, err = call("status", "free", "--timeout", "0.5")
    finally:
        os.kill(pid, signal.SIGCONT)
    assert code == 4
    assert "no answer from instance 'free' within 0.5 s" in err
    assert call("status", "free")[0] == 0


def test_without_a_mesh_the_error_says_how_to_start_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(tmp_path))
    assert main(["status"]) == 2
    assert "no mesh is running here. Start one with `fmu-mesh launch CONFIG`" in capsys.readouterr().err
    assert main(["ls", "--connect", "tcp/127.0.0.1:9", "--timeout", "0.2"]) == 4
    assert "nobody answered at tcp/127.0.0.1:9 within 0.2 s" in capsys.readouterr().err


def test_without_a_mesh_ls_has_an_empty_answer_and_hint_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(tmp_path))
    for options, answer in (((), ""), (("--json",), "[]\n"), (("-l",), "")):
        assert main(["ls", *options]) == 0
        shown = capsys.readouterr()
        assert shown.out == answer
        assert "no mesh is running here. Start one with" in shown.err
    assert main(["ls", "gain"]) == 2


def test_several_meshes_are_listed_and_a_key_chooses(mesh: Mesh, call: Call) -> None:
    other = mesh.folder / "run" / "other.1"
    other.mkdir()
    try:
        note = json.loads(next((mesh.folder / "run").glob("looked_at.*/mesh.json")).read_bytes())
        (other / "mesh.json").write_text(json.dumps({**note, "mesh": "other", "pid": os.getpid()}), encoding="utf-8")
        code, _, err = call("get", "gain.y")
        assert code == 2
        assert "2 meshes are running: looked_at, other." in err
        assert call("get", f"{ROOT}/gain/out/y")[0] == 0
        assert call("status", "looked_at")[0] == 0
    finally:
        shutil.rmtree(other)


def test_watch_ends_with_the_mesh_and_with_ctrl_c() -> None:
    with running() as mesh, plain_session(mesh) as session, ExitStack() as stack:
        wait_until_running(session)
        command = [sys.executable, "-m", "fmu_mesh", "watch", "free.*", "--connect", mesh.endpoint]
        watchers = []
        for _ in range(2):
            watcher = stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
            stack.callback(watcher.kill)
            watchers.append(watcher)
        for watcher in watchers:
            assert watcher.stdout is not None
            assert f"{ROOT}/free/" in watcher.stdout.readline()

        watchers[0].send_signal(signal.SIGINT)
        watchers[0].communicate(timeout=DEADLINE_S)
        stop = [sys.executable, "-m", "fmu_mesh", "stop", "looked_at", "--connect", mesh.endpoint]
        stopped = subprocess.run(stop, check=True, capture_output=True, text=True, timeout=DEADLINE_S)
        watchers[1].communicate(timeout=DEADLINE_S)

        assert [watcher.returncode for watcher in watchers] == [130, 0]
        assert "mesh 'looked_at' is stopping at point " in stopped.stdout
        assert mesh.end() == 130, mesh.lines


def test_the_speed_counts_steps_by_hand_with_their_time_and_no_pause(place: Place) -> None:
    simulation = {"step_size": 0.01, "real_time_factor": 2.0}
    config = write_config(place.folder, stop_time=1.0, simulation=simulation)
    mesh = place.start("launch", config, "--paused", "--no-progress")
    mesh.wait_for_error_line("mesh 'pair' at")
    wait_until(lambda: place.run("step", "pair", "50").wait() == 0, "a mesh that has started")
    wait_until(lambda: "50 of 100" in place.run("status").output, "point 50")
    assert place.run("resume", "pair").wait() == 0

    assert mesh.wait() == 0

    # Each start of the clock grants its first point at once: 98 points in 0.49 s are the fastest.
    assert float(mesh.output.rpartition("real-time factor ")[2]) <= 100 / 98 * 2.0 + 0.01


def test_watch_shows_the_last_point_though_it_had_no_processor_at_end(place: Place) -> None:
    mesh = place.start("launch", write_config(place.folder, stop_time=0.2), "--paused", "--no-progress")
    mesh.wait_for_error_line("mesh 'pair' at")
    watch = place.start("watch", "pendulum.a")

    def seen() -> bool:
        place.run("step", "pair", "1")  # refused as long as the mesh starts
        return bool(watch.output)

    wait_until(seen, "a sample")
    with fmu_mesh.attach("pair", connect=place.note().endpoints) as run:
        # For no longer than 2.5 s: then Zenoh writes before it reads on, finds that the master is gone, and gives up.
        watch.signal(signal.SIGSTOP)
        run.resume()
        assert mesh.wait() == 0

        watch.signal(signal.SIGCONT)

    assert watch.wait() == 0
    points = [int(line.partition("(point ")[2].partition(",")[0]) for line in watch.output.splitlines()]
    assert points == list(range(points[0], 201))


# --- nothing but Zenoh


@pytest.mark.parametrize("mode", ["client", "peer"])
def test_a_plain_session_reads_info_status_and_values(mesh: Mesh, mode: str) -> None:
    with plain_session(mesh, mode) as session:
        assert ask_one(session, f"{ROOT}/mesh/info")["instances"] == ["pendulum", "gain", "free"]
        assert ask_one(session, f"{ROOT}/mesh/status")["state"] == "running"
        assert ask_one(session, f"{ROOT}/gain/info")["model_name"] == "Gain"
        first = ask_one(session, f"{ROOT}/gain/status")
        assert first["state"] == "running"
        assert first["time"] == first["point"] * 0.01

        answers = ask(session, f"{ROOT}/pendulum/*/*")
        samples = {str(answer.key_expr): answer for answer in answers if isinstance(answer, zenoh.Sample)}
        names = ["out/a", "out/der(a)", "out/der(a,2)", "param/d", "param/g", "param/l"]
        assert sorted(samples) == [f"{ROOT}/pendulum/{name}" for name in names]
        point, time, value = stamped(samples[f"{ROOT}/pendulum/param/g"])
        assert (value, time) == (9.81, point * 0.01)
        assert all(sample.encoding == zenoh.Encoding.APPLICATION_JSON for sample in samples.values())


def test_tokens_tell_who_is_there(session: zenoh.Session) -> None:
    tokens = [str(reply.ok.key_expr) for reply in session.liveliness().get(f"{ROOT}/**") if reply.ok is not None]
    assert sorted(tokens) == [f"{ROOT}/{name}" for name in ("free", "gain", "mesh", "pendulum")]


def test_a_put_on_an_input_and_on_a_parameter_takes_effect(session: zenoh.Session) -> None:
    for key, shown, value in (("free/set/u", "free/in/u", 0.5), ("gain/set/k", "gain/param/k", 4.25)):
        samples = Samples(session, f"{ROOT}/{shown}")
        session.put(f"{ROOT}/{key}", json.dumps(value))
        for sample in samples:
            if stamped(sample)[2] == value:
                break


def test_an_old_key_still_sets_and_is_warned_of_once(session: zenoh.Session) -> None:
    lines, samples = Samples(session, f"{ROOT}/free/log"), Samples(session, f"{ROOT}/free/in/u")
    for value in (0.125, 0.25):
        session.put(f"{ROOT}/free/in/u", json.dumps(value))
    ask_one(session, f"{ROOT}/free/in/u", "0.375")
    # What others put on the key has no attachment; what the instance says has one.
    samples.until(lambda sample: sample.attachment is not None and stamped(sample)[2] == 0.375)
    session.put(f"{ROOT}/free/in", '{"u": 0.5}')
    samples.until(lambda sample: sample.attachment is not None and stamped(sample)[2] == 0.5)

    told = [json.loads(next(iter(lines)).payload.to_bytes())["message"] for _ in range(2)]
    assert told == [
        f"'{ROOT}/free/in/u' sets nothing from version 0.6 on: send to '{ROOT}/free/set/u'",
        f"'{ROOT}/free/in' sets nothing from version 0.6 on: send to '{ROOT}/free/set'",
    ]


def test_a_value_that_was_put_changes_the_outputs(session: zenoh.Session) -> None:
    outputs = Samples(session, f"{ROOT}/free/out/y")
    point = ask_one(session, f"{ROOT}/free/set/u", "2.0")["point"]
    ask_one(session, f"{ROOT}/free/set/k", "1.0")

    values = iter(outputs)
    before = next(value for at, _, value in map(stamped, values) if at > point + 5)
    after = next(value for at, _, value in map(stamped, values) if at > point + 15)
    assert after > before


@pytest.mark.parametrize(
    ("key", "payload", "reason"),
    [
        ("gain/set/u", "1", "is connected to 'pendulum'"),
        ("pendulum/set/l", "1", "is a fixed parameter"),
        ("gain/set/y", "1", "is no input and no parameter"),
        ("gain/out/y", "1", "is no input and no parameter"),
        ("gain/set/k", '"a"', "is no Real value"),
        ("gain/set/k", "1 2", "it is no JSON value"),
        ("gain/set/z", "1", "has no variable 'z'"),
        ("gain/param/z", "1", "has no variable 'z' under 'param'"),
        ("gain/set/*", "1", "is not the key of one variable"),
        ("gain/set", "[1]", "takes an object with a value for each variable"),
        ("gain/set", '{"u": 1}', "is connected to 'pendulum'"),
        ("free/set", '{"u": 1, "v": 2}', "has no variable 'v'"),
        ("free/in", '{"u": 1, "k": 2}', "has no variable 'k' under 'in'"),
        ("free/in", '{"u": 1, "v": 2}', "has no variable 'v' under 'in'"),
    ],
)
def test_a_refused_query_is_answered_with_the_reason(
    session: zenoh.Session, key: str, payload: str, reason: str
) -> None:
    (answer,) = ask(session, f"{ROOT}/{key}", payload)
    assert isinstance(answer, zenoh.ReplyError)
    assert reason in answer.payload.to_string()


def test_a_refused_put_is_in_the_log(session: zenoh.Session) -> None:
    lines = Samples(session, f"{ROOT}/gain/log")
    ask_one(session, f"{ROOT}/gain/status")
    session.put(f"{ROOT}/gain/set/u", "1.0")
    line = json.loads(next(iter(lines)).payload.to_bytes())
    assert (line["instance"], line["status"], line["category"]) == ("gain", "warning", "set")
    assert "is connected to 'pendulum'" in line["message"]


def test_what_is_refused_again_and_again_is_one_line_at_a_time(session: zenoh.Session) -> None:
    lines = Samples(session, f"{ROOT}/gain/log")
    audit = Samples(session, f"{ROOT}/mesh/audit")
    ask_one(session, f"{ROOT}/gain/status")
    for _ in range(300):
        session.put(f"{ROOT}/gain/set/again", "1.0")
    session.put(f"{ROOT}/gain/set/last", "1.0")
    told: list[str] = []
    while not any("'last'" in message for message in told):
        told.append(json.loads(lines.until(lambda _: True).payload.to_bytes())["message"])

    assert len(told) < 100
    entry = json.loads(audit.until(lambda sample: b"set/again" in sample.payload.to_bytes()).payload.to_bytes())
    assert (entry["what"], entry["text"]) == ("refused", "'gain' has no variable 'again'")


def test_a_stream_is_what_is_recorded_point_by_point() -> None:
    with running(stop_time=2.0) as mesh, plain_session(mesh) as session:
        samples = Samples(session, f"{ROOT}/gain/out/y")
        streamed = [stamped(sample) for sample in samples]
        assert mesh.end() == 0, mesh.lines
        with mesh.result.open(encoding="utf-8", newline="") as file:
            rows = [(float(row["time"]), float(row["gain.y"])) for row in csv.DictReader(file)]

    points = [point for point, _, _ in streamed]
    assert len(points) > 20
    assert points == list(range(points[0], points[0] + len(points)))
    assert [(time, value) for _, time, value in streamed] == rows[points[0] : points[-1] + 1]


def test_what_a_get_answers_is_the_row_of_point_that_it_tells() -> None:
    read = 0
    for _ in range(_RUNS):  # on a busy machine, a run is over after few questions
        read += read_and_compared()
        if read > 300:
            return
    pytest.fail(f"only {read} values were read in {_RUNS} runs")


def read_and_compared() -> int:
    """Read values while a mesh runs at full speed, and compare them with its rows; returns how many were read."""
    with running(stop_time=4000.0, factor=0) as mesh, plain_session(mesh) as session:
        read: list[tuple[str, Stamped]] = []
        while mesh.process.poll() is None and len(read) < 200_000:
            replies = session.get(f"{ROOT}/pendulum/out/*", timeout=1.0)
            samples = [reply.ok for reply in replies if reply.ok is not None]
            read += [(str(sample.key_expr).rpartition("/")[2], stamped(sample)) for sample in samples]
        assert mesh.end() == 0, mesh.lines
        with mesh.result.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))

    wrong = [
        (name, point)
        for name, (point, time, value) in read
        if (float(rows[point]["time"]), float(rows[point][f"pendulum.{name}"])) != (time, value)
    ]
    assert not wrong, f"{len(wrong)} of {len(read)} values are not of their point"
    return len(read)


def test_a_stopped_subscriber_holds_nobody_up() -> None:
    points = 50_000
    with running(stop_time=1e6, factor=0) as mesh, plain_session(mesh) as session:
        wait_until_running(session)
        ask_one(session, f"{ROOT}/mesh/command", '{"command": "pause"}')
        with subscriber_process(mesh, f"{ROOT}/*/out/*") as subscriber:
            received = threading.Event()
            threading.Thread(target=set_when_readable, args=(received, subscriber), daemon=True).start()
            for _ in range(1000):
                ask_one(session, f"{ROOT}/mesh/command", '{"command": "step", "points": 10}')
                if received.wait(DEADLINE_S / 1000):
                    break
            assert received.is_set()

            subscriber.send_signal(signal.SIGSTOP)
            command = json.dumps({"command": "step", "points": points})
            start = ask_one(session, f"{ROOT}/mesh/command", command)["point"]
            statuses = Samples(session, f"{ROOT}/mesh/status")
            for goal in (start + points // 2, start + points):
                statuses.until(partial(has_reached, goal))

            assert ask_one(session, f"{ROOT}/gain/status")["point"] >= start + points


def has_reached(point: int, sample: zenoh.Sample) -> bool:
    """Whether all nodes and the recorder are at a point, by a status of the mesh."""
    return all(reached >= point for reached in json.loads(sample.payload.to_bytes())["progress"].values())


def set_when_readable(event: threading.Event, process: subprocess.Popen[str]) -> None:
    assert process.stdout is not None
    if process.stdout.readline() == "receiving\n":
        event.set()


@contextmanager
def subscriber_process(mesh: Mesh, key: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, str(Path(__file__).with_name("zenoh_subscriber.py")), mesh.endpoint, key]
    with subprocess.Popen(command, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        try:
            yield process
        finally:
            process.kill()
