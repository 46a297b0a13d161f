"""What cannot run in a sandbox of WebAssembly is refused before the run, with the way out."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

import pytest

import fmu_mesh
from tests.fmus.event_fmus import event_source_fmu
from tests.fmus.packing import repacked
from tests.wasm.guests import SANDBOX, meshed, rogue


def refusal(mesh: fmu_mesh.Mesh) -> str:
    with pytest.raises(fmu_mesh.ConfigurationError) as caught:
        mesh.plan()
    return str(caught.value)


def test_an_fmu_of_fmi_1_is_refused(tmp_path: Path) -> None:
    fmu = event_source_fmu("Ball", 1, tmp_path / "ball.fmu")

    assert "is an FMU of FMI 1.0, and `sandbox: wasm` is for those of FMI 2.0 and 3.0" in refusal(meshed(fmu))


def test_an_fmu_without_sources_is_refused(tmp_path: Path) -> None:
    fmu = repacked(tmp_path / "binary.fmu", keep=lambda name: not name.startswith("sources/"))

    assert "has neither sources nor a component, and `sandbox: wasm` needs one of them" in refusal(meshed(fmu))


def test_a_component_for_another_version_of_fmi_is_refused(tmp_path: Path) -> None:
    fmu = repacked(
        tmp_path / "component.fmu",
        keep=lambda name: name == "modelDescription.xml",
        add={"binaries/wasm32-wasip2/Gain.wasm": b"\0asm\x0d\0\1\0"},
    )

    assert "has no binary for this platform (linux64); it has: wasm32-wasip2" in refusal(meshed(fmu, None))
    assert "has neither sources nor a component, and `sandbox: wasm` needs one" in refusal(meshed(fmu))


def test_a_component_in_python_is_refused(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(
        "import fmu_mesh\n\n\nclass Own(fmu_mesh.Component):\n    y = fmu_mesh.Output()\n\n"
        "    def step(self, time, step_size):\n        self.y = time\n",
        encoding="utf-8",
    )
    mesh = fmu_mesh.Mesh("guest", step_size=0.1, stop_time=1.0)
    mesh.add("own", python=f"{tmp_path}/own.py:Own", process=SANDBOX)

    assert "wasm for 'own', which is no FMU" in refusal(mesh)


def test_another_wasmtime_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metadata, "version", lambda _library: "49.0")

    text = refusal(meshed(rogue(tmp_path)))

    assert "FMUs in WebAssembly need the library" in text
    assert "and 49.0 is installed" in text


def test_sources_that_need_another_system_say_what(tmp_path: Path) -> None:
    fmu = repacked(
        tmp_path / "windows.fmu",
        keep=lambda name: name != "sources/Gain.c",
        add={"sources/Gain.c": b"#include <windows.h>\n"},
    )

    assert "Gain.c:1:10: fatal error: 'windows.h' file not found" in refusal(meshed(fmu))
