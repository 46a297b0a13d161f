"""FMUs for a sandbox of WebAssembly: those of others with their sources, and one that does what a bad FMU does."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import fmu_mesh
from tests.fmus.helpers import FMUS
from tests.fmus.packing import repacked

__all__ = ["FAULTS", "SANDBOX", "meshed", "rogue"]

SANDBOX: dict[str, Any] = {"sandbox": "wasm"}

FAULTS = {
    "endless": "for (volatile double x = 0.0;; x += 1.0) {}",
    "wild": "*(volatile double *)0xfffffff0u = 1.0;",
    "memory": "for (int i = 0; i < 10240; ++i) memset(kept = malloc(1 << 20), i + 1, 1 << 20);",
    "deep": "return deeper(1 << 30);",
    "abort": "abort();",
    "exit": "exit(7);",
    "divide": "s->y = 7 / zero;",
    "file": 's->y = fopen("/etc/passwd", "r") != NULL || fopen("relative", "w") != NULL || getenv("PATH") != NULL;',
    "printed": 'printf("%f\\n", time); s->y = printf("x");',
    "slept": "sleep(3600); s->y = 1.0;",
    "pointer": "kept = (void *)calculate; s->y = ((double (*)(double, int))kept)(1.0, 2);",
}
"""What the model does in each step from 0.5 s on, by the number of the fault in `k`."""

_STEP = """
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
static void *volatile kept;
static volatile int zero;
static int deeper(int n) { volatile char room[4096]; room[n % 4096] = 1; return n ? deeper(n - 1) + room[1] : 0; }
static fmi2Status step(Instance *instance, ModelState *s, double time, double step_size)
{
    (void)instance;
    (void)step_size;
    calculate(s);
    if (time < 0.5) return fmi2OK;
    switch ((int)s->k) {
    CASES
    }
    return fmi2OK;
}
"""


def rogue(folder: Path) -> Path:
    """The FMU Gain with other sources: see `FAULTS`."""
    cases = "\n    ".join(f"case {number}: {{ {code} break; }}" for number, code in enumerate(FAULTS.values(), 10))
    with zipfile.ZipFile(FMUS / "Gain.fmu") as archive:
        text = archive.read("sources/Gain.c").decode()
    first, last = text.index("static fmi2Status step("), text.index("static const Variable")
    changed = text[:first] + _STEP.replace("CASES", cases) + text[last:]
    return repacked(
        folder / "Rogue.fmu",
        keep=lambda name: not name.startswith("binaries/") and name != "sources/Gain.c",
        add={"sources/Gain.c": changed.encode()},
    )


def meshed(fmu: Path | str, process: dict[str, Any] | None = SANDBOX, **keys: Any) -> fmu_mesh.Mesh:  # noqa: ANN401 those of an instance
    """A mesh of one instance, with steps of 0.1 s for 1 s."""
    mesh = fmu_mesh.Mesh("guest", step_size=0.1, stop_time=1.0)
    own: dict[str, Any] = keys | ({"process": process} if process else {})
    mesh.add("one", fmu=str(fmu), **own)
    return mesh
