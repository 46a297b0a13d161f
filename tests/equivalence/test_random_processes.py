"""Some random systems of real FMUs in real processes; many more run simulated, in `tests/property`."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import msgspec
import pytest
import yaml

from tests.equivalence.reference import as_bits, read_csv, reference_of, run_fmpy
from tests.helpers import FMUS, Place
from tests.planning import prepare

STEP_SIZE = 0.0078125
RELAXATION = 0.75
"""Below 1, loops at the start are iterated as the reference does it, and not accelerated."""
MODELS: dict[str, tuple[tuple[str, ...], str, dict[str, tuple[float, float]]]] = {
    "DampedPendulum": ((), "a", {"a": (-1.5, 1.5), "d": (0.0, 0.5)}),
    "Gain": (("u",), "y", {"k": (-0.9, 0.9)}),
    "Integrator": (("u",), "y", {"k": (-2.0, 2.0), "y": (-1.0, 1.0)}),
    "Adder": (("u1", "u2"), "y", {}),
    "TransportDelay": (("x",), "y", {"d": (0.01, 0.3)}),
}
"""Inputs, output, and ranges of start values."""


def random_system(seed: int) -> dict[str, Any]:
    """A configuration of up to six instances in up to three nodes; loops are damped so that no value overflows."""
    draw = random.Random(seed)  # noqa: S311 no secret
    models = ["DampedPendulum", *draw.choices(list(MODELS), k=draw.randint(2, 5))]
    names = [f"i{number}" for number in range(len(models))]
    connections = []
    for name, model in zip(names, models, strict=True):
        for input_ in MODELS[model][0]:
            source = draw.randrange(len(names))
            connection: dict[str, Any] = {
                "from": f"{names[source]}.{MODELS[models[source]][1]}",
                "to": f"{name}.{input_}",
                "factor": draw.uniform(-0.45, 0.45),
                "offset": draw.choice([0.0, draw.uniform(-0.1, 0.1)]),
            }
            connections.append(connection)
    return {
        "mesh": "random",
        "simulation": {
            "start_time": draw.choice([0.0, 0.5]),
            "stop_time": 0.5 + 300 * STEP_SIZE,
            "step_size": STEP_SIZE,
            "algorithm": draw.choice(["jacobi", "gauss_seidel"]),
            "window": draw.choice([2, 7, 64, "auto"]),
        },
        "instances": {
            name: {
                "fmu": str(FMUS / f"{model}.fmu"),
                "start_values": {v: draw.uniform(low, high) for v, (low, high) in MODELS[model][2].items()},
                "step_size": draw.choice([1, 1, 1, 2, 3]) * STEP_SIZE,
                "group": f"g{draw.randrange(3)}",
            }
            for name, model in zip(names, models, strict=True)
        },
        "connections": connections,
        "initialization": {"relaxation": RELAXATION},
        "record": {"variables": [f"{name}.{MODELS[model][1]}" for name, model in zip(names, models, strict=True)]},
    }


@pytest.mark.parametrize("seed", range(5))
def test_a_random_system_gives_the_floats_of_fmpy(seed: int, place: Place) -> None:
    config: Path = place.folder / "mesh.yaml"
    config.write_text(yaml.safe_dump(random_system(seed), sort_keys=False), encoding="utf-8")
    plan = prepare(config)
    delays = {
        f"{c.source_instance}.{c.source.name} -> {c.target_instance}.{c.target.name}": c.delay or 0
        for c in plan.connections
    }
    reference = reference_of(config, delays, order=plan.order)
    into = {(pipe.target, pipe.input): pipe for pipe in reference.pipes}
    loops = [[into[tear.target, tear.input] for tear in loop.tears] for loop in plan.initialization.loops]
    expected = run_fmpy(msgspec.structs.replace(reference, loops=loops, relaxation=RELAXATION))

    output = place.folder / "result.csv"
    process = place.start("launch", config, "--no-progress", "--output", output)

    assert process.wait(50.0) == 0, process.errors
    _, rows = read_csv(output.read_bytes())
    assert as_bits(rows) == as_bits(expected)
