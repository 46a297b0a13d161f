"""Films of a world: what is in them, and what is said where none can be made.

A test that renders is skipped where there is no OpenGL, with the reason that MuJoCo gives.
"""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from numpy.typing import NDArray

from fmu_mesh.cli.main import main
from fmu_mesh.errors import ConfigurationError
from fmu_mesh.instances.mujoco.rendering import HEIGHT, WIDTH, check_film, check_window
from tests.helpers import Place

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs"

RENDER = """\
import sys
from pathlib import Path
from fmu_mesh.instances.mujoco.rendering import check_film
check_film(Path("x.mp4"))
import mujoco
mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 16, 16).close()
"""

FILM = """\
import sys
from pathlib import Path
from fmu_mesh.instances.mujoco.rendering import Film
path = Path(sys.argv[1])
older = path.read_bytes() if path.exists() else None
def look():
    print(sorted(p.name for p in path.parent.iterdir()))
def film():
    film = Film(path, "world")
    film.show(model, data, 0.0)
    return film
Film(path, "chooses how to render")
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco/>")
data = mujoco.MjData(model)
film().close()
look()
assert older is None or path.read_bytes() == older
ended_early = film()
ended_early.show(model, data, 0.1)
assert older is None or path.read_bytes() == older
ended_early.close()
look()
"""


@functools.cache
def why_no_films() -> str | None:
    """Why nothing can be rendered here, or None if it can."""
    done = subprocess.run([sys.executable, "-c", RENDER], capture_output=True, text=True, timeout=60, check=False)
    return None if done.returncode == 0 else (done.stderr.strip().splitlines() or ["no reason"])[-1]


@pytest.fixture
def renderer() -> None:
    if (reason := why_no_films()) is not None:
        pytest.skip(f"nothing can be rendered here: {reason}")


def pictures_of(film: Path) -> NDArray[np.uint8]:
    """All pictures of a film as (number, row, column, colour)."""
    decode = ["-i", str(film), "-fps_mode", "passthrough", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), *decode], capture_output=True, check=True, timeout=60)
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, HEIGHT, WIDTH, 3)


@pytest.mark.usefixtures("renderer")
@pytest.mark.parametrize(
    ("suffix", "how", "count"), [(".mp4", ("--local",), 7), (".gif", (), 5)], ids=["mp4, local", "gif, distributed"]
)
def test_a_film_shows_the_world_from_the_first_point_to_the_last(
    place: Place, suffix: str, how: tuple[str, ...], count: int
) -> None:
    text = (CONFIGS / "damped_pendulum.yaml").read_text(encoding="utf-8")
    for old, new in (
        ("stop_time: 10.0", "stop_time: 0.2"),
        ("../fmus", f"{ROOT}/fmus"),
        ("worlds", f"{CONFIGS}/worlds"),
    ):
        text = text.replace(old, new)
    config, film = place.folder / "config.yaml", place.folder / f"film{suffix}"
    config.write_text(text, encoding="utf-8")
    results = [place.folder / "with.csv", place.folder / "without.csv"]

    shown = place.run("launch", config, "--no-progress", *how, "--video", film, "--output", results[0])
    plain = place.run("launch", config, "--no-progress", "--local", "--output", results[1])

    assert (shown.wait(), plain.wait()) == (0, 0), shown.errors
    assert f"video: {film}" in shown.output
    pictures = pictures_of(film)
    assert len(pictures) == count  # 0.2 s at 30 or 20 pictures a second, and the first
    assert pictures[0].std() > 10.0  # something is to be seen
    changed = np.abs(pictures[0].astype(int) - pictures[-1].astype(int)).max(axis=2) > 40
    assert 100 < changed.sum() < changed.size / 10  # and it moves
    assert results[0].read_bytes() == results[1].read_bytes()
    place.assert_nothing_left(5.0)


@pytest.mark.usefixtures("renderer")
@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
@pytest.mark.parametrize("older", [b"an older film", None], ids=["older film", "no film"])
def test_a_film_gets_its_name_at_its_end_if_the_world_moved(tmp_path: Path, suffix: str, older: bytes | None) -> None:
    film = tmp_path / f"film{suffix}"
    if older is not None:
        film.write_bytes(older)
    names = [film.name] if older is not None else []

    done = subprocess.run([sys.executable, "-c", FILM, film], capture_output=True, text=True, timeout=60, check=False)

    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [f"{names}", f"{[film.name]}"]
    assert len(pictures_of(film)) > 0


@pytest.mark.usefixtures("renderer")
@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_film_that_cannot_be_written_ends_the_run_with_the_reason(place: Place, suffix: str) -> None:
    (place.folder / "file").touch()
    film = place.folder / "file" / f"film{suffix}"

    options = ("--local", "--no-progress", "--output", place.folder / "result.csv", "--video", film)

    launched = place.run("launch", CONFIGS / "fluid_body.yaml", *options)

    assert launched.wait() == 3
    assert f"the film '{film}' cannot be made: " in launched.message


def test_a_film_of_an_unknown_format_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"film.avi'`: a film is one of \.mp4, \.gif"):
        check_film(Path("film.avi"))


def test_a_folder_is_no_film(tmp_path: Path) -> None:
    (tmp_path / "film.mp4").mkdir()

    with pytest.raises(ConfigurationError, match="a folder, not a file"):
        check_film(tmp_path / "film.mp4")


def test_a_mesh_without_a_world_has_no_film(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = CONFIGS / "pendulum_delay.yaml"

    assert main(["launch", str(config), "--local", "--video", str(tmp_path / "film.gif")]) == 2

    assert "`--video` shows the one physics engine of a mesh, and this one has none" in capsys.readouterr().err


def test_a_window_without_a_screen_is_refused_with_the_way_out(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)

    with pytest.raises(ConfigurationError, match=r"`view=True` needs a screen.*`video=\.\.\.`"):
        check_window()


def test_without_any_opengl_a_film_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr("ctypes.util.find_library", lambda _name: None)

    with pytest.raises(ConfigurationError, match="neither EGL nor OSMesa"):
        check_film(Path("film.mp4"))
    assert "MUJOCO_GL" not in os.environ
