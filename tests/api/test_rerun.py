"""A run again from its result file: what others set while it went on is in the file, and is set again."""

from __future__ import annotations

import json
import os
import shutil
import signal
from pathlib import Path
from typing import Any

import msgspec
import pytest

import fmu_mesh
from fmu_mesh.api.rerunning import planned_rerun
from fmu_mesh.config.loading import PlainConfig
from fmu_mesh.instances.configuration import examine_data
from fmu_mesh.system.run_metadata import configuration_of
from fmu_mesh.wire.session import matches
from tests.helpers import DEADLINE_S, FMUS, Place, assert_readable, braked, row_count, wait_until, write_config

CONFIGS = sorted((Path(__file__).parents[2] / "configs").glob("*.yaml"))


def steered(folder: Path) -> fmu_mesh.Mesh:
    """Free inputs and tunable parameters of instances with three step sizes, one with linear inputs, and NaN."""
    mesh = fmu_mesh.Mesh("steered", step_size=0.001, stop_time=1.0, not_finite="record")
    mesh.add("fast", fmu=FMUS / "Gain.fmu")
    mesh.add("slow", fmu=FMUS / "Gain.fmu", step_size=0.01)
    mesh.add("ramp", fmu=FMUS / "Gain.fmu", step_size=0.004, interpolation="linear")
    mesh.add("sum", fmu=FMUS / "Integrator.fmu", group="both")
    mesh.connect("fast.y", "sum.u")
    mesh.record(file=folder / "first.csv")
    return mesh


def endless(folder: Path, window: int) -> Path:
    """A mesh with a free input that runs as fast as it can, until it is stopped."""
    instances = {**braked(folder), "free": {"fmu": "Gain"}}
    return write_config(folder, instances=instances, stop_time=1e6, simulation={"window": window})


def metadata_of(file: Path) -> dict[str, Any]:
    """What lies beside a CSV."""
    found: dict[str, Any] = json.loads(file.with_name(f"{file.name}.json").read_text(encoding="utf-8"))
    return found


def test_values_set_at_any_moment_are_set_again_at_the_same_points(folder: Path) -> None:
    with steered(folder).start(paused=True) as run:
        run.set("fast.u", 0.1)
        run.set("slow.k", 2.5, at=0.305)
        run.step(7)
        run.set("slow.u", 3.0)
        run.set("ramp.u", 1.0, at=0.5)
        run.set("ramp.u", -2.0, at=0.9)
        run.step(100)
        run.set("fast.k", float("nan"))
        run.set("fast.k", 4.0)
        run.resume()
        run.wait(DEADLINE_S)

    again = fmu_mesh.rerun("first.csv")

    assert again.file == folder / "first.rerun.csv"
    assert again.file.read_bytes() == (folder / "first.csv").read_bytes()
    noted = metadata_of(folder / "first.csv")["set"]
    assert [(f"{one['instance']}.{one['variable']}", one["value"], one["point"], one["time"]) for one in noted] == [
        ("fast.u", 0.1, 0, None),
        ("slow.k", 2.5, 0, 0.305),
        ("slow.u", 3.0, 10, None),
        ("ramp.u", 1.0, 8, 0.5),
        ("ramp.u", -2.0, 8, 0.9),
        ("fast.k", "NaN", 107, None),
        ("fast.k", 4.0, 107, None),
    ]
    assert noted[2]["key"] == "fmu_mesh/steered/slow/set/u"
    assert f"(pid {os.getpid()})" in noted[0]["who"]
    about = ("point", "instance", "variable", "value", "time")
    assert [[one[name] for name in about] for one in metadata_of(again.file)["set"]] == [
        [one[name] for name in about] for one in sorted(noted, key=lambda one: int(one["point"]))
    ]


def test_a_steered_and_stopped_run_is_run_again_to_its_last_row(folder: Path) -> None:
    with fmu_mesh.load(endless(folder, window=64)).start() as run:
        for value in range(20):
            run.set("free.u", float(value))
            if value % 5 == 0:
                run.pause()
                run.resume()
        run.stop()
        run.wait(DEADLINE_S)

    again = fmu_mesh.rerun("pair.csv", output="again.csv", allow_code=True)

    assert Path("again.csv").read_bytes() == Path("pair.csv").read_bytes()
    assert again["free.y"].max() > 0.0


@pytest.mark.parametrize("window", [16, 262144])  # the free instance is thousands of points ahead of the rows
def test_what_a_killed_run_has_kept_is_run_again(place: Place, folder: Path, window: int) -> None:
    launched = place.start("launch", endless(folder, window=window))
    with fmu_mesh.attach("pair", wait=DEADLINE_S, timeout=DEADLINE_S) as run:
        run.wait_for("running")
        run.set("free.u", 2.0)
        wait_until(lambda: row_count(folder / "pair.csv") > 2000, "rows")
        os.kill(run.instance_info("free").pid, signal.SIGKILL)
    launched.wait()

    fmu_mesh.rerun("pair.csv", allow_code=True)

    first, again = (folder / "pair.csv").read_bytes(), (folder / "pair.rerun.csv").read_bytes()
    assert len(metadata_of(folder / "pair.csv")["set"]) == 1
    assert first.count(b"\n") > 2000
    assert again == first


WAITS = """
import threading
from pathlib import Path

import fmu_mesh

class Waits(fmu_mesh.Component):
    y = fmu_mesh.Output()

    def step(self, now, step_size):
        waiter, go = threading.Event(), Path(__file__).with_name("go")
        while now > 0.0985 and not go.exists():
            waiter.wait(0.001)
        self.y = now
"""


def test_a_value_set_at_a_last_point_is_not_set_again(folder: Path) -> None:
    (folder / "waits.py").write_text(WAITS, encoding="utf-8")
    instances = {"free": {"fmu": "Gain"}, "waits": {"python": "waits.py:Waits"}}
    config = write_config(folder, instances=instances, connections=(), stop_time=0.1)
    with fmu_mesh.load(config).start() as run:
        run.set("free.k", 2.5, at=0.05)
        wait_until(lambda: run.instance_status("free").point == 100, "the last point of one instance")
        run.set("free.u", 3.0)
        (folder / "go").touch()
        first = run.wait(DEADLINE_S)

    again = planned_rerun("pair.csv", output="again.csv", allow_code=True)

    assert [value["variable"] for value in first.metadata["set"] if value["point"] == 100][-1] == "u"
    assert not [value for value in again.values if value.point == 100]
    assert again.run().compare(first).equal


def test_a_value_of_an_unknown_program_is_noted_under_its_key(place: Place, folder: Path) -> None:
    with steered(folder).start(paused=True) as run:
        with place.session() as session:
            publisher = session.declare_publisher("fmu_mesh/steered/fast/set/u")
            wait_until(lambda: matches(publisher), "the subscriber of the node")
            publisher.put("5.5")
            publisher.put("6.5", attachment='{"who": "joystick"}')
            wait_until(lambda: run.get("fast.u") == 6.5, "the value")
        run.resume()
        run.wait(DEADLINE_S)

    noted = metadata_of(folder / "first.csv")["set"]
    assert [(one["value"], one["who"], one["key"]) for one in noted] == [
        (5.5, "unknown", "fmu_mesh/steered/fast/set/u"),
        (6.5, "joystick", "fmu_mesh/steered/fast/set/u"),
    ]


def test_a_rerun_and_a_comparison_name_what_other_machines_calculate_with(folder: Path) -> None:
    first = fmu_mesh.load(write_config(folder, record={"file": "pair.csv"})).run(stop_time=0.1)
    assert first.compare(first).note == ""
    found = metadata_of(folder / "pair.csv")
    found["versions"] |= {"processor": "an older one", "libc": "glibc 1.0"}
    (folder / "pair.csv.json").write_text(json.dumps(found), encoding="utf-8")
    notices: list[str] = []

    again = fmu_mesh.rerun(folder / "pair.csv", on_notice=notices.append)
    comparison = fmu_mesh.Result.read(folder / "pair.csv").compare(again)

    assert comparison.equal
    assert comparison.note.startswith("processor 'an older one' and '")
    assert f"calculated on other machines: {comparison.note}" in comparison.text
    assert "so last digits may differ: processor 'an older one' and '" in notices[0]
    assert ", libc 'glibc 1.0' and '" in notices[0]


def test_the_metadata_say_how_the_result_was_made(folder: Path) -> None:
    mesh = fmu_mesh.load(write_config(folder, record={"file": "pair.csv", "variables": ["pendulum.a", "delay.y"]}))
    mesh.run(start_values={"pendulum.a": 0.1 + 2**-53})

    found = metadata_of(folder / "pair.csv")

    assert found["mesh"] == "pair"
    assert found["versions"]["fmu_mesh"] == fmu_mesh.__version__
    assert {"fmpy", "zenoh", "numpy", "python", "platform", "processor", "libc", "blas"} < found["versions"].keys()
    assert found["models"]["pendulum"]["path"] == str(FMUS / "DampedPendulum.fmu")
    assert len(found["models"]["pendulum"]["sha256"]) == 64
    assert found["start_values"]["pendulum"]["a"] == 0.1 + 2**-53
    assert found["variables"]["pendulum.a"] == {
        "type": "Float64",
        "declared_type": "Real",
        "causality": "output",
        "variability": "continuous",
        "unit": "rad",
        "description": "Angle from the lower rest position",
    }
    assert (found["start_time"], found["step_size"], found["stop_time"], found["set"]) == (0.0, 0.001, 1.0, [])
    assert fmu_mesh.Result.read("pair.csv").units["pendulum.a"] == "rad"


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_the_configuration_of_the_metadata_is_that_of_the_run(path: Path) -> None:
    loaded, findings = examine_data(fmu_mesh.load(path).configuration)
    findings.raise_any()

    data = msgspec.json.decode(msgspec.json.encode(configuration_of(loaded)))

    again, findings = examine_data(PlainConfig(data, path))
    findings.raise_any()
    assert again.config == loaded.config


def test_result_is_run_again_where_model_moved_and_not_where_it_changed(folder: Path) -> None:
    shutil.copy(FMUS / "Gain.fmu", folder / "own.fmu")
    fmu_mesh.load(write_config(folder, instances={"gain": {"fmu": "own.fmu"}}, connections=())).run()
    shutil.copy(FMUS / "Integrator.fmu", folder / "own.fmu")

    with pytest.raises(fmu_mesh.ConfigurationError) as caught:
        fmu_mesh.rerun("pair.csv")

    assert [finding.path for finding in caught.value.findings] == ["models.gain"]
    assert_readable(f"fmu-mesh: {caught.value}")
    assert not Path("pair.rerun.csv").exists()


def test_a_file_that_does_not_say_how_it_was_made_is_refused(place: Place, folder: Path) -> None:
    (folder / "strange.csv").write_text("time,a.y\n0.0,1.0\n", encoding="utf-8")

    launched = place.run("rerun", "strange.csv")

    assert launched.wait() == 2
    assert "does not say how it was made" in launched.errors
    assert "strange.csv.json" in launched.errors


def test_the_result_of_another_user_may_name_code_and_is_refused(folder: Path) -> None:
    fmu_mesh.load(write_config(folder)).run()
    if os.getuid():
        pytest.skip("only root can give a file to another user")
    os.chown("pair.csv", 65534, 65534)

    with pytest.raises(fmu_mesh.ConfigurationError, match="belongs to another user"):
        fmu_mesh.rerun("pair.csv")
    assert len(fmu_mesh.rerun("pair.csv", allow_code=True).times) == 1001


def test_the_command_runs_a_result_again(place: Place, folder: Path) -> None:
    with steered(folder).start(paused=True) as run:
        run.step(7)
        run.set("fast.u", 3.0)
        run.resume()
        run.wait(DEADLINE_S)

    done = place.run("rerun", "first.csv", "--output", "again.csv", "--json")

    assert done.wait() == 0, done.errors
    assert json.loads(done.output)["rows"] == 1001
    assert Path("again.csv").read_bytes() == Path("first.csv").read_bytes()
    assert "is the result itself" in place.run("rerun", "first.csv", "--output", "first.csv").errors


def test_the_command_says_done_where_a_stopped_run_is_repeated(place: Place, folder: Path) -> None:
    with steered(folder).start(paused=True) as run:
        run.step(7)
        run.stop()
        run.wait(DEADLINE_S)

    done = place.run("rerun", "first.csv", "--json")

    assert done.wait() == 0, done.errors
    report = json.loads(done.output)
    assert (report["state"], report["exit_code"], report["point"]) == ("done", 0, 7)


UNREPEATABLE = """
import os
import fmu_mesh

@fmu_mesh.component(y=fmu_mesh.Output())
def draw(time):
    return float(int.from_bytes(os.urandom(6), "big"))
"""


def test_the_command_fails_if_the_values_are_others(place: Place, folder: Path) -> None:
    Path("draw.py").write_text(UNREPEATABLE, encoding="utf-8")
    instances = {"dice": {"python": "draw.py:draw"}}
    config = write_config(folder, instances=instances, connections=(), stop_time=0.01)
    fmu_mesh.load(config).run()

    done = place.run("rerun", "pair.csv", "--json", "--allow-code")

    assert done.wait() == 1, done.errors
    report = json.loads(done.output)
    assert (report["state"], report["exit_code"]) == ("failed", 1)
    assert report["error"]["message"] == "the values are not those of 'pair.csv'."
    assert "dice.y" in done.errors


def test_run_with_scenario_is_run_again_unless_file_of_it_has_changed(folder: Path) -> None:
    Path("drive.csv").write_text("time,u\n0.0,1.0\n0.5,2.0\n", encoding="utf-8")
    Path("drive.yaml").write_text("values: {gain.u: {file: drive.csv, column: u}}\n", encoding="utf-8")
    config = write_config(folder, instances={"gain": {"fmu": "Gain"}}, connections=())
    mesh = fmu_mesh.load(config)
    mesh.scenario(file="drive.yaml")
    with mesh.start(paused=True) as run:
        run.step(300)
        run.set("gain.u", 7.0)
        run.set("gain.k", 3.0)
        run.resume()
        run.wait(DEADLINE_S)

    fmu_mesh.rerun("pair.csv")

    assert Path("pair.rerun.csv").read_bytes() == Path("pair.csv").read_bytes()
    for changed in ("drive.csv", "drive.yaml"):
        before = Path(changed).read_bytes()
        Path(changed).write_bytes(before.replace(b"drive.csv", b"./drive.csv").replace(b"2.0", b"2.5"))
        with pytest.raises(fmu_mesh.ConfigurationError, match=f"files.*{changed}.*as in the first run"):
            fmu_mesh.rerun("pair.csv", output="again.csv")
        Path(changed).write_bytes(before)
