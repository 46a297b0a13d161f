"""A dashboard as a process, and a browser for it. Tests of the page share it."""

from __future__ import annotations

import http.client
import json
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import psutil
import pytest
from PIL import Image
from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By
from selenium.webdriver.remote.webdriver import WebDriver

from tests.helpers import Launched, Place, wait_until

__all__ = ["NO_CHROMIUM", "Browser", "Dashboard", "browser", "needs_chromium"]

_PROGRAMS = {name: shutil.which(name) for name in ("chromium", "chromedriver")}
NO_CHROMIUM = next(
    (f"there is no {name}: apt install chromium chromium-driver" for name, path in _PROGRAMS.items() if path is None),
    None,
)
needs_chromium = pytest.mark.skipif(NO_CHROMIUM is not None, reason=str(NO_CHROMIUM))


class Dashboard:
    """A dashboard that serves its page; use it as any HTTP client would.

    Attributes:
        process: the command.
        url: what it printed, with the token.
        port: of the page.
        cookie: that of a browser that has opened the URL.
    """

    def __init__(self, place: Place, *arguments: str) -> None:
        self.process: Launched = place.start("dashboard", "--no-browser", *arguments)
        line = wait_until(lambda: re.search(r"dashboard: (http://\S+)\n", self.process.output), "the address")
        self.url = line[1]
        parts = urlsplit(self.url)
        assert parts.port is not None
        self.port, self._host = parts.port, str(parts.hostname)
        self.cookie = ""
        status, headers, _ = self.ask(f"/?{parts.query}")
        assert status == 303
        self.cookie = headers["set-cookie"].partition(";")[0]

    def ask(
        self, path: str = "/", body: bytes | None = None, headers: Mapping[str, str] | None = None
    ) -> tuple[int, Mapping[str, str], bytes]:
        """Status, headers and body of an answer."""
        connection = http.client.HTTPConnection(self._host, self.port, timeout=30.0)
        try:
            sent = {"Cookie": self.cookie} if self.cookie else {}
            connection.request("GET" if body is None else "POST", path, body, sent | dict(headers or {}))
            answer = connection.getresponse()
            return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
        finally:
            connection.close()

    def curves(self, mesh: str, run: int = 1, **versions: int) -> dict[str, Any]:
        """What has changed in curves since these versions; the name of a variable has `__` for its dot."""
        curves = {name.replace("__", "."): version for name, version in versions.items()}
        status, _, data = self.ask(
            "/dashboard/curves", json.dumps({"mesh": mesh, "run": run, "curves": curves}).encode()
        )
        assert status == 200
        answer: dict[str, Any] = json.loads(data)
        return answer

    @property
    def memory_mib(self) -> float:
        """The memory of its process."""
        return float(psutil.Process(self.process.pid).memory_info().rss / 2**20)


class Browser:
    """Chromium without a window.

    Attributes:
        driver: that of selenium.
    """

    def __init__(self, driver: WebDriver, pid: int) -> None:
        self.driver = driver
        self._pid = pid

    @property
    def processes(self) -> list[psutil.Process]:
        """The processes of the browser."""
        return psutil.Process(self._pid).children(recursive=True)

    def run(self, script: str, *arguments: object) -> Any:  # noqa: ANN401  what the script returns
        """Run JavaScript in the page."""
        return self.driver.execute_script(script, *arguments)

    @property
    def text(self) -> str:
        """What the page says."""
        return str(self.run("return document.body.innerText"))

    @property
    def state(self) -> str:
        """The state of the mesh that is shown."""
        return str(self.run("return document.querySelector('.fm-state')?.innerText ?? ''"))

    @property
    def pictures(self) -> int:
        """How many pictures of plots were drawn."""
        return int(self.run("return window.fmuMeshPlots?.pictures ?? 0"))

    @property
    def instances(self) -> list[str]:
        """The instances in the picture of the mesh, which is replaced again and again."""
        script = "return [...document.querySelectorAll('.fm-graph [data-instance]')].map((e) => e.dataset.instance)"
        return [str(name) for name in self.run(script)]

    def curve(self, name: str) -> list[list[float]]:
        """The points of a curve that the page has."""
        script = "return fmuMeshPlots.curves.get(arguments[0])?.points ?? []"
        return [[float(x) for x in point] for point in self.run(script, name)]

    def line(self, number: int) -> list[list[float | None]]:
        """What the first curve of a plot is drawn of; a value of None ends a line."""
        script = """const plot = document.querySelectorAll('.fm-plot')[arguments[0]];
            const chart = plot && getElement(Number(plot.id.slice(1)))?.chart;
            return chart?.getOption().series[0]?.data.map((point) => point.value ?? point) ?? []"""
        return [list(point) for point in self.run(script, number)]

    def show_as(self, theme: str, width: int, height: int) -> None:
        """Show the page as to a person who wants a dark or a light theme, in a window of this size."""
        wanted = {"features": [{"name": "prefers-color-scheme", "value": theme}]}
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", wanted)
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)

    def picture(self, selector: str) -> Image.Image:
        """A picture of the first such element."""
        return Image.open(BytesIO(self.driver.find_element(By.CSS_SELECTOR, selector).screenshot_as_png))

    def spoken(self) -> list[tuple[str, str]]:
        """The role and the name of all that a screen reader tells of."""
        nodes = self.driver.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]
        return [
            (node["role"]["value"], node.get("name", {}).get("value", "")) for node in nodes if not node.get("ignored")
        ]

    def click(self, label: str) -> None:
        """Click the button with this text, as soon as it is there."""

        def clicked() -> bool:
            for button in self.driver.find_elements(By.TAG_NAME, "button"):
                with suppress(Exception):  # it is just replaced by another one
                    if label.lower() in button.text.lower() and button.is_displayed():
                        button.click()
                        return True
            return False

        wait_until(clicked, f"the button '{label}'")

    def problems(self) -> list[str]:
        """What the page has reported in the console."""
        return [str(entry["message"]) for entry in self.driver.get_log("browser")]  # type: ignore[attr-defined]  # of Chromium

    def hosts(self) -> set[str]:
        """All hosts that were asked for anything since the last call."""
        found = set()
        for entry in self.driver.get_log("performance"):  # type: ignore[attr-defined]  # of Chromium
            message = json.loads(entry["message"])["message"]
            parameters = message.get("params", {})
            url = parameters.get("request", {}).get("url") or parameters.get("url") or ""
            if message["method"].startswith("Network.") and urlsplit(url).scheme in ("http", "https", "ws", "wss"):
                found.add(str(urlsplit(url).hostname))
        return found


@contextmanager
def browser(folder: Path, width: int = 1500, height: int = 1150) -> Iterator[Browser]:
    """A browser with a new profile in a folder, which can reach this host only."""
    options = webdriver.ChromeOptions()
    options.binary_location = str(_PROGRAMS["chromium"])
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-dev-shm-usage",
        "--disable-background-networking",
        "--disable-component-update",
        "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",
        f"--user-data-dir={folder / 'chromium'}",
        f"--window-size={width},{height}",
    ):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"performance": "ALL", "browser": "ALL"})
    service = Service(str(_PROGRAMS["chromedriver"]))
    driver = webdriver.Chrome(options=options, service=service)
    try:
        yield Browser(driver, int(service.process.pid))
    finally:
        driver.quit()
