"""How often the processes of a run open the configuration and the FMUs."""

from __future__ import annotations

from collections import Counter

from tests.helpers import FMUS, Place

CONFIG = FMUS.parent / "configs" / "pendulum_delay.yaml"

COUNTING = """
import os, sys

log = os.open(os.environ["OPENED_FILES"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)

def note(event, arguments):
    if event == "open" and isinstance(arguments[0], (str, bytes)):
        name = os.path.basename(os.fsdecode(arguments[0]))
        if name.endswith((".fmu", ".yaml")):
            os.write(log, f"{' '.join(sys.argv[1:4:2])} {name}\\n".encode())

sys.addaudithook(note)
"""


def test_a_launch_opens_the_configuration_once_and_each_fmu_once_per_process_that_runs_it(place: Place) -> None:
    opened = place.folder / "opened.txt"
    (place.folder / "sitecustomize.py").write_text(COUNTING)
    place.environment = {**place.environment, "PYTHONPATH": str(place.folder), "OPENED_FILES": str(opened)}

    launched = place.run("launch", CONFIG, "--output", place.folder / "result.csv")

    assert "20000 points in" in launched.output
    assert Counter(opened.read_text().splitlines()) == {
        "launch --output pendulum_delay.yaml": 1,
        "launch --output DampedPendulum.fmu": 1,
        "launch --output TransportDelay.fmu": 1,
        "node pendulum DampedPendulum.fmu": 1,
        "node delay TransportDelay.fmu": 1,
    }
