"""What a run records besides outputs, and into several files: the same bytes in processes as in one process."""

from __future__ import annotations

import csv
import re
import signal
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap.reader import make_reader

import fmu_mesh
from tests.equivalence.test_types import written
from tests.fmus.helpers import NO_COMPILER
from tests.fmus.packing import repacked
from tests.helpers import BY_STREAMS, BY_ZENOH, Place, rows_of, wait_until, write_config

SOURCE = """
import fmu_mesh

class Mid(fmu_mesh.Component):
    \"\"\"Between two FMUs.\"\"\"
    gain = fmu_mesh.Parameter(0.9)
    u = fmu_mesh.Input()
    v = fmu_mesh.Input(shape=(2,))
    free = fmu_mesh.Input(start=0.25)
    y = fmu_mesh.Output()
    z = fmu_mesh.Output(shape=(2,))

    def step(self, time, step_size):
        self.y = self.gain * self.u - float(self.v[0]) + time + self.free
        self.z[:] = [self.y * step_size, self.y]
"""
INSTANCES: dict[str, dict[str, Any]] = {
    "left": {"fmu": "Gain", "start_values": {"k": 0.7}},
    "mid": {"python": "mid.py:Mid"},
    "right": {"fmu": "TransportDelay", "start_values": {"d": 0.01}},
    "pendulum": {"fmu": "DampedPendulum", "start_values": {"a": 1.3}, "step_size": 0.004},
    "pid": {"controller": "position_pid", "start_values": {"p": 2.0, "target": 0.5}, "step_size": 0.002},
}
CONNECTIONS: list[Any] = [
    "left.y -> mid.u",
    {"from": "pendulum.a", "to": "mid.v[1]", "factor": 0.5, "offset": 0.25},
    {"from": "mid.y", "to": "right.x", "factor": 0.5},
    "right.y -> left.u",
    "mid.z[2] -> pid.position",
]
"""A cycle (left, mid, right), and instances with step sizes of their own before and after it."""

RECORDS: list[dict[str, Any]] = [
    {"file": "all.csv", "variables": ["*", "in:*", "param:*"]},
    {"file": "slow.csv", "variables": ["in:mid.*", "pendulum.l", "left.y"], "every": 7, "from": 0.05},
    {"file": "bag.mcap", "variables": ["pendulum.a", "mid.v"], "every": 3},
]
CSV = ("all.csv", "slow.csv")


def config(folder: Path, **sections: Any) -> Path:  # noqa: ANN401  any part of a file
    """A configuration with all kinds of instances that need no package."""
    (folder / "mid.py").write_text(SOURCE)
    return write_config(
        folder,
        instances=INSTANCES,
        connections=CONNECTIONS,
        name="many",
        stop_time=0.4,
        **{"record": RECORDS, **sections},
    )


def files_of(place: Place, path: Path, *options: str, names: tuple[str, ...] = CSV) -> list[bytes]:
    """The bytes of the files of one run."""
    done = place.run("launch", path, "--no-progress", *options)
    assert done.wait() == 0, done.errors
    return [(path.parent / name).read_bytes() for name in names]


def messages_of(path: Path) -> list[tuple[str, int, int, bytes]]:
    """Topic, time, number and content of each message of a bag."""
    with path.open("rb") as file:
        return [
            (channel.topic, message.log_time, message.sequence, message.data)
            for _, channel, message in make_reader(file).iter_messages()
        ]


@pytest.mark.parametrize(
    ("options", "sections"),
    [
        ((), {}),
        (("--window", "1"), {}),
        (("--algorithm", "jacobi"), {}),
        ((), {"group": "auto"}),
        ((), {"zenoh": BY_STREAMS}),
        ((), {"zenoh": BY_ZENOH}),
    ],
    ids=["memory", "window 1", "jacobi", "groups", "streams", "frames"],
)
def test_all_files_have_the_bytes_of_a_run_in_one_process(
    place: Place, options: tuple[str, ...], sections: dict[str, Any]
) -> None:
    path = config(place.folder, **sections)

    expected = files_of(place, path, "--local", *options)
    bag = messages_of(place.folder / "bag.mcap")
    found = files_of(place, path, *options)

    assert found == expected
    assert messages_of(place.folder / "bag.mcap") == bag
    assert len(rows_of(place.folder / "all.csv")) == 401
    place.assert_nothing_left()


@pytest.mark.parametrize("library", ["C", "Python"])
def test_many_runs_with_loaded_models_record_the_same(
    place: Place, library: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first file; the other files are those of a run that is started as such."""
    if library == "Python":
        monkeypatch.setattr("fmu_mesh.rings.native.library", None)
    path = config(place.folder)
    expected = files_of(place, path, "--local", names=("all.csv",))[0]
    (place.folder / "slow.csv").unlink()

    with fmu_mesh.load(path).repeated() as runs:
        for _ in range(2):
            result = runs.run(output=place.folder / "again.csv")
            assert (place.folder / "again.csv").read_bytes() == expected
            assert [each.file for each in result.all] == [place.folder / "again.csv"]

    assert not (place.folder / "slow.csv").exists()


@pytest.mark.parametrize("version", [2, 3])
def test_states_of_fmus_without_outputs_are_recorded_in_every_way_to_run(
    version: int, place: Place, event_fmu: Callable[..., Path]
) -> None:
    source = event_fmu("Oscillator", version)
    repacked(place.folder / "Silent.fmu", source=source, description=without_outputs)
    own = "instances:\n  cs: {fmu: Silent.fmu}\n  me: {fmu: Silent.fmu, kind: model_exchange}\n"
    times = "mesh: silent\nsimulation: {stop_time: 0.3, step_size: 0.01}\n"
    path = place.folder / "silent.yaml"
    path.write_text(f"{times}{own}record: {{file: silent.csv}}\n")

    (local,) = files_of(place, path, "--local", names=("silent.csv",))
    (distributed,) = files_of(place, path, names=("silent.csv",))
    with fmu_mesh.load(path).repeated() as runs:
        repeated = runs.run()

    assert local.startswith(b"time,cs.x,cs.y,me.x,me.y\n0.0,2.0,0.0,2.0,0.0\n")
    assert distributed == local
    assert repeated["me.y"].tolist() == columns_of(place.folder / "silent.csv")["me.y"]


def without_outputs(description: str) -> str:
    """A model description whose outputs are locals."""
    text = description.replace('causality="output"', 'causality="local"')
    return re.sub(r"<Outputs>.*?</Outputs>|<Output [^>]*>", "", text, flags=re.DOTALL)


def columns_of(path: Path) -> dict[str, list[float]]:
    """The columns of a CSV of numbers."""
    with path.open(newline="") as file:
        names, *rows = csv.reader(file)
    return {name: [float(row[place]) for row in rows] for place, name in enumerate(names)}


@pytest.mark.parametrize("options", [(), ("--local",)], ids=["distributed", "local"])
def test_an_input_has_the_value_with_which_its_instance_came_to_point(place: Place, options: tuple[str, ...]) -> None:
    """That of the source at this point, or with delay 1 at the point before; of a slow instance, at its own point."""
    path = write_config(
        place.folder,
        instances={
            "pendulum": {"fmu": "DampedPendulum", "start_values": {"a": 1.3}},
            "now": {"fmu": "Gain", "start_values": {"k": 2.0}},
            "before": {"fmu": "Gain"},
            "slow": {"fmu": "Gain", "step_size": 0.004},
        },
        connections=[
            "pendulum.a -> now.u",
            {"from": "pendulum.a", "to": "before.u", "delay": 1, "factor": 3.0},  # type: ignore[list-item]  # the long form
            "pendulum.a -> slow.u",
        ],
        stop_time=0.1,
        record={"file": "pair.csv", "variables": ["pendulum.a", "in:*", "param:now.*"]},
    )

    assert place.run("launch", path, *options).wait() == 0

    columns = columns_of(place.folder / "pair.csv")
    a = columns["pendulum.a"]
    assert columns["now.u"] == a
    assert columns["before.u"] == [3.0 * value for value in [a[0], *a[:-1]]]
    assert columns["slow.u"] == [a[point // 4 * 4] for point in range(101)]
    assert columns["now.k"] == [2.0] * 101


@pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))
@pytest.mark.parametrize("zenoh", [{}, BY_STREAMS, BY_ZENOH], ids=["memory", "streams", "frames"])
def test_inputs_and_parameters_of_every_type_and_version_of_fmi(place: Place, zenoh: Mapping[str, bool]) -> None:
    path = written(place.folder)
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    outputs = content["record"]["variables"]
    texts = [f"{i}.{name}" for i in "ab" for name in ("string_array_in", "binary_array_in")]
    texts += ["old.string_in", "older.string_in"]
    content["record"] = [
        {"file": "inputs.csv", "variables": ["in:*", "param:*", "local:*", *texts]},
        {"file": "all.csv", "variables": [*outputs, "in:a.float64*", "b.int8_array_in[1,2]"], "every": 2},
    ]
    content["zenoh"] = zenoh
    path.write_text(yaml.safe_dump(content, sort_keys=False, allow_unicode=True), encoding="utf-8")

    expected = files_of(place, path, "--local", names=("inputs.csv", "all.csv"))
    found = files_of(place, path, names=("inputs.csv", "all.csv"))

    assert found == expected
    with (place.folder / "inputs.csv").open(newline="", encoding="utf-8") as file:
        names, *rows = csv.reader(file)
    assert {"a.columns", "b.uint64_array_in[2,3]", "old.string_in", "older.string_in", "b.binary_array_in[1,1]"} <= {
        *names
    }
    assert len(rows) == 8
    place.assert_nothing_left()


def test_value_set_while_it_waits_is_in_rows_after_this_point(place: Place) -> None:
    """Also if somebody begins to watch before: a row has what its step used. A query tells the new value."""
    path = write_config(
        place.folder,
        instances={"gain": {"fmu": "Gain", "start_values": {"k": 2.0, "u": 1.0}}},
        connections=[],
        record={"file": "pair.csv", "variables": ["*", "in:*", "param:*"]},
    )
    with fmu_mesh.load(path).start(paused=True, stop_time=0.01) as run:
        run.step(5)
        run.set("gain.u", 3.0)
        run.set("gain.k", 4.0)
        assert (run.get("gain.u"), run.get("gain.k")) == (3.0, 4.0)
        with run.watch("gain.k", "gain.u", "gain.y") as samples:
            run.step(1)
            assert {sample.value for sample in samples_at(samples, point=6, count=3)} == {3.0, 4.0, 12.0}
        run.resume()
        result = run.wait()

    assert result["gain.u"].tolist() == [1.0] * 6 + [3.0] * 5
    assert result["gain.k"].tolist() == [2.0] * 6 + [4.0] * 5
    assert result["gain.y"].tolist() == [2.0] * 6 + [12.0] * 5


@pytest.mark.parametrize("processes", [True, False], ids=["distributed", "local"])
def test_a_result_has_those_of_all_files(place: Place, processes: bool) -> None:  # noqa: FBT001  a parameter of tests
    mesh = fmu_mesh.load(config(place.folder, record=RECORDS[:2]))

    result = mesh.run(processes=processes)

    first, slow = result.all
    assert first is result
    assert slow.file == place.folder / "slow.csv"
    assert slow.names == ["mid.u", "mid.v[1]", "mid.v[2]", "mid.free", "pendulum.l", "left.y"]
    assert slow.times.tolist() == result.times[50::7].tolist()
    assert slow["mid.u"].tolist() == result["mid.u"][50::7].tolist()
    assert slow.units["pendulum.l"] == "m"
    assert [each.file for each in slow.all] == [each.file for each in result.all]
    assert result.outcome is not None
    assert result.outcome.files == ((str(place.folder / "all.csv"), 401), (str(place.folder / "slow.csv"), 51))


def test_in_memory_is_the_first_file(place: Place) -> None:
    mesh = fmu_mesh.load(config(place.folder, record=[RECORDS[1], RECORDS[0]]))

    result = mesh.run(record="memory")

    assert (len(result.times), result.all) == (51, (result,))
    assert not list(place.folder.glob("*.csv"))


def test_all_files_are_named_when_a_run_ends_early(place: Place) -> None:
    path = config(place.folder, simulation={"stop_time": None, "real_time_factor": 1})
    launched = place.start("launch", path, "--no-progress")
    wait_until(lambda: not launched.running or len(rows_so_far(place.folder / "slow.csv")) > 3, "rows of slow.csv")

    launched.signal(signal.SIGINT)

    assert launched.wait() == 130
    rows = {name: len(rows_of(place.folder / name)) for name in CSV}
    points = rows["all.csv"]
    assert rows["slow.csv"] == len(range(50, points, 7))
    bag = [sequence for topic, _, sequence, _ in messages_of(place.folder / "bag.mcap") if topic == "/pendulum/a"]
    assert bag == [point for point in range(0, points, 3) if point == 0 or point // 4 > (point - 3) // 4]
    files = [f"'{place.folder / name}' ({count} rows)" for name, count in rows.items()]
    last = f"'{place.folder / 'bag.mcap'}' ({len(range(0, points, 3))} rows)"
    assert f"What was recorded up to then is in {', '.join(files)} and {last}." in launched.errors
    place.assert_nothing_left()


def samples_at(samples: Iterator[fmu_mesh.Sample], point: int, count: int) -> list[fmu_mesh.Sample]:
    """The first samples of a point."""
    found: list[fmu_mesh.Sample] = []
    for sample in samples:
        assert sample.point <= point
        found += [sample] if sample.point == point else []
        if len(found) == count:
            break
    return found


def rows_so_far(file: Path) -> list[str]:
    """The lines of a file, which may not be there yet."""
    return file.read_text().splitlines() if file.is_file() else []
