"""The library stands on its own: what it does needs nothing of the command line."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import fmu_mesh
from tests.api.test_mesh_building import built
from tests.helpers import FMUS, Place

PROGRAM = """
import json, sys
import fmu_mesh

mesh = fmu_mesh.Mesh("pair", step_size=0.001, stop_time=1.0)
mesh.add("pendulum", fmu={pendulum!r})
mesh.add("delay", fmu={delay!r}, start_values={{"d": 0.1}})
mesh.connect("pendulum.a", "delay.x")
result = mesh.run(record="memory")
with mesh.start(record="memory", paused=True) as run:
    point = run.step(3).point
print(json.dumps([fmu_mesh.__file__, point, result["delay.y"].tolist()]))
"""


def test_a_package_without_its_command_line_runs_a_mesh(place: Place) -> None:
    package = Path(fmu_mesh.__file__).parent
    copy = place.folder / "copy"
    shutil.copytree(package, copy / "fmu_mesh", ignore=shutil.ignore_patterns("cli", "__pycache__"))
    metadata = next(folder for entry in sys.path for folder in Path(entry).glob("fmu_mesh-*.dist-info"))
    shutil.copytree(metadata, copy / metadata.name)
    script = place.folder / "program.py"
    script.write_text(PROGRAM.format(pendulum=str(FMUS / "DampedPendulum.fmu"), delay=str(FMUS / "TransportDelay.fmu")))
    place.environment["PYTHONPATH"] = str(copy)

    program = place.start_command([sys.executable, str(script)])

    assert program.wait() == 0, program.errors
    where, point, values = json.loads(program.output)
    assert Path(where).is_relative_to(copy)
    assert point == 3
    assert values == built().run(record="memory")["delay.y"].tolist()
