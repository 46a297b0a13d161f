"""A live cell: what it sends to the page of a notebook while a mesh runs, and what the page draws of it."""

from __future__ import annotations

import base64
import json
import math
import re
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fmu_mesh
from fmu_mesh.api.live_view import LiveView, _Curve
from fmu_mesh.api.samples import Sample
from fmu_mesh.wire.client.readings import Target
from fmu_mesh.wire.views import VariableView
from tests.dashboards import browser, needs_chromium
from tests.helpers import FMUS, wait_until
from tests.notebooks import executed, notebook_of


def gain(**simulation: Any) -> fmu_mesh.Mesh:  # noqa: ANN401  keys of a configuration
    mesh = fmu_mesh.Mesh("live", **{"step_size": 0.01, "stop_time": None, **simulation})
    mesh.add("gain", fmu=FMUS / "Gain.fmu", start_values={"u": 3.0})
    return mesh


def curve() -> _Curve:
    return _Curve(Target("a", "key", VariableView("y", "out/y", "Real", "output", "continuous", "m")))


def rows(drawn: dict[str, Any]) -> tuple[list[float], list[float]]:
    times, values = np.frombuffer(drawn["points"]).reshape(2, -1)
    return times.tolist(), values.tolist()


def sample(point: int, value: float) -> Sample:
    return Sample("a.y", value, point, 0.5 * point, "m")


def test_a_live_cell_has_the_numbers_of_the_result(folder: Path) -> None:
    start = f"""
import json, fmu_mesh
mesh = fmu_mesh.Mesh("live", step_size=0.01, stop_time=5.0, real_time_factor=5.0)
mesh.add("pendulum", fmu={str(FMUS / "DampedPendulum.fmu")!r})
run = mesh.start(record="memory", paused=True)
run.view("pendulum.a", "pendulum.der(a)")
"""
    cells = [
        start,
        "run.resume()\nresult = run.wait()",
        "print(json.dumps([result.times.tolist(), result['pendulum.a'].tolist()]))\nrun.close()",
    ]

    found = executed(notebook_of(cells), folder)

    [shown] = found.shown(0)
    model = shown["application/vnd.jupyter.widget-view+json"]["model_id"]
    state = found.widgets[model]
    first, second = state["curves"]
    times, values = rows(first)
    result = dict(zip(*json.loads(found.cells[2].outputs[0].text), strict=True))
    assert state["state"] == "ended"
    assert (first["name"], first["unit"], second["unit"]) == ("pendulum.a", "rad", "rad/s")
    assert len(times) > 400  # the first values may come before the cell is there
    assert {time: result[time] for time in times} == dict(zip(times, values, strict=True))


def test_a_closed_run_ends_its_live_cell_and_no_thread_is_left() -> None:
    with gain(real_time_factor=1.0).start(record="memory") as run:
        view = run.view("gain.y")
        wait_until(lambda: view.state == "running" and rows(view.curves[0])[0], "some values")

    assert view.state == "ended"
    assert not any(thread.is_alive() for thread in view._threads)
    assert repr(view) == "<LiveView of live: gain.y, ended>"


def test_a_paused_mesh_shows_its_newest_value() -> None:
    with gain().start(record="memory", paused=True) as run:
        view = run.view()
        point = run.step(7).point
        wait_until(lambda: view.curves and rows(view.curves[0])[0][-1:] == [0.01 * point], "the newest value")
        view.close()
        assert re.fullmatch(r"<Run of mesh live: paused, point \d, .* points/s \(started here\)>", repr(run))

    assert view.curves[0]["now"] == "3"


def test_a_live_cell_is_refused_with_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    with gain(real_time_factor=1.0).start(record="memory") as run:
        with pytest.raises(fmu_mesh.UnknownName, match="no variable 'z'"):
            run.view("gain.z")
        monkeypatch.setitem(sys.modules, "anywidget", None)
        monkeypatch.delitem(sys.modules, "fmu_mesh.api.live_view")
        with pytest.raises(fmu_mesh.ConfigurationError, match="anywidget"):
            run.view("gain.y")


def test_more_curves_than_a_cell_can_show_are_refused() -> None:
    mesh = gain(real_time_factor=1.0)
    for number in range(10):
        mesh.add(f"more{number}", fmu=FMUS / "Gain.fmu", group="more")

    with mesh.start(record="memory") as run:
        with pytest.raises(fmu_mesh.CallRefused, match="11 numbers match, and a live cell draws at most 10"):
            run.view("*.y")
        view = run.view()

    assert len(view._curves) == 10


def test_no_line_is_drawn_where_values_were_lost() -> None:
    drawn = curve()
    for point in (0, 2, 4, 10, 12):
        drawn.add(sample(point, float(point)))

    times, values = rows(drawn.drawn())
    assert times == [0.0, 1.0, 2.0, 5.0, 5.0, 6.0]
    assert [str(value) for value in values] == ["0.0", "2.0", "4.0", "nan", "10.0", "12.0"]


def test_a_long_curve_keeps_its_extremes_its_gaps_and_a_bounded_size() -> None:
    drawn, most = curve(), 0
    for point in range(100_000):
        if not 40_000 <= point < 50_000:
            drawn.add(sample(point, 1e6 if point == 12_345 else math.sin(point)))
            most = max(most, len(drawn._times))

    times, values = rows(drawn.drawn())
    lost = [time for time, value in zip(times, values, strict=True) if math.isnan(value)]
    assert most < 4_000
    assert max(values) == 1e6
    assert lost
    assert all(19_900.0 < time < 25_100.0 for time in lost)
    assert times == sorted(times)


def test_a_long_curve_that_falls_is_drawn_falling() -> None:
    drawn = curve()
    for point in range(10_000):
        drawn.add(sample(point, -float(point)))

    _, values = rows(drawn.drawn())
    assert all(after <= before for before, after in pairwise(values))


@needs_chromium
def test_the_page_draws_each_unit_apart_and_breaks_lines_at_gaps(tmp_path: Path) -> None:
    points = [
        np.array([[0.0, 1.0, 2.0, 3.0], [0.0, 1.0, math.nan, 2.0]]),
        np.array([[0.0, 3.0], [1.0, 2.0]]),
        np.zeros((2, 0)),
    ]
    curves = [
        {
            "name": name,
            "unit": unit,
            "held": name == "b.n",
            "now": "2",
            "points": base64.b64encode(own.tobytes()).decode(),
        }
        for name, unit, own in zip(["a.<b>y</b>", "b.n", "c.u"], ["m", "m", "V"], points, strict=True)
    ]
    page = tmp_path / "page.html"
    page.write_text(
        "<!doctype html><meta charset=utf-8><div id=cell></div><script type=module>"
        + str(LiveView._esm).replace("export default { render };", "")
        + f"const curves = JSON.parse(atob('{base64.b64encode(json.dumps(curves).encode()).decode()}'));"
        + "const bytes = (text) => Uint8Array.from(atob(text), (sign) => sign.charCodeAt(0));"
        + "for (const curve of curves) curve.points = new DataView(bytes(curve.points).buffer);"
        + "const state = { curves, state: 'running' };"
        + "render({ model: { get: (key) => state[key], on() {}, off() {} }, el: document.getElementById('cell') });"
        + "</script>",
        encoding="utf-8",
    )

    with browser(tmp_path) as found:
        found.driver.get(page.as_uri())
        plots = found.run("return document.querySelectorAll('#cell svg').length")
        lines = found.run(
            "return [...document.querySelectorAll('#cell path[fill=none]')].map((p) => p.getAttribute('d'))"
        )
        text, problems = found.text, found.problems()

    assert plots == 2
    assert [line.count("M") for line in lines] == [2, 1, 0]
    assert "V" in lines[1]  # a value that holds is drawn in steps
    assert not any("NaN" in line for line in lines)
    assert "a.<b>y</b> = 2 m" in text
    assert problems == []
