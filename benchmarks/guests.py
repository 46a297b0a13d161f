"""`python -m benchmarks.guests`: what a sandbox of WebAssembly costs: the example FMUs, natively and as guests.

Each is the only copy of a batch, whose steps C takes, in interleaved rounds, and the fastest round counts. Models that
are a few operations show the time of the calls. Short rounds (`--points 2000 --rounds 150`) are for a busy machine.
"""

from __future__ import annotations

import argparse
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import fmu_mesh

_FMUS = Path(__file__).resolve().parents[1] / "fmus"


def main() -> int:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.guests", description="guests of WebAssembly")
    parser.add_argument("names", nargs="*", default=sorted(one.stem for one in _FMUS.glob("*.fmu")), metavar="NAME")
    parser.add_argument("--points", type=int, default=20_000, help="of a round (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=7, help="default: %(default)s")
    options = parser.parse_args()
    print(f"{'FMU':28}{'native':>12}{'guest':>12}   ns a step")
    for name in options.names:
        native, guest = _measured(name, options.points, options.rounds)
        print(f"{name:28}{native:12.0f}{guest:12.0f}   {guest / native:.2f}", flush=True)
    return 0


def _measured(name: str, points: int, rounds: int) -> tuple[float, float]:
    """The time of a step in ns, natively and as a guest."""
    best = [float("inf"), float("inf")]
    with ExitStack() as stack:
        systems = []
        for sandbox in ("none", "wasm"):
            mesh = fmu_mesh.Mesh(name, step_size=0.001, stop_time=0.001 * points * (rounds + 1))
            mesh.add("one", fmu=str(_FMUS / f"{name}.fmu"), process={"sandbox": sandbox})
            systems.append(stack.enter_context(mesh.batch(1)))
        for _ in range(rounds):
            for which, system in enumerate(systems):
                began = time.perf_counter_ns()
                system.step(points)
                best[which] = min(best[which], (time.perf_counter_ns() - began) / points)
    return best[0], best[1]


if __name__ == "__main__":
    sys.exit(main())
