"""What goes wrong in a sandbox of WebAssembly: an error with names and the way out, in the process and in a node."""

from __future__ import annotations

from pathlib import Path

import pytest

import fmu_mesh
from tests.helpers import Place, write_config
from tests.wasm.guests import FAULTS, SANDBOX, meshed, rogue

NUMBERS = {fault: float(number) for number, fault in enumerate(FAULTS, 10)}

WORDS = {
    "wild": "it used memory that it does not have (a wild pointer)",
    "memory": "it asked for 1.0 MiB more than the 64 MiB that it may have: raise `process.memory`",
    "deep": "it used memory that it does not have",
    "abort": "it ended itself (abort, or a failed assertion)",
    "exit": "it called exit(7)",
    "divide": "it divided an integer by zero",
    "pointer": "it called a function by a pointer to a function of another type",
}


@pytest.mark.parametrize("fault", WORDS)
def test_a_fault_in_this_process_is_an_error(tmp_path: Path, fault: str) -> None:
    mesh = meshed(rogue(tmp_path), SANDBOX | {"memory": "64 MiB"}, start_values={"k": NUMBERS[fault]})

    with pytest.raises(fmu_mesh.StepFailed) as caught:
        mesh.run(processes=False, record="memory")

    assert (caught.value.instance, caught.value.point) == ("one", 5)
    assert f"fmi2DoStep was stopped in its sandbox: {WORDS[fault]}" in str(caught.value)


def test_an_endless_loop_ends_at_the_deadline_of_a_step(tmp_path: Path) -> None:
    mesh = meshed(rogue(tmp_path), start_values={"k": NUMBERS["endless"]})
    mesh.configure(timeouts={"step": 1.0})

    with pytest.raises(fmu_mesh.StepFailed) as caught:
        mesh.run(processes=False, record="memory")

    assert (caught.value.instance, caught.value.point) == ("one", 5)
    assert "it did not return within 1 s (`timeouts.step`)" in str(caught.value)


@pytest.mark.parametrize("fault", ["endless", "wild", "memory"])
def test_a_fault_in_a_node_ends_the_run_with_names(place: Place, fault: str) -> None:
    config = write_config(
        place.folder,
        instances={"one": {"fmu": str(rogue(place.folder)), "start_values": {"k": NUMBERS[fault]}}},
        connections=[],
        process=SANDBOX | {"memory": "32 MiB"},
        timeouts={"step": 5.0},
    )

    place.run("check", config)  # compiles the sources, which `launch` would tell beside the error
    launched = place.run("launch", config)

    assert launched.wait() != 0
    assert "one" in launched.message
    assert "point 500" in launched.message or "point 499" in launched.message, launched.story()
    words = WORDS | {
        "endless": "it did not return within 5 s (`timeouts.step`)",
        "memory": "32 MiB that it may have: raise `process.memory`",
    }
    assert words[fault] in launched.message, launched.story()
    place.assert_nothing_left()


@pytest.mark.parametrize("fault", ["file", "printed", "slept"])
def test_a_guest_has_no_files_no_output_and_no_sleep(
    tmp_path: Path, fault: str, capfd: pytest.CaptureFixture[str]
) -> None:
    mesh = meshed(rogue(tmp_path), start_values={"k": NUMBERS[fault]})

    result = mesh.run(processes=False, record="memory")

    assert result["one.y"][-1] == (0.0 if fault == "file" else 1.0)
    assert "x" not in capfd.readouterr().out


def test_an_instance_is_held_after_a_fault(tmp_path: Path) -> None:
    mesh = meshed(rogue(tmp_path), start_values={"k": NUMBERS["abort"], "u": 2.0}, on_failure="hold")

    result = mesh.run(processes=False, record="memory")

    assert len(result.times) == 11
    assert set(result["one.y"][1:]) == {result["one.y"][1]}
