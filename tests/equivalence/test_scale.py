"""Many instances on one machine: they start, run and end, with the result of one process."""

from __future__ import annotations

import itertools

import pytest

from fmu_mesh.run.local import LocalMesh
from fmu_mesh.run.options import Options
from fmu_mesh.run.preparing import prepare
from tests.helpers import Place, write_config


@pytest.mark.parametrize(("instances", "groups"), [(64, 64), (256, 4)])
def test_many_instances_give_the_floats_of_one_process(instances: int, groups: int, place: Place) -> None:
    names = [f"i{number}" for number in range(instances)]
    members = {
        name: {"fmu": "Gain", "start_values": {"k": 1.001}, "group": f"g{number * groups // instances}"}
        for number, name in enumerate(names)
    }
    members[names[0]] |= {"fmu": "Integrator", "start_values": {"u": 1.0}}
    connections = [f"{source}.y -> {target}.u" for source, target in itertools.pairwise(names)]
    config = write_config(place.folder, instances=members, connections=connections, stop_time=0.5)

    assert place.run("launch", config, "--no-progress", deadline_s=200.0).wait() == 0

    local = place.folder / "local.csv"
    LocalMesh(prepare(config, Options(output=local))).run()
    assert config.with_suffix(".csv").read_bytes() == local.read_bytes()
    place.assert_nothing_left()
