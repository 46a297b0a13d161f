"""Values with a time that is no simulation time: a Unix time, or one after the end of the run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import fmu_mesh
from tests.helpers import FMUS, Place, rows_of, wait_until, write_config

NOW = 1.7e9


def endless(folder: Path, **simulation: Any) -> Path:  # noqa: ANN401  as the file has them
    simulation = {"stop_time": None, "step_size": 0.01, **simulation}
    instances: dict[str, dict[str, Any]] = {"gain": {"fmu": "Gain"}, "slow": {"fmu": "Gain", "step_size": 0.02}}
    return write_config(folder, instances=instances, connections=(), name="free", simulation=simulation)


@pytest.mark.parametrize("stop_time", [None, 1000.0, 1e10])
def test_a_stream_with_unix_times_takes_effect_at_once_with_one_warning(stop_time: float | None, place: Place) -> None:
    config = endless(place.folder, real_time_factor=1, stop_time=stop_time)
    launched = place.start("launch", config, "--no-progress")
    place.note()

    def value(session: Any, instance: str) -> float | None:  # noqa: ANN401  of Zenoh
        replies = session.get(f"fmu_mesh/free/{instance}/out/y")
        return next((json.loads(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None), None)

    with place.session() as session:
        wait_until(lambda: value(session, "gain") is not None, "a mesh that runs")

        def shown(number: float) -> None:
            wait_until(lambda: value(session, "slow") == number, "the value")

        for sent in (2.0, 3.0):
            stamp = json.dumps({"time": NOW + sent, "who": "ros /cmd"})
            for instance in ("gain", "slow"):
                session.put(f"fmu_mesh/free/{instance}/set/u", str(sent), attachment=stamp)
            shown(sent)
    assert place.run("stop", "free").wait() == 0
    launched.wait()

    assert {row[1] for row in rows_of(config.with_suffix(".csv"))} == {0.0, 2.0, 3.0}
    told = "the time 1700000002 s that 'ros /cmd' sends is no simulation time of this run"
    for instance in ("gain", "slow"):
        lines = [line for line in launched.errors.splitlines() if line.startswith(f"{instance} at point")]
        assert len(lines) == 1, launched.errors
        assert told in lines[0]
        assert "its values take effect at once. Does it run with use_sim_time?" in lines[0]


def test_set_by_hand_at_a_unix_time_is_refused_with_the_reason(place: Place) -> None:
    config = endless(place.folder, real_time_factor=1)
    launched = place.start("launch", config, "--no-progress")
    place.note()

    refused, taken = place.run("set", "gain.u", "3", "--at", "1.7e9"), place.run("set", "gain.u", "3", "--at", "9e5")

    assert (refused.wait(), taken.wait()) == (2, 0), taken.errors
    assert "the time 1700000000 s is later than 10000" in refused.errors
    assert "s, 1e6 s ahead: is it a Unix time?" in refused.errors
    assert place.run("stop", "free").wait() == 0
    launched.wait()
    assert {row[1] for row in rows_of(config.with_suffix(".csv"))} == {0.0}


def test_a_time_within_the_run_is_taken_however_far_ahead() -> None:
    mesh = fmu_mesh.Mesh("year", step_size=3600.0, stop_time=8760 * 3600.0)
    mesh.add("gain", fmu=FMUS / "Gain.fmu")

    with mesh.start(record="memory", paused=True) as run:
        assert run.set("gain.u", 2.0, at=2e7).point == 5556
        with pytest.raises(fmu_mesh.FmuMeshError, match="31600000 s is later than 31536000 s, the end"):
            run.set("gain.u", 3.0, at=3.16e7)
        run.resume()
        result = run.wait()

    assert result["gain.y"].tolist() == [0.0] * 5557 + [2.0] * 3204
