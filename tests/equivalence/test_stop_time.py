"""No step of an FMU ends after the stop time that it was told, over processes as in one.

The FMUs refuse a step whose end, added up in floating point, is greater than their stop time, and abort the process if
their time is set to a later one.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.equivalence.reference import read_csv
from tests.equivalence.test_events import both_ways
from tests.fmus.event_fmus import Version
from tests.fmus.helpers import find_fmu
from tests.helpers import Place

EventFmu = Callable[..., Path]


def last_row(content: bytes) -> dict[str, float]:
    header, rows = read_csv(content)
    return dict(zip(header, rows[-1], strict=True))


@pytest.mark.parametrize(
    ("start", "stop", "step"),
    [
        (0.0, 20.0, 0.01),
        (0.0, 30.0, 0.001),
        (0.0, 60.0, 0.002),
        (-0.6, 0.1, 0.1),
        (0.0, 0.3, 0.1),
        pytest.param(0.0, 10.0, 0.1, id="only the slower one ends after the last point"),
    ],
)
def test_an_fmu_gets_a_stop_time_that_its_last_step_keeps(
    start: float, stop: float, step: float, place: Place, event_fmu: EventFmu
) -> None:
    fmus = [str(find_fmu(f"Steps{version}", place.folder / "fmus")) for version in (1, 2)]
    points = round((stop - start) / step)
    slower = 4 if points % 4 == 0 else 1
    instances: dict[str, Any] = {
        "fmi1": {"fmu": fmus[0]},
        "fmi2": {"fmu": fmus[1]},
        "retried": {"fmu": fmus[1], "retry_discarded_steps": True},
        "slower": {"fmu": fmus[1], "step_size": slower * step},
        "linear": {"fmu": fmus[1]},
        "fmi3": {"fmu": str(event_fmu("Stairs", 3)), "start_values": {"period": 1e9}},
    }
    content = {
        "simulation": {"start_time": start, "stop_time": stop, "step_size": step},
        "instances": instances,
        "connections": [{"from": "fmi2.y", "to": "linear.u", "extrapolation": "linear"}],
    }

    launched, local = both_ways(place, content)

    assert launched == local
    row = last_row(launched)
    assert row["time"] == start + points * step
    for name in set(instances) - {"fmi3"}:
        own = slower if name == "slower" else 1
        assert row[f"{name}.reached"] == (start + (points - own) * step) + own * step, name


@pytest.mark.parametrize("stop", [0.7, 0.8, 4.3])
def test_the_parts_of_the_last_step_end_in_time_too(stop: float, place: Place, event_fmu: EventFmu) -> None:
    fmus = [str(find_fmu(f"Steps{version}", place.folder / "fmus")) for version in (1, 2)]
    instances: dict[str, Any] = {
        "fmi1": {"fmu": fmus[0], "start_values": {"longest_step": 0.03}},
        "fmi2": {"fmu": fmus[1], "start_values": {"longest_step": 0.06}, "retry_discarded_steps": True},
        "fmi3": {"fmu": str(event_fmu("Stairs", 3)), "start_values": {"longest_step": 0.03, "period": 0.37}},
    }

    launched, local = both_ways(
        place, {"simulation": {"stop_time": stop, "step_size": 0.1}, "instances": instances, "connections": []}
    )

    assert launched == local
    row = last_row(launched)
    points = round(stop / 0.1)
    assert row["time"] == points * 0.1
    assert row["fmi1.reached"] == row["fmi2.reached"] == (points - 1) * 0.1 + 0.1
    assert row["fmi3.counter"] == stop // 0.37


@pytest.mark.parametrize("version", [2, 3])
def test_event_that_is_past_stop_time_by_rounding_leaves_model_in_time(
    version: Version, place: Place, event_fmu: EventFmu
) -> None:
    """The third stair is at 0.1 + 0.1 + 0.1, which is greater than 0.3."""
    stairs = {"fmu": str(event_fmu("Stairs", version)), "kind": "model_exchange", "start_values": {"period": 0.1}}

    launched, local = both_ways(
        place,
        {"simulation": {"stop_time": 0.3, "step_size": 0.3}, "instances": {"stairs": stairs}, "connections": []},
    )

    assert launched == local
    assert last_row(launched)["time"] == 0.3
