"""The page of the dashboard in a real browser: what it shows, what its elements do, and what it costs the run."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from PIL import Image
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from fmu_mesh.api.result import Result
from tests.dashboards import Browser, Dashboard, browser, needs_chromium
from tests.helpers import Place, wait_until, write_config

pytestmark = needs_chromium

PACED = {"real_time_factor": 1.0, "step_size": 0.002}

_DRIVE = """
import fmu_mesh

class Drive(fmu_mesh.Component):
    speed = fmu_mesh.Input(0.0, unit="m/s", min=-10.0, max=10.0)
    mode = fmu_mesh.Input(0, type="Enumeration", items={"off": 0, "slow": 1, "fast": 2})
    brake = fmu_mesh.Input(False, type="Boolean")
    y = fmu_mesh.Output(0.0, unit="m/s")

    def step(self, time, step_size):
        if self.speed > 9.0:
            raise RuntimeError("the drive is broken")
        self.y = 0.0 if self.brake else self.speed + 100.0 * self.mode
"""


def _drive(place: Place) -> Path:
    (place.folder / "drive.py").write_text(_DRIVE, encoding="utf-8")
    return write_config(
        place.folder,
        name="drive",
        instances={"drive": {"python": "drive.py:Drive"}, "gain": {"fmu": "Gain"}},
        connections=["drive.y -> gain.u"],
        stop_time=3600.0,
        simulation=PACED,
    )


def _status(place: Place, mesh: str) -> dict[str, Any]:
    status: dict[str, Any] = json.loads(place.run("status", mesh, "--json").output)
    return status


def _value(place: Place, name: str) -> Any:  # noqa: ANN401  the type follows from the variable
    return json.loads(place.run("get", name, "--json").output)["value"]


def _open(page: Browser, url: str) -> None:
    page.driver.get(url)
    wait_until(lambda: page.state == "running", "a running mesh on the page")


def _field(page: Browser, name: str, selector: str) -> Any:  # noqa: ANN401  an element of selenium
    """The element with which a variable is set."""

    def found() -> Any:  # noqa: ANN401  as above
        for line in page.driver.find_elements(By.CSS_SELECTOR, ".fm-field"):
            if name in line.text:
                return next(iter(line.find_elements(By.CSS_SELECTOR, selector)), None)
        return None

    return wait_until(found, f"the field of {name}")


def test_the_page_shows_run_from_its_start_and_asks_no_other_host(place: Place) -> None:
    config = write_config(place.folder, stop_time=3600.0, simulation=PACED)
    place.start("launch", config, "--no-progress")
    place.run("wait", "pair")
    wait_until(lambda: _status(place, "pair")["point"] > 1000, "some points")
    dashboard = Dashboard(place)

    with browser(place.folder) as page:
        _open(page, dashboard.url)
        wait_until(lambda: [time for time, _ in page.curve("pendulum.a")[:1]] == [0.0], "the start")
        first = len(page.curve("pendulum.a"))
        wait_until(lambda: len(page.curve("pendulum.a")) > first, "new values")
        drawn = wait_until(lambda: page.instances, "the graph of the mesh")
        address = page.driver.current_url

        assert drawn == ["pendulum", "delay"]
        assert "real-time factor" in page.text
        assert "token" not in address
        assert "curve=" in address
        assert "defects" not in page.text  # which this run does not look at
        assert page.run(_RINGS) == 0
        assert page.problems() == []
        assert page.hosts() == {"127.0.0.1"}
        page.driver.refresh()
        wait_until(lambda: page.state == "running" and page.curve("pendulum.a"), "the same page again")
    place.run("stop", "pair")


_TIP = "return document.querySelector('.fm-graph .edge title')?.textContent ?? ''"
_RINGS = "return document.querySelectorAll('.fm-graph .ring').length"


def test_edges_and_a_table_show_defects_in_both_themes(place: Place) -> None:
    config = write_config(place.folder, stop_time=3600.0, simulation={**PACED, "defects": True})
    dashboard = Dashboard(place)

    with browser(place.folder) as page:
        page.driver.get(dashboard.url)
        run = place.start("launch", config, "--no-progress")
        wait_until(lambda: page.state == "running", "the mesh on the page")
        wait_until(lambda: "\nassumed and came differ by at most " in page.run(_TIP), "the defect of the edge")
        title = "Largest defects: a pointer to the connection, no error estimate"
        wait_until(lambda: title in page.text, "the table of defects")
        assert page.run(_RINGS) == 1
        shown = _status(place, "pair")["defects"]["pendulum.a -> delay.x"]
        assert 0.0 < shown["rms"] < shown["maximum"]
        for theme, least, most in (("light", 200.0, 255.0), ("dark", 0.0, 80.0)):
            page.show_as(theme, 1280, 800)
            wait_until(lambda: least <= _mean(page.picture(".fm-defects")) <= most, f"the {theme} theme")  # noqa: B023  called now

        place.run("stop", "pair")
        assert run.wait() == 130
        last = Result.read(place.folder / "pair.csv").defects["pendulum.a -> delay.x"]
        text = f"by at most {last.maximum:.3g} (at t = {last.time:.12g} s), RMS {last.rms:.3g}"
        wait_until(lambda: text in page.run(_TIP), "the defect in the result file")
        assert f"{last.rms:.3g}" in page.text
        assert page.problems() == []


def test_no_line_is_drawn_over_the_time_in_which_nobody_looked(place: Place) -> None:
    recorded = {"file": "pair.csv", "variables": ["pendulum.a"]}
    config = write_config(place.folder, stop_time=3600.0, simulation=PACED, record=recorded)
    place.start("launch", config, "--no-progress")
    dashboard = Dashboard(place)

    with browser(place.folder) as page:
        page.driver.get(f"{dashboard.url}&mesh=fmu_mesh/pair&curve=0:delay.y&curve=1:pendulum.a")
        wait_until(lambda: len(page.curve("delay.y")) > 10, "some values")
        process = psutil.Process(dashboard.process.pid)
        process.suspend()
        try:
            asleep = page.curve("delay.y")[-1][0] + 2.0
            wait_until(lambda: _status(place, "pair")["time"] > asleep, "2 s of simulation")
        finally:
            process.resume()
        wait_until(lambda: sum(time > asleep for time, _ in page.curve("delay.y")) > 5, "values after it woke")
        seen = [time for time, _ in page.curve("delay.y") if time < asleep]

        drawn = wait_until(
            lambda: line if (line := page.line(0)) and (line[-1][0] or 0.0) > asleep else None, "both parts"
        )
        assert [seen[-1], None] in drawn
        assert all(value is not None for _, value in page.line(1)[:-1])  # what is recorded has no gap
    place.run("stop", "pair")


_CONTRASTS = """
const luminance = (rgb) => rgb.map((c) => (c /= 255) <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4)
  .reduce((sum, c, i) => sum + c * [0.2126, 0.7152, 0.0722][i], 0);
const numbers = (color) => color.match(/[0-9.]+/g).map(Number);
const ground = (e) => { for (; e; e = e.parentElement) {
  const own = numbers(getComputedStyle(e).backgroundColor); if ((own[3] ?? 1) > 0.5) return own.slice(0, 3); } };
const texts = [...document.querySelectorAll('header *')].filter((e) =>
  e.getClientRects().length && [...e.childNodes].some((n) => n.nodeType === 3 && n.data.trim()));
return texts.map((e) => { const ink = numbers(getComputedStyle(e).color), under = ground(e), a = ink[3] ?? 1;
  const pair = [luminance(ink.slice(0, 3).map((c, i) => a * c + (1 - a) * under[i])), luminance(under)].sort();
  return [e.innerText, (Math.max(...pair) + 0.05) / (Math.min(...pair) + 0.05)]; });
"""
"""The texts of the head, each with its contrast to what is behind it (WCAG 2.2, 1.4.3)."""
_NAMED = {
    "button",
    "checkbox",
    "combobox",
    "dialog",
    "image",
    "log",
    "region",
    "slider",
    "spinbutton",
    "switch",
    "textbox",
}


def test_the_page_can_be_read_in_both_themes_on_phones_and_aloud(place: Place) -> None:
    place.start("launch", _drive(place), "--no-progress")
    dashboard = Dashboard(place)

    with browser(place.folder) as page:
        _open(page, dashboard.url)
        wait_until(lambda: page.instances, "the graph of the mesh")
        for theme, least, most in (("light", 200.0, 255.0), ("dark", 0.0, 60.0)):
            page.show_as(theme, 1280, 800)
            wait_until(lambda: least <= _mean(page.picture(".fm-columns")) <= most, f"the {theme} theme")  # noqa: B023  called now
            assert least <= _mean(page.picture(".fm-graph")) <= most
            assert least <= _mean(page.picture(".fm-plot")) <= most
            contrasts = page.run(_CONTRASTS)
            assert len(contrasts) > 5
            assert [text for text, contrast in contrasts if contrast < 4.5] == []

        page.show_as("dark", 390, 844)
        wait_until(lambda: page.run("return document.querySelector('header').offsetHeight") <= 0.12 * 844, "a low head")
        assert page.run("return document.documentElement.scrollWidth") <= 390
        spoken = page.spoken()
        assert [part for part in spoken if part[0] in _NAMED and not part[1]] == []
        assert {"banner", "main", "status", "log", "table"} <= {role for role, _ in spoken}
        assert {
            ("button", "Pause"),
            ("slider", "drive.speed"),
            ("switch", "drive.brake"),
            ("spinbutton", "gain.k"),
        } <= {*spoken}
        assert page.run("return document.documentElement.lang").startswith("en")

        place.run("set", "drive.speed", "9.5")
        wait_until(lambda: page.state == "failed", "the failure")
        assert "RuntimeError: the drive is broken" in page.text
        graph = "return document.querySelector('.fm-graph').textContent"
        wait_until(lambda: "ended" in page.run(graph) and "points/s" not in page.run(graph), "the end in the graph")


def _mean(picture: Image.Image) -> float:
    """The mean of all grey values, from 0 to 255."""
    return float(np.asarray(picture.convert("L")).mean())


def test_its_elements_steer_the_mesh_and_set_values(place: Place) -> None:
    place.start("launch", _drive(place), "--no-progress")
    dashboard = Dashboard(place)

    with browser(place.folder) as page:
        _open(page, dashboard.url)

        slider = _field(page, "drive.speed", ".q-slider")
        right = ActionChains(page.driver).move_to_element_with_offset(slider, slider.size["width"] // 4, 0)
        right.click().perform()
        wait_until(lambda: 4.0 < _value(place, "drive.speed") < 6.0, "the speed of the slider")
        number = _field(page, "gain.k", "input")
        number.send_keys(Keys.CONTROL, "a")
        number.send_keys("2.5", Keys.ENTER)
        wait_until(lambda: _value(place, "gain.k") == 2.5, "the gain of the field")
        _field(page, "drive.brake", "[role=switch]").click()
        wait_until(lambda: _value(place, "drive.brake") is True, "the brake of the switch")
        place.run("set", "drive.speed", "-4")
        wait_until(
            lambda: _field(page, "drive.speed", "input").get_property("value") == "-4", "what somebody else has set"
        )

        page.click("Pause")
        wait_until(lambda: page.state == "paused", "the pause")
        before = _status(place, "drive")["point"]
        page.click("Step")
        wait_until(lambda: _status(place, "drive")["point"] == before + 1, "one more point")
        page.click("Resume")
        wait_until(lambda: page.state == "running", "the end of the pause")
        page.click("Stop")
        page.click("Stop the run")
        wait_until(lambda: page.state in ("ended", "stopping", "done", "failed"), "the end of the mesh")
        assert page.problems() == []
    wait_until(lambda: not place.processes("master"), "the end of the master")


def test_a_page_that_only_reads_has_nothing_to_set_or_steer(place: Place) -> None:
    place.start("launch", _drive(place), "--no-progress")
    dashboard = Dashboard(place, "--read-only")

    with browser(place.folder) as page:
        _open(page, dashboard.url)
        wait_until(lambda: page.pictures > 3, "pictures")

        assert "read only" in page.text.lower()
        buttons = " ".join(button.text for button in page.driver.find_elements(By.TAG_NAME, "button")).lower()
        assert not any(word in buttons for word in ("pause", "step", "stop", "resume"))
        assert page.driver.find_elements(By.CSS_SELECTOR, ".fm-field") == []
    place.run("stop", "drive")


def test_a_refusal_is_shown_and_the_log_as_well(place: Place) -> None:
    place.start("launch", _drive(place), "--no-progress")
    dashboard = Dashboard(place)
    place.run("wait", "drive")
    with place.session() as session:
        session.put("fmu_mesh/drive/gain/set/u", "1.0")  # without an answer: only the log says why it is refused

    with browser(place.folder) as page:
        _open(page, dashboard.url)
        wait_until(lambda: "only unconnected inputs can be set" in page.text, "the line of the log")
    place.run("stop", "drive")


def test_the_page_of_64_instances_shows_all_of_them(place: Place) -> None:
    instances: dict[str, dict[str, Any]] = {"pendulum": {"fmu": "DampedPendulum"}}
    instances |= {f"gain{n}": {"fmu": "Gain", "group": f"group{n % 4}"} for n in range(63)}
    config = write_config(
        place.folder,
        name="many",
        instances=instances,
        connections=[f"pendulum.a -> gain{n}.u" for n in range(63)],
        stop_time=3600.0,
        simulation={"real_time_factor": 0.2, "step_size": 0.01},
    )
    place.start("launch", config, "--no-progress")
    dashboard = Dashboard(place)

    with browser(place.folder) as page:
        _open(page, dashboard.url)

        wait_until(lambda: len(page.instances) == 64, "the graph")
        wait_until(lambda: "gain3" in page.text, "the table")
        wait_until(lambda: page.curve("gain0.y"), "a curve")
        assert page.problems() == []
    place.run("stop", "many")


def test_a_browser_that_sleeps_slows_nothing_and_costs_no_memory(place: Place) -> None:
    place.start("launch", write_config(place.folder, stop_time=3600.0, simulation=PACED), "--no-progress")
    dashboard = Dashboard(place)

    with browser(place.folder) as page:
        _open(page, dashboard.url)
        wait_until(lambda: page.pictures > 10, "pictures")
        asleep = page.processes
        for process in asleep:
            process.suspend()
        try:
            before, memory = _status(place, "pair")["point"], dashboard.memory_mib
            wait_until(lambda: _status(place, "pair")["point"] > before + 7500, "15 s of simulation")
            grown = dashboard.memory_mib - memory
        finally:
            for process in reversed(asleep):
                process.resume()

        assert grown < 20.0
        assert _status(place, "pair")["state"] == "running"
        wait_until(lambda: _is_drawing(page), "pictures after it wakes")
    place.run("stop", "pair")


def _is_drawing(page: Browser) -> bool:
    """Whether the page, which may load itself again meanwhile, draws new values."""
    before = page.pictures
    return page.state == "running" and wait_until(lambda: page.pictures != before, "another picture") and True


def test_the_result_is_the_same_bytes_with_an_open_page(place: Place) -> None:
    config = write_config(place.folder, stop_time=8.0, simulation=PACED)
    dashboard = Dashboard(place)

    with browser(place.folder) as page:
        page.driver.get(dashboard.url)
        watched = place.start("launch", config, "--no-progress")
        wait_until(lambda: page.state == "running", "the mesh on the page")
        wait_until(lambda: page.pictures > 5, "pictures")
        assert watched.wait() == 0
        wait_until(lambda: page.state in ("ended", "done"), "the end on the page")
        last = wait_until(
            lambda: points if (points := page.curve("delay.y")) and points[-1][0] == 8.0 else None, "the last point"
        )
    alone = place.run("launch", config, "--no-progress", "--local", "--output", "alone.csv")

    assert alone.wait() == 0
    assert (place.folder / "pair.csv").read_bytes() == (place.folder / "alone.csv").read_bytes()
    assert last[-1][0] == 8.0
    dashboard.process.signal(signal.SIGINT)
    assert dashboard.process.wait() == 130
    assert not [p for p in place.processes() if p.status() != psutil.STATUS_ZOMBIE]
