"""Many instances on one machine: they start, run and end, with the result of one process."""

from __future__ import annotations

import itertools
import queue
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest
import zenoh

import fmu_mesh
from fmu_mesh.run.options import PlanOptions
from fmu_mesh.wire.session import Wiring, open_session
from tests.helpers import DEADLINE_S, FMUS, Place, wait_until, write_config
from tests.plain_run import PlainRun
from tests.planning import prepare


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
    PlainRun(prepare(config, PlanOptions(output=local))).run()
    assert config.with_suffix(".csv").read_bytes() == local.read_bytes()
    place.assert_nothing_left()


def wide_fmu(folder: Path, count: int) -> Path:
    """Gain with this many local variables more, each of them its output."""
    declared = "".join(
        f'<ScalarVariable name="net[{number}].x" valueReference="1" causality="local"><Real/></ScalarVariable>'
        for number in range(count)
    )
    path = folder / f"wide_{count}.fmu"
    with zipfile.ZipFile(FMUS / "Gain.fmu") as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            data = old.read(name)
            if name == "modelDescription.xml":
                data = data.replace(b"</ModelVariables>", declared.encode() + b"</ModelVariables>")
            new.writestr(name, data)
    return path


@contextmanager
def paused_run(folder: Path, count: int) -> Iterator[fmu_mesh.Run]:
    """A paused run at point 0 of an instance `wide` with this many local variables, whose values are 2."""
    mesh = fmu_mesh.Mesh("wide", step_size=0.1, stop_time=100_000.0, real_time_factor=10.0)
    mesh.add("wide", fmu=wide_fmu(folder, count), start_values={"u": 1.0, "k": 2.0})
    with mesh.start(record="memory", paused=True) as run:
        run.wait_for("paused")
        yield run


def test_a_node_needs_no_more_threads_for_more_variables(tmp_path: Path) -> None:
    threads = []
    for count in (10, 5_000):
        with paused_run(tmp_path, count) as run:
            threads.append(psutil.Process(run.instance_info("wide").pid).num_threads())

    assert threads[1] <= threads[0] + 4  # Zenoh starts the threads of its own pools as it needs them: one to three


def test_a_thousand_variables_are_watched_from_the_first_point(tmp_path: Path) -> None:
    names = [f"wide.net[{number}].x" for number in range(0, 5_000, 5)]
    with paused_run(tmp_path, 5_000) as run, run.watch(*names) as samples:
        before = psutil.Process().num_threads()
        run.step(1)

        found = list(itertools.islice(samples, 2 * len(names)))

        assert psutil.Process().num_threads() <= before + 4
    assert {sample.value for sample in found} == {2.0}
    assert {(sample.name, sample.point) for sample in found} == {(name, point) for name in names for point in (0, 1)}


def test_a_plain_zenoh_program_gets_what_it_subscribes_to_and_no_more(tmp_path: Path) -> None:
    with paused_run(tmp_path, 5_000) as run:
        arrived: queue.SimpleQueue[str] = queue.SimpleQueue()
        root = "fmu_mesh/wide/wide"
        endpoints = tuple(run.info().endpoints)
        with open_session(Wiring("client", connect=endpoints)) as session:
            run.resume()
            for key in ("local/net[4711].x", "out/*", "local/net[31$*"):
                # Zenoh reports only the first of them to the node.
                subscriber = session.declare_subscriber(f"{root}/{key}", lambda s: arrived.put(str(s.key_expr)))
                wanted = zenoh.KeyExpr(f"{root}/{key}").intersects
                while not wanted(zenoh.KeyExpr(arrived.get(timeout=DEADLINE_S))):
                    pass  # of the subscriber before
                subscriber.undeclare()
            session.declare_subscriber(f"{root}/out/y", lambda s: arrived.put(str(s.key_expr)))

            wait_until(lambda: {arrived.get(timeout=DEADLINE_S) for _ in range(50)} == {f"{root}/out/y"}, "only y")
        run.stop()
