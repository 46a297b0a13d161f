"""Pictures of a world: a film that is rendered off screen, and a window where there is a screen.

Owns OpenGL and film files. Rendering never changes a value: the main thread of the node renders at points, so a film
only takes time.
"""

from __future__ import annotations

import copy
import ctypes.util
import logging
import math
import os
import time
from abc import ABC, abstractmethod
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from ... import files
from ...errors import ConfigurationError, LoadFailed
from ...installing import require
from .mujoco_world import engine

__all__ = ["Film", "Picture", "Window", "check_film", "check_window", "choose_backend"]

log = logging.getLogger(__name__)

WIDTH: Final = 640
HEIGHT: Final = 480
FILM_RATES: Final = {".mp4": 30, ".gif": 20}
"""Pictures per second of simulation time, by the film's suffix."""
WINDOW_RATE: Final = 60.0
"""Pictures per second of wall-clock time."""

_BACKENDS = (("egl", "EGL"), ("osmesa", "OSMesa"))


class Picture(ABC):
    """Shows a world. Call sequence: `show` at points, `finish` after the last one, `close` at the end of every run."""

    @abstractmethod
    def show(self, model: Any, data: Any, time_s: float) -> None:  # noqa: ANN401  mujoco has no types
        """Show the world as it is at ``time_s``; may do nothing."""

    def finish(self) -> None:  # noqa: B027 a window stays until the run has ended
        """Complete the film: `show` is not called again; `LoadFailed` if it cannot be written."""

    @abstractmethod
    def close(self) -> None:
        """Release everything, also after a run that ended early. Never raises; may be called twice."""


def check_film(path: Path) -> None:
    """See whether a film can be made, before a run; `ConfigurationError` says what is missing."""
    if path.suffix not in FILM_RATES:
        raise ConfigurationError(f"`video={str(path)!r}`: a film is one of {', '.join(FILM_RATES)}")
    if files.is_folder(path):
        raise ConfigurationError(f"`video={str(path)!r}`: a folder, not a file")
    require("imageio")
    choose_backend()


def check_window() -> None:
    """See whether there is a screen for a window, before a run; `ConfigurationError` if not."""
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ConfigurationError("`view=True` needs a screen, and there is none.", hint="`video=...` needs none.")


class Film(Picture):
    """A film file.

    A film is unreadable until it is complete. Until then, its file is `<name>.unfinished.mp4` in the same folder. A run
    that ends before the first step writes no film, and does not touch an older one.
    """

    def __init__(self, path: Path, instance: str) -> None:
        self._path = path
        self._file = Path(os.path.realpath(path))
        self._draft = self._file.with_name(f"{path.stem}.unfinished{path.suffix}")
        self._instance = instance
        self._rate = FILM_RATES[path.suffix]
        self._first: float | None = None
        self._pictures = 0
        self._has_moved = False
        self._renderer: Any = None
        self._writer: Any = None
        choose_backend()

    def show(self, model: Any, data: Any, time_s: float) -> None:  # noqa: ANN401  mujoco has no types
        """Add as many pictures as the time since the last one asks for."""
        if self._first is None:
            self._first = time_s
        self._has_moved = time_s > self._first
        # The time of a point may differ from that of its picture by rounding.
        due = math.floor((time_s - self._first) * self._rate * (1.0 + 1e-12)) + 1
        if due <= self._pictures:
            return
        try:
            if self._renderer is None:
                self._start(model)
            self._renderer.update_scene(data, camera=0 if model.ncam else -1)
            # Without a graphics card, shadows take five times as long as everything else.
            self._renderer.scene.flags[engine().mjtRndFlag.mjRND_SHADOW] = 0
            picture = self._renderer.render()
            for _ in range(due - self._pictures):
                self._writer.append_data(picture)
        except Exception as error:
            raise self._failed(error) from error
        self._pictures = due

    def finish(self) -> None:
        """Complete the file and give it its name."""
        self._end(keep=True)

    def close(self) -> None:
        """Complete the file as far as it goes."""
        try:
            self._end(keep=self._has_moved)
        except LoadFailed as error:
            log.warning("film_not_written", extra={"error": str(error)})

    def _end(self, *, keep: bool) -> None:
        writer, self._writer = self._writer, None
        renderer, self._renderer = self._renderer, None
        if renderer is not None:
            renderer.close()
        if writer is None:
            return
        try:
            writer.close()
            if keep:
                self._draft.replace(self._file)
        except Exception as error:
            raise self._failed(error) from error
        finally:
            self._draft.unlink(missing_ok=True)

    def _start(self, model: Any) -> None:  # noqa: ANN401  mujoco has no types
        import imageio.v2 as imageio  # noqa: PLC0415  an extra, and slow to import

        self._file.parent.mkdir(parents=True, exist_ok=True)
        self._renderer = engine().Renderer(model, HEIGHT, WIDTH)
        if self._path.suffix == ".gif":
            self._writer = imageio.get_writer(self._draft, duration=1000 / self._rate, loop=0)
        else:
            self._writer = imageio.get_writer(self._draft, fps=self._rate, codec="libx264")

    def _failed(self, error: Exception) -> LoadFailed:
        reason = " ".join(str(error).split())
        return LoadFailed(f"the film '{self._path}' cannot be made: {reason}", instance=self._instance)


class Window(Picture):
    """A window of MuJoCo's own viewer; when a person closes it, the run goes on.

    It shows a copy of the world, so that what a person does in the window does not change the run.
    """

    def __init__(self) -> None:
        self._viewer: Any = None
        self._model: Any = None
        self._data: Any = None
        self._last = 0.0

    def show(self, model: Any, data: Any, time_s: float) -> None:  # noqa: ANN401  mujoco has no types
        """Bring the window up to date, if its last picture is old enough."""
        now = time.monotonic()
        if now - self._last < 1.0 / WINDOW_RATE:
            return
        self._last = now
        if self._viewer is None:
            import mujoco.viewer  # noqa: PLC0415  an extra, and it needs a screen

            self._model = copy.copy(model)
            self._data = mujoco.MjData(self._model)
            self._viewer = mujoco.viewer.launch_passive(
                self._model, self._data, show_left_ui=False, show_right_ui=False
            )
            if model.ncam:
                self._viewer.cam.type, self._viewer.cam.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
        if self._viewer.is_running():
            engine().mj_copyData(self._data, model, data)
            self._viewer.sync()

    def close(self) -> None:
        """Close the window."""
        if self._viewer is not None:
            with suppress(Exception):
                self._viewer.close()


def choose_backend() -> str:
    """Let MuJoCo render without a screen, unless the user has chosen a backend; before `mujoco` is imported."""
    if chosen := os.environ.get("MUJOCO_GL"):
        return chosen
    for backend, library in _BACKENDS:
        if ctypes.util.find_library(library) is not None:
            os.environ["MUJOCO_GL"] = os.environ["PYOPENGL_PLATFORM"] = backend
            return backend
    hint = "Install one of them, for example with `apt install libegl1` or `apt install libosmesa6`."
    raise ConfigurationError("films need OpenGL without a screen: neither EGL nor OSMesa is installed.", hint=hint)
