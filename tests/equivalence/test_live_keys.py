"""Values of Zenoh keys take effect at exactly their points, go out at exactly theirs, and can be repeated."""

from __future__ import annotations

import csv
import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import msgspec
import pytest
import zenoh

import fmu_mesh
from fmu_mesh.wire.session import matches
from tests.helpers import DEADLINE_S, Place, wait_until
from tests.key_meshes import client, key_lines, put_values, stepped_router, written

GAIN = {"gain": {"fmu": "Gain"}}
STEP_S = 0.01


@pytest.fixture
def endpoint(place: Place) -> Iterator[str]:
    with stepped_router(place) as (_, endpoint):
        yield endpoint


def keyed(place: Place, endpoint: str, *connections: dict[str, Any], **more: Any) -> Path:  # noqa: ANN401  as the file has it
    """A gain of 1 and an integrator, with keys."""
    instances = {**GAIN, "sum": {"fmu": "Integrator"}}
    section = {"connect": [endpoint], "mode": "client"}
    return written(place, "live", more.pop("instances", instances), connections, zenoh=section, **more)


def received(run: fmu_mesh.Run, instance: str = "gain") -> int:
    """How many values have come for an instance and were used or refused."""
    return sum(own.received for own in run.instance_status(instance).keys)


def column(config: Path, name: str) -> list[float]:
    with config.with_suffix(".csv").open() as file:
        return [float(row[name]) for row in csv.DictReader(file)]


def taken(run: fmu_mesh.Run, count: int, instance: str = "gain") -> None:
    """Wait until so many values have come; what is asked afterwards, the main thread answers after it has used them."""
    wait_until(lambda: received(run, instance) >= count, f"{count} values")
    run.get(f"{instance}.u")


def is_over(end: float) -> bool:
    return time.monotonic() > end


def has_all(samples: Sequence[object], count: int) -> bool:
    return len(samples) >= count


def assert_repeats(config: Path) -> None:
    """A run without the keys gives the same bytes: in processes, and in this process."""
    result = config.with_suffix(".csv")
    expected = result.read_bytes()
    fmu_mesh.rerun(result, allow_code=True)
    assert config.with_suffix(".rerun.csv").read_bytes() == expected
    fmu_mesh.load(config).run(processes=False, keys_from=result, output=config.with_name("alone.csv"))
    assert config.with_name("alone.csv").read_bytes()[: len(expected)] == expected
    for other in ("live.rerun.csv", "alone.csv"):
        fmu_mesh.rerun(config.with_name(other), output=config.with_name("third.csv"))
        assert config.with_name("third.csv").read_bytes() == config.with_name(other).read_bytes()


@pytest.mark.parametrize("way", ["hold", "linear", "linear and delayed"])
def test_values_with_times_equal_those_of_a_scenario(way: str, place: Place, endpoint: str) -> None:
    random = Random(40)  # noqa: S311 times, and no secret
    times = sorted({0.0, 0.5, 1.0, *(random.uniform(0.0, 1.7) for _ in range(60)), *(0.01 * k for k in range(90, 120))})
    values = [random.uniform(-5.0, 5.0) for _ in times]
    delay = 0.2 if "delayed" in way else 0.0
    kind = "linear" if "linear" in way else "hold"
    more = {"time": "sent[0].at", "field": "sent[0].v", "interpolation": kind, "delay": delay}
    config = keyed(place, endpoint, {"key": "plant/u", "to": "sum.u", **more})
    grid = [0.01 * point for point in range(201)]
    # A value that means a point takes effect at the time of this point, whatever the last bit of a sum is.
    late = [next((on for on in grid if abs(on - at - delay) < 1e-12), at + delay) for at in times]
    table = {"times": late, "values": values, "interpolation": kind}
    same = written(place, "same", {**GAIN, "sum": {"fmu": "Integrator"}}, [], scenario={"values": {"sum.u": table}})

    with client(endpoint) as session, fmu_mesh.load(config).start(paused=True) as run:
        pairs = list(zip(times, values, strict=True))
        random.shuffle(pairs)
        put_values(session, "plant/u", [{"sent": [{"at": at, "v": value}]} for at, value in pairs])
        taken(run, len(pairs), "sum")
        run.resume()
        run.wait(DEADLINE_S)
    fmu_mesh.load(same).run(processes=False)

    assert column(config, "sum.y") == column(same, "sum.y")
    assert len(set(column(config, "sum.y"))) > 60
    assert_repeats(config)


def test_a_value_by_arrival_takes_effect_at_the_next_point(place: Place, endpoint: str) -> None:
    config = keyed(place, endpoint, {"key": "plant/u", "to": "gain.u", "factor": 2.0, "offset": 1.0})
    expected = [0.0]
    with client(endpoint) as session, fmu_mesh.load(config).start(paused=True) as run:
        for number in range(1, 6):
            put_values(session, "plant/u", [number])
            taken(run, number)
            run.step(number)
            wait_until(lambda: run.status.state == "paused", "a pause")
            expected += [2.0 * number + 1.0] * number
        put_values(session, "plant/u", [7, 8, 9])
        taken(run, 8)
        run.step(1)
        run.stop()
        run.wait(DEADLINE_S)
        expected.append(19.0)

    assert column(config, "gain.y") == expected
    assert [line[:3] for line in key_lines(config.with_suffix(".csv"))][:5] == [
        ("gain.u", point, None) for point in (0, 1, 3, 6, 10)
    ]
    assert_repeats(config)


def test_a_timestamp_counts_from_its_origin(place: Place, endpoint: str) -> None:
    origin, stop_time = time.time() - 0.5, 2 * DEADLINE_S
    entry = {"key": "plant/u", "to": "gain.u", "time": "timestamp", "origin": origin}
    config = keyed(place, endpoint, entry, simulation={"stop_time": stop_time})
    sent: list[tuple[float, float]] = []
    with client(endpoint) as session, fmu_mesh.load(config).start(paused=True) as run:
        publisher = session.declare_publisher("plant/u", congestion_control=zenoh.CongestionControl.BLOCK)
        wait_until(lambda: matches(publisher), "a subscriber")
        for number in range(1, 5):
            stamp = session.new_timestamp()
            sent.append((stamp.get_time_as_ntp64().as_nanos() / 1e9 - origin, float(number)))
            publisher.put(str(number), timestamp=stamp)
            wait_until(partial(is_over, time.monotonic() + 3 * STEP_S), "three points")
        publisher.put("5")  # without a timestamp: a router adds its own
        taken(run, 5)
        run.resume()
        run.wait(DEADLINE_S)

    kept = key_lines(config.with_suffix(".csv"))
    assert [line[3] for line in kept] == [1.0, 2.0, 3.0, 4.0, 5.0]
    for (_, point, when, _), (at, _) in zip(kept, sent, strict=False):
        assert point == 0
        assert when == pytest.approx(at, abs=1e-6)  # seconds since 1970 have a resolution of 0.2 us
    expected, rows = [0.0], [(when or 0.0, value) for _, _, when, value in kept]
    for step in range(round(stop_time / STEP_S)):
        past = [value for when, value in rows if when <= step * STEP_S + 1e-9]
        expected.append(past[-1] if past else 0.0)
    assert column(config, "gain.y") == expected
    assert_repeats(config)


# --- out


@pytest.fixture
def heard(endpoint: str) -> Iterator[Callable[[str], list[zenoh.Sample]]]:
    """Subscribes to a key; the list gets what comes."""
    with client(endpoint) as session:

        def hear(key: str) -> list[zenoh.Sample]:
            samples: list[zenoh.Sample] = []
            session.declare_subscriber(
                key,
                samples.append,
            )
            return samples

        yield hear


def messages(samples: Sequence[zenoh.Sample]) -> list[dict[str, Any]]:
    return [json.loads(sample.payload.to_bytes()) for sample in samples]


def test_each_point_and_each_change_goes_out_once(
    place: Place, endpoint: str, heard: Callable[[str], list[zenoh.Sample]]
) -> None:
    keys: list[dict[str, Any]] = [
        {"from": "gain.y", "key": "twin/point", "congestion": "block"},
        {"from": "gain.y", "key": "twin/change", "on": "change", "congestion": "block", "factor": -1.0},
        {"from": "gain.y", "key": "twin/every", "every": 0.25, "congestion": "block"},
        {"from": "gain.y", "key": "twin/rare", "on": "change", "every": 0.5, "congestion": "block"},
        {"from": "slow.y", "key": "twin/slow", "congestion": "block"},
        {"from": "gain.y", "key": "twin/text", "encoding": "text", "congestion": "block"},
        {"from": "gain.y", "key": "twin/double", "encoding": "float64", "congestion": "block"},
    ]
    instances = {**GAIN, "slow": {"fmu": "Gain", "step_size": 0.03}}
    table = {"times": [0.0, 0.5, 0.77, 1.5], "values": [0.0, 0.1, 0.2, 0.3]}
    config = keyed(place, endpoint, *keys, instances=instances, scenario={"values": {"gain.u": table}})
    samples = {key["key"]: heard(str(key["key"])) for key in keys}

    result = fmu_mesh.load(config).run()

    counts = {"twin/point": 201, "twin/change": 4, "twin/every": 9, "twin/rare": 4, "twin/slow": 67}
    counts |= {"twin/text": 201, "twin/double": 201}
    for key, count in counts.items():
        wait_until(partial(has_all, samples[key], count), f"{count} samples of {key}")
    assert {key: len(own) for key, own in samples.items()} == counts
    values = result["gain.y"].tolist()
    points = messages(samples["twin/point"])
    assert [one["value"] for one in points] == values
    assert [one["point"] for one in points] == list(range(201))
    assert [one["time"] for one in points] == result.times.tolist()
    assert [(one["point"], one["value"]) for one in messages(samples["twin/change"])] == [
        (0, -0.0),
        (51, -0.1),
        (78, -0.2),
        (151, -0.3),
    ]
    assert [one["point"] for one in messages(samples["twin/every"])] == list(range(0, 201, 25))
    assert [(one["point"], one["value"]) for one in messages(samples["twin/rare"])] == [
        (0, 0.0),
        (51, 0.1),
        (100, 0.2),
        (151, 0.3),
    ]
    assert [one["point"] for one in messages(samples["twin/slow"])] == list(range(0, 201, 3))
    assert [float(own.payload.to_bytes()) for own in samples["twin/text"]] == values
    doubles = b"".join(own.payload.to_bytes() for own in samples["twin/double"])
    assert memoryview(doubles).cast("d").tolist() == values
    stamps = [own.timestamp for own in samples["twin/point"]]
    assert all(stamp is not None for stamp in stamps)
    assert sorted(map(str, stamps)) == sorted(set(map(str, stamps)))
    assert {str(own.encoding) for own in samples["twin/point"]} == {"application/json"}


def test_a_slow_subscriber_of_a_key_that_blocks_loses_nothing(place: Place, endpoint: str) -> None:
    points = 20_000
    config = keyed(
        place,
        endpoint,
        {"from": "sum.y", "key": "twin/y", "congestion": "block"},
        {"from": "gain.y", "key": "twin/z", "congestion": "block", "encoding": "float64"},
        simulation={"stop_time": points * STEP_S},
        scenario={"values": {"sum.u": 1.0}},
        record={"file": "live.csv", "variables": ["sum.y"]},
    )
    with client(endpoint) as session:
        own = session.declare_subscriber("twin/y", zenoh.handlers.FifoChannel(1))
        got: list[int] = []
        threads = threading.Event()

        def read() -> None:
            for sample in own:
                got.append(json.loads(sample.payload.to_bytes())["point"])
                if len(got) % 1000 == 0:
                    threads.wait(0.05)  # it is slow
                if len(got) > points:
                    return

        reader = threading.Thread(target=read)
        reader.start()
        run = place.start("launch", config, "--no-progress")
        assert run.wait() == 0, run.story()
        reader.join(DEADLINE_S)
        own.undeclare()

    assert got == list(range(points + 1))


# --- again


def fed(place: Place, endpoint: str, points: int, **more: Any) -> Path:  # noqa: ANN401  as the file has it
    """An integrator that waits for the value of each of its points."""
    own = {"key": "plant/u", "to": "sum.u", "time": "time", "wait": True}
    return keyed(place, endpoint, own, simulation={"stop_time": points * STEP_S}, **more)


def waves(points: int) -> list[dict[str, float]]:
    random = Random(7)  # noqa: S311 values, and no secret
    return [{"time": STEP_S * point, "value": random.uniform(-1.0, 1.0)} for point in range(points)]


def assert_same(first: fmu_mesh.Result, other: fmu_mesh.Result) -> None:
    assert first.times.tolist() == other.times.tolist()
    for name in first:
        assert first[name].tolist() == other[name].tolist()


def test_a_run_is_repeated_from_each_of_its_results(place: Place, endpoint: str) -> None:
    (place.folder / "more").mkdir()
    files = [{"file": "live.csv"}, {"file": "more/rows.parquet", "variables": ["sum.y"]}]
    config = fed(place, endpoint, 200, record=files)

    with client(endpoint) as session, fmu_mesh.load(config).start() as run:
        put_values(session, "plant/u", waves(200))
        first = run.wait(DEADLINE_S)

    assert first.metadata["keys"] == "live.csv.keys.jsonl"
    assert len(key_lines(config.with_suffix(".csv"))) == 200
    assert_repeats(config)
    again = fmu_mesh.rerun(place.folder / "more" / "rows.parquet", output=place.folder / "again.parquet")
    assert again["sum.y"].tolist() == first["sum.y"].tolist()
    assert len(set(again["sum.y"].tolist())) == 201


def test_a_run_that_was_stopped_is_repeated_to_its_end(place: Place, endpoint: str) -> None:
    config = fed(place, endpoint, 100_000)
    with client(endpoint) as session, fmu_mesh.load(config).start() as run:
        put_values(session, "plant/u", waves(300))
        wait_until(lambda: run.status.point == 300, "300 points")
        run.stop()
        run.wait(DEADLINE_S)

    assert len(column(config, "sum.y")) == 301
    again = fmu_mesh.rerun(config.with_suffix(".csv"))
    assert again["sum.y"].tolist() == column(config, "sum.y")


def test_a_run_after_a_reset_is_repeated(place: Place, endpoint: str) -> None:
    config = fed(place, endpoint, 200)
    with client(endpoint) as session, fmu_mesh.load(config).start() as run:
        put_values(session, "plant/u", waves(120))
        wait_until(lambda: run.status.point == 120, "120 points")
        run.reset()
        # The subscriber of the run before may still be known for a moment.
        other = [{**one, "value": 2.0 * one["value"]} for one in waves(200)]
        wait_until(lambda: run.instance_status("sum").keys[0].received == 0, "a fresh status")
        put_values(session, "plant/u", other)
        run.wait(DEADLINE_S)

    results = [config.with_suffix(".csv"), config.with_name("live-2.csv")]
    assert [len(key_lines(result)) for result in results] == [120, 200]
    for result in results:
        again = fmu_mesh.rerun(result)
        assert_same(again, fmu_mesh.Result.read(result))
        assert len(set(again["sum.y"].tolist())) == len(again.times)


def test_a_sweep_repeats_the_values_in_each_run(place: Place, endpoint: str) -> None:
    config = fed(place, endpoint, 200)
    with client(endpoint) as session, fmu_mesh.load(config).start() as run:
        put_values(session, "plant/u", waves(200))
        first = run.wait(DEADLINE_S)

    result = config.with_suffix(".csv")
    for k in (1.0, 2.0):
        other = fmu_mesh.load(config).run(
            keys_from=result, start_values={"sum.k": k}, output=place.folder / f"k{k}.csv", processes=k == 1.0
        )
        assert other["sum.y"].tolist() == pytest.approx((k * first["sum.y"]).tolist(), abs=0.0 if k == 1.0 else 1e-12)


TEXTS = """
import hashlib
import fmu_mesh

class Texts(fmu_mesh.Component):
    u = fmu_mesh.Input("", type="String")
    y = fmu_mesh.Output()

    def step(self, time, step_size):
        self.y = float(int(hashlib.sha256(self.u.encode()).hexdigest()[:8], 16))
"""


def test_long_texts_are_repeated_as_well(place: Place, endpoint: str) -> None:
    (place.folder / "texts.py").write_text(TEXTS)
    entry = {"key": "plant/u", "to": "gain.u", "time": "arrival", "encoding": "text", "wait": True}
    instances = {"gain": {"python": "texts.py:Texts"}}
    config = keyed(place, endpoint, entry, instances=instances, simulation={"stop_time": 2 * STEP_S})

    with client(endpoint) as session, fmu_mesh.load(config).start(paused=True) as run:
        put_values(session, "plant/u", [b"\x01" * 2**24, b"A" * (10 << 20)])
        run.resume()
        result = run.wait(DEADLINE_S)

    assert len(set(result["gain.y"].tolist())) == 3
    assert len(key_lines(config.with_suffix(".csv"))) == 2
    assert fmu_mesh.rerun(config.with_suffix(".csv"), allow_code=True)["gain.y"].tolist() == result["gain.y"].tolist()


def test_a_run_does_not_replace_what_it_repeats(place: Place, endpoint: str) -> None:
    config = fed(place, endpoint, 20)
    with client(endpoint) as session, fmu_mesh.load(config).start() as run:
        put_values(session, "plant/u", waves(20))
        run.wait(DEADLINE_S)
    before = [path.read_bytes() for path in sorted(place.folder.glob("live.csv*"))]

    again = place.run("launch", config, "--keys-from", "live.csv")

    assert again.wait() == 2
    assert "is the result whose values of keys this run takes, and would be replaced" in again.message
    assert [path.read_bytes() for path in sorted(place.folder.glob("live.csv*"))] == before
    other = place.run("launch", config, "--keys-from", "live.csv", "--output", "other.csv")
    assert other.wait() == 0, other.story()
    assert (place.folder / "other.csv").read_bytes() == config.with_suffix(".csv").read_bytes()


def test_an_input_without_values_falls_back_and_repeats(place: Place, endpoint: str) -> None:
    inputs = {"u": {"timeout": {"after": 0.1, "then": -7.0}}}
    config = keyed(
        place,
        endpoint,
        {"key": "plant/u", "to": "gain.u", "time": "time"},
        instances={"gain": {"fmu": "Gain", "inputs": inputs}},
    )
    with client(endpoint) as session, fmu_mesh.load(config).start(paused=True) as run:
        put_values(session, "plant/u", [{"time": 0.5, "value": 1.0}, {"time": 0.55, "value": 2.0}])
        taken(run, 2)
        run.resume()
        run.wait(DEADLINE_S)

    assert column(config, "gain.y") == [0.0] * 11 + [-7.0] * 40 + [1.0] * 5 + [2.0] * 10 + [-7.0] * 135
    assert_repeats(config)


def test_a_run_in_one_process_says_what_it_needs(place: Place, endpoint: str) -> None:
    config = keyed(place, endpoint, {"key": "plant/u", "to": "gain.u"})

    local = place.run("launch", config, "--local")

    assert local.wait() == 2
    assert "'gain.u' gets its values by the key 'plant/u', which needs processes with Zenoh" in local.message


def test_a_rerun_takes_no_values_of_today(place: Place, endpoint: str) -> None:
    config = keyed(place, endpoint, {"key": "plant/u", "to": "gain.u"}, {"from": "gain.y", "key": "twin/y"})
    fmu_mesh.load(config).run()
    assert not config.with_name("live.csv.keys.jsonl").exists()

    with client(endpoint) as session:
        samples: list[zenoh.Sample] = []
        session.declare_subscriber("twin/y", samples.append)
        again = fmu_mesh.rerun(config.with_suffix(".csv"))

    assert set(again["gain.y"].tolist()) == {0.0}
    assert not samples
    assert msgspec.json.decode(config.with_name("live.csv.json").read_bytes())
