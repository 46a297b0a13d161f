"""An FMU in a sandbox of WebAssembly has a state, whatever its model description says."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import pytest

import fmu_mesh
from tests.fmus.event_fmus import Version, build_event_fmu, event_source_fmu
from tests.fmus.helpers import FMUS
from tests.fmus.packing import repacked
from tests.helpers import Place, rows_of, write_config
from tests.solved_systems import LINKS, masses
from tests.wasm.guests import SANDBOX, meshed, rogue


def stateless(folder: Path, name: str = "TransportDelay") -> Path:
    """An FMU that grows its memory, without the flags for states."""
    return repacked(folder / f"{name}.fmu", source=FMUS / f"{name}.fmu", description=_without_flags)


def _without_flags(text: str) -> str:
    return text.replace('canGetAndSetFMUstate="true"', "").replace('canSerializeFMUstate="true"', "")


def delayed(folder: Path) -> fmu_mesh.Mesh:
    """A pendulum before a delay, both without states of their own."""
    mesh = fmu_mesh.Mesh("delayed", step_size=0.01, stop_time=4.0)
    mesh.add("pendulum", fmu=str(stateless(folder, "DampedPendulum")), start_values={"a": 1.3}, process=SANDBOX)
    mesh.add("delay", fmu=str(stateless(folder)), start_values={"d": 0.5}, process=SANDBOX)
    mesh.connect("pendulum.a", "delay.x")
    return mesh


def test_a_restored_system_gives_the_same_floats(tmp_path: Path) -> None:
    with delayed(tmp_path).open() as system:
        system.step(20)
        state = system.save()
        seen = []
        for _ in range(2):
            system.step(300)  # the delay needs more memory than at the state
            seen.append((system.get("pendulum.a"), system.get("delay.y")))
            system.restore(state)

    assert seen[0] == seen[1]


def test_a_state_goes_on_from_a_file(tmp_path: Path) -> None:
    mesh, file = delayed(tmp_path), tmp_path / "at.state"
    with mesh.open() as system:
        system.step(120)
        system.save(file)
        system.step(100)
        expected = system.get("delay.y"), system.get("pendulum.a")

    with mesh.open(state=file) as system:
        system.step(100)
        assert (system.get("delay.y"), system.get("pendulum.a")) == expected


def test_copies_are_restored_one_by_one(tmp_path: Path) -> None:
    mesh = delayed(tmp_path)
    batch = mesh.batch(3)
    batch.step(50)
    state = batch.save()
    batch.step(100)
    first = batch.get("delay.y")
    batch.restore(state, [True, False, True])
    batch.step(100)

    again = batch.get("delay.y")

    assert again[0] == first[0]
    assert again[2] == first[2]
    assert again[1] != first[1]
    batch.close()


@pytest.mark.parametrize("kind", ["co_simulation", "model_exchange"])
@pytest.mark.parametrize("version", [2, 3])
def test_states_hold_events_too(
    tmp_path: Path, version: Version, kind: Literal["co_simulation", "model_exchange"]
) -> None:
    mesh = meshed(event_source_fmu("Ball", version, tmp_path / "ball.fmu"), kind=kind)
    with mesh.open() as system:
        system.step(2)
        state = system.save()
        system.step(6)
        expected = system.get("one.h"), system.get("one.bounces")
        system.restore(state)
        system.step(6)
        assert (system.get("one.h"), system.get("one.bounces")) == expected


def test_a_solved_group_takes_steps_of_guests_again(tmp_path: Path) -> None:
    native = build_event_fmu("LinearPart", 2, tmp_path)
    guest = event_source_fmu("LinearPart", 2, tmp_path / "guest.fmu", _without_flags)
    results = []
    for fmu, process in ((native, "none"), (guest, "wasm")):
        config = write_config(
            tmp_path,
            name=process,
            instances=masses(fmu),
            connections=LINKS,
            process={"sandbox": process},
            simulation={"step_size": 0.01},
        )
        results.append(fmu_mesh.load(config).run(processes=False, record="memory"))

    assert list(results[0]) == list(results[1])
    for variable in results[0]:
        np.testing.assert_array_equal(results[1][variable], results[0][variable])


def test_a_killed_node_goes_on_from_a_checkpoint(place: Place) -> None:
    pair = {"gain": {"fmu": str(stateless(place.folder)), "start_values": {"d": 0.1}}}
    config = write_config(
        place.folder,
        instances=pair,
        connections=[],
        process=SANDBOX,
        stop_time=6.0,
        simulation={"real_time_factor": 1.0},
        recovery={"mode": "restart"},
    )
    launched = place.start("launch", config)
    place.note()
    launched.child("gain").kill()

    assert launched.wait() == 0, launched.story()
    assert len(rows_of(config.with_suffix(".csv"))) == 6001
    place.assert_nothing_left()


def test_a_state_of_other_sources_is_refused(tmp_path: Path) -> None:
    first, second = meshed(rogue(tmp_path)), meshed(FMUS / "Gain.fmu")
    file = tmp_path / "rogue.state"
    with first.open() as system:
        system.step(2)
        system.save(file)

    with pytest.raises(fmu_mesh.errors.FmuMeshError):
        second.open(state=file)


def test_each_state_has_its_own_values(tmp_path: Path) -> None:
    with meshed(rogue(tmp_path), start_values={"u": 2.0}).open() as system:
        states = []
        for value in (1.0, 5.0):
            system.set("one.u", value)
            system.step(1)
            states.append(system.save())
        system.restore(states[0])
        assert system.get("one.y") == 1.0
        system.restore(states[1])
        np.testing.assert_equal(system.get("one.y"), 5.0)
