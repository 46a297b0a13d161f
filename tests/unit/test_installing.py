"""What installs a missing library, by the way in which this package was installed."""

import importlib.util
import sys
from pathlib import Path

import pytest

from fmu_mesh.errors import ConfigurationError, LibraryMissing, LoadFailed
from fmu_mesh.installing import importing, installed_from, require

ROOT = Path(__file__).parents[2]


def hint_for(library: str) -> str:
    with pytest.raises(LibraryMissing) as caught, importing(library, "films"):
        raise ImportError
    return str(caught.value)


@pytest.fixture
def interpreter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An interpreter of another folder runs us."""
    python = tmp_path / "my tools" / "bin" / "python"
    monkeypatch.setattr(sys, "executable", str(python))
    monkeypatch.setattr(sys, "prefix", str(python.parents[1]))
    python.parent.mkdir(parents=True)
    return python


def without_pip(monkeypatch: pytest.MonkeyPatch) -> None:
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "pip" else find_spec(name))


def test_pip_of_this_interpreter_installs_a_library_in_versions_that_work(interpreter: Path) -> None:
    assert (
        hint_for("imageio")
        == f"films need the library imageio. Install it with `'{interpreter}' -m pip install 'imageio[ffmpeg]>=2.34'`."
    )


def test_uv_installs_it_where_there_is_no_pip(interpreter: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    without_pip(monkeypatch)

    assert f"`uv pip install --python '{interpreter}' 'pyarrow>=17'`" in hint_for("pyarrow")


def test_pipx_injects_it(interpreter: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    without_pip(monkeypatch)
    (interpreter.parents[1] / "pipx_metadata.json").touch()

    assert "`pipx inject 'my tools' 'pandas>=2'`" in hint_for("pandas")


def test_a_library_of_another_package_is_named_as_it_is() -> None:
    assert "install lxm`" in hint_for("lxm")  # and not the versions of lxml


def test_a_missing_library_is_a_configuration_error_of_a_model_too() -> None:
    with pytest.raises(LibraryMissing) as caught:
        require("no_such_module")

    assert isinstance(caught.value, ConfigurationError)
    assert isinstance(caught.value, LoadFailed)
    assert caught.value.exit_code == 2


def test_an_editable_installation_knows_its_clone() -> None:
    assert installed_from() == str(ROOT)
