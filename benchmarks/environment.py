"""The environment of the peers: made once under `build/`, one package at a time, so that one failure stays alone."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

__all__ = ["ROOT", "Peers", "loads", "machine"]

ROOT = Path(__file__).resolve().parents[1]
_VENV = ROOT / "build" / "bench-venv"
_PYTHON = _VENV / "bin" / "python"
_INSTALL_S = 300
# What we have in common with a peer is the same release for both.
_SAME = ("fmpy", "eclipse-zenoh", "numpy")
_OTHERS = ("pyzmq", "helics", "ecospy", "tbb", "mosaik")
_LIST = (
    "import importlib.metadata as m, json; print(json.dumps({d.name.lower(): d.version for d in m.distributions()}))"
)


class Peers:
    """The environment of the peers.

    Args:
        python: its interpreter.

    Attributes:
        python: its interpreter.
        failures: why a package is not there, by package.
    """

    def __init__(self, python: Path = _PYTHON) -> None:
        self.python = python
        self.failures: dict[str, str] = {}

    def prepare(self) -> None:
        """Create the environment if needed and install what is missing."""
        if not _PYTHON.exists():
            print(f"creating {_VENV.relative_to(ROOT)} ...", flush=True)
            subprocess.run([sys.executable, "-m", "venv", str(_VENV)], check=True)
        have = self._installed()
        wanted = {package: f"{package}=={version(package)}" for package in _SAME}
        wanted |= {package: package for package in _OTHERS}
        for package, requirement in wanted.items():
            found = have.get(package)
            if found is not None and requirement in (package, f"{package}=={found}"):
                continue
            print(f"installing {requirement} for the peers ...", flush=True)
            self._install(package, requirement)

    def missing(self, packages: tuple[str, ...]) -> str | None:
        """Why not all of these packages are there; None if they are."""
        return next((f"{name}: {self.failures[name]}" for name in packages if name in self.failures), None)

    def variables(self) -> dict[str, str]:
        """Environment variables of a contestant: ecos finds the libraries of `tbb` in no other way."""
        return {**os.environ, "LD_LIBRARY_PATH": str(_VENV / "lib"), "PYTHONWARNINGS": "ignore"}

    def _installed(self) -> dict[str, str]:
        listed = subprocess.run([str(_PYTHON), "-c", _LIST], check=True, capture_output=True, text=True).stdout
        packages: dict[str, str] = json.loads(listed)
        return packages

    def _install(self, package: str, requirement: str) -> None:
        command = [str(_PYTHON), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", requirement]
        try:
            done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=_INSTALL_S)
        except subprocess.TimeoutExpired:
            self.failures[package] = f"not installed within {_INSTALL_S} s"
            return
        if done.returncode:
            lines = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
            self.failures[package] = f"not installable ({lines[-1][7:120] if lines else 'pip failed'})"


def machine() -> str:
    """The machine in a few words."""
    return f"{os.cpu_count()} cores, {platform.system()} {platform.machine()}, Python {platform.python_version()}"


def loads() -> str:
    """The load averages of 1, 5 and 15 minutes."""
    return " ".join(f"{load:.2f}" for load in os.getloadavg())
