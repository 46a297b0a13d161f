"""A program for `test_sanitized_copies.py`: steps copies on one thread and on three, and compares every float.

Arguments: the path of an FMU with equations, which dopri5 solves in the library.
"""

from __future__ import annotations

import os
import random
import sys
from pathlib import Path

import numpy as np

import fmu_mesh

COPIES = 11
ROUNDS = 40 * int(os.environ.get("FMU_MESH_BURST_SECONDS", "1"))
FMUS = Path(__file__).resolve().parents[2] / "fmus"
READ = ["cart.theta", "sum.y", "oscillator.x"]


def mesh_with(equations: str) -> fmu_mesh.Mesh:
    """A cart pole that drives equations and a sum; a sanitizer wants its own functions before those of an FMU."""
    mesh = fmu_mesh.Mesh("copies", step_size=0.01, stop_time=None)
    mesh.add("cart", fmu=FMUS / "CartPole.fmu", deep_binding=False)
    mesh.add("sum", fmu=FMUS / "Integrator.fmu", deep_binding=False, step_size=0.02)
    mesh.add("oscillator", fmu=equations, kind="model_exchange", deep_binding=False, solver={"name": "dopri5"})
    mesh.connect("cart.theta", "oscillator.u")
    mesh.connect("oscillator.x", "sum.u")
    return mesh


def floats(mesh: fmu_mesh.Mesh, threads: int) -> list[str]:
    """All values of a random, but always the same, use of a batch."""
    chance, found = random.Random(41), []  # noqa: S311  the same numbers each time
    with mesh.batch(COPIES, threads=threads) as batch:
        state = batch.save()
        for _ in range(ROUNDS):
            mask = np.array([chance.random() < 0.5 for _ in range(COPIES)])
            batch.set("cart.force", [chance.uniform(-1.0, 1.0) for _ in range(COPIES)])
            batch.step(chance.choice([1, 2, 7]))
            match chance.randrange(4):
                case 0:
                    batch.reset(mask)
                case 1:
                    batch.restore(state, mask)
                case 2:
                    state = batch.save()
            found += [value.hex() for value in batch.get(READ).ravel().tolist()]
        batch.reset(start_values={"cart.theta": 0.1})
        return found + [value.hex() for value in batch.get(READ).ravel().tolist()]


if __name__ == "__main__":
    mesh = mesh_with(sys.argv[1])
    alone, together = floats(mesh, 1), floats(mesh, 3)
    different = sum(a != b for a, b in zip(alone, together, strict=True))
    sys.stdout.write(f"{len(alone)} floats, {different} differ\n")
