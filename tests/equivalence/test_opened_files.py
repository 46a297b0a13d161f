"""How often the processes of a run open the configuration and the FMUs."""

from __future__ import annotations

from collections import Counter

from tests.helpers import Place, write_config

COUNTING = """
import os, sys

log = os.open(os.environ["OPENED_FILES"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)

def note(event, arguments):
    if event == "open" and isinstance(arguments[0], (str, bytes)):
        name = os.path.basename(os.fsdecode(arguments[0]))
        if name.endswith((".fmu", ".yaml")):
            os.write(log, f"{' '.join(sys.argv[1:2])} {name}\\n".encode())

sys.addaudithook(note)
"""


def test_a_launch_opens_the_configuration_once_and_each_fmu_twice(place: Place) -> None:
    opened = place.folder / "opened.txt"
    (place.folder / "sitecustomize.py").write_text(COUNTING)
    place.environment = {**place.environment, "PYTHONPATH": str(place.folder), "OPENED_FILES": str(opened)}

    gains = {f"gain_{number}": {"fmu": "Gain"} for number in range(4)}
    config = write_config(place.folder, instances={"pendulum": {"fmu": "DampedPendulum"}, **gains}, connections=[])

    launched = place.run("launch", config)

    assert "1000 points in" in launched.output
    assert Counter(opened.read_text().splitlines()) == {
        "launch pair.yaml": 1,
        "launch DampedPendulum.fmu": 1,
        "launch Gain.fmu": 1,
        "forks DampedPendulum.fmu": 1,
        "forks Gain.fmu": 1,
    }
