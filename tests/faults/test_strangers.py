"""What a program that belongs to no node sends: it changes no number and ends no run (design, invariant 7).

The stranger is a plain Zenoh client of the same user. What it cannot be kept from without access control is a message
that is right in every respect; what a registered peer may not send ends the run with the names of both ends.
"""

from __future__ import annotations

import fcntl
import json
import mmap
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import yaml

from fmu_mesh.rings.host_memory import can_share
from fmu_mesh.rings.native import NEVER
from fmu_mesh.rings.ring import Ring
from fmu_mesh.run.options import PlanOptions
from fmu_mesh.wire.messages import HEADER, PROGRESS
from tests.helpers import DEADLINE_S, Launched, Place, row_count, rows_of, wait_until, write_config
from tests.planning import prepare
from tests.strangers import (
    FAR,
    Attack,
    Stranger,
    abort,
    any_bytes,
    config_of,
    few_wrong_rows,
    finish,
    grant,
    local_result,
    malformed,
    many_declarations,
    other_keys,
    progress,
    reports,
    too_many_rows,
)

WAYS = pytest.mark.parametrize("shared_memory", [True, False], ids=["shared memory", "Zenoh"])
needs_memory = pytest.mark.skipif(not can_share(), reason="needs Linux with memfd_create, and the library")


@contextmanager
def paused(place: Place, config: Path) -> Iterator[tuple[Launched, Stranger]]:
    """A mesh at rest at its first point, and a stranger in it."""
    launched = place.start("launch", config, "--paused", "--no-progress")
    with place.session() as session:
        wait_until(lambda: place.run("status", "pair", "--json").output.count("paused"), "a mesh at rest")
        yield launched, Stranger(session, "pair")


def assert_unharmed(place: Place, config: Path, launched: Launched) -> None:
    """The run goes on to its end, and its result is that of a single process."""
    assert launched.running, launched.story()
    assert place.run("resume", "pair").wait() == 0
    assert launched.wait() == 0, launched.story()
    assert "Traceback" not in launched.errors
    assert config.with_suffix(".csv").read_bytes() == local_result(place, config)
    place.assert_nothing_left()


# ---- what is malformed, or comes by another key than exactly the expected one


def all_refused(stranger: Stranger) -> None:
    """There are questions, and each of them is refused."""
    assert stranger.asked
    assert not [asked.key for asked in stranger.asked if not asked.refusals]


@WAYS
def test_the_messages_that_once_ended_run_are_refused_and_it_goes_on(place: Place, *, shared_memory: bool) -> None:
    config = config_of(place, shared_memory=shared_memory)
    with paused(place, config) as (launched, stranger):
        malformed(stranger)

        all_refused(stranger)
        wait_until(lambda: stranger.refused() >= 40, "refused messages")
        assert "was refused" in launched.errors
    assert_unharmed(place, config, launched)


@WAYS
def test_no_bytes_on_any_key_do_harm(place: Place, *, shared_memory: bool) -> None:
    config = config_of(place, shared_memory=shared_memory)
    with paused(place, config) as (launched, stranger):
        any_bytes(stranger)
        wait_until(lambda: stranger.refused() >= 40, "40 refused messages")
    assert_unharmed(place, config, launched)


@WAYS
def test_what_is_right_in_every_respect_but_its_key_is_refused(place: Place, *, shared_memory: bool) -> None:
    config = config_of(place, shared_memory=shared_memory)
    with paused(place, config) as (launched, stranger):
        other_keys(stranger)
        all_refused(stranger)
    assert_unharmed(place, config, launched)


# ---- what only the process of a node knows


@WAYS
def test_no_stranger_reports_the_end_of_a_node(place: Place, *, shared_memory: bool) -> None:
    config = config_of(place, shared_memory=shared_memory)
    with paused(place, config) as (launched, stranger):
        place.run("step", "pair", "500")
        wait_until(lambda: json.loads(place.run("status", "pair", "--json").output)["point"] == 500, "point 500")
        reports(stranger)
        all_refused(stranger)
        refusals = {text for asked in stranger.asked if asked.key.endswith("of=left") for text in asked.refusals}
        assert refusals == {"its sender is not the process that has registered"}
        assert stranger.refused() >= 41
    assert_unharmed(place, config, launched)


def test_no_stranger_is_ready_instead_of_a_node(place: Place) -> None:
    place.hold("node right")
    config = config_of(place, shared_memory=True)
    launched = place.start("launch", config, "--no-progress")
    with place.session() as session:
        stranger = Stranger(session, "pair")
        token = stranger.keys.node("left")
        wait_until(lambda: [*session.liveliness().get(token, timeout=DEADLINE_S)], "left, which waits for right")

        assert stranger.ask(stranger.keys.ready("left"), b'{"shared":false}')

        launched.child("right").resume()
        assert launched.wait() == 0, launched.story()


GATE = """
import time
from pathlib import Path
import fmu_mesh

class Gate(fmu_mesh.Component):
    y = fmu_mesh.Output(start=0.0)

    def step(self, now, step_size):
        if now + step_size > 0.1995:  # the last step, which can only be taken if the master has granted all points
            here = Path(__file__).parent
            (here / "waits").touch()
            while not (here / "open").exists():
                time.sleep(0.001)
        self.y = now
"""


def test_progress_that_a_stranger_sends_makes_no_result_shorter(place: Place) -> None:
    (place.folder / "gate.py").write_text(GATE)
    instances = {"gate": {"python": "gate.py:Gate"}, "free": {"fmu": "Gain"}}
    config = write_config(
        place.folder,
        instances=instances,
        connections=(),
        stop_time=0.2,
        zenoh={"shared_memory": False, "row_streams": False},
    )
    launched = place.start("launch", config, "--no-progress")
    with place.session() as session:
        stranger = Stranger(session, "pair")
        status = f"{stranger.public.root}/*/status"

        def believed() -> bool:
            for node in ("gate", "@record"):  # until it is believed: nobody answers a put
                stranger.put(stranger.keys.progress(node), HEADER.pack(PROGRESS, 0, 0, 200))
            return any(
                reply.ok and b'"state":"stopping"' in reply.ok.payload.to_bytes() for reply in session.get(status)
            )

        wait_until((place.folder / "waits").exists, "'gate' in the step where it waits")
        wait_until(believed, "a master that believes it")
    (place.folder / "open").touch()

    assert launched.wait() == 0, launched.story()
    assert config.with_suffix(".csv").read_bytes() == local_result(place, config)


# ---- more than anybody needs

FLOOD = """
import json, sys, threading
import zenoh

config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
session = zenoh.open(config)
open_queries = [session.get("**", zenoh.handlers.FifoChannel(1), timeout=600) for _ in range(10_000)]
print("sent", flush=True)
threading.Event().wait()
"""


@WAYS
def test_ten_thousand_open_queries_of_a_client_end_no_run(place: Place, *, shared_memory: bool) -> None:
    config = config_of(place, shared_memory=shared_memory, stop_time=8.0, real_time_factor=1.0)
    launched = place.start("launch", config, "--no-progress")
    wait_until(lambda: row_count(config.with_suffix(".csv")), "the first row")
    flood = place.start_command([sys.executable, "-c", FLOOD, place.note().endpoints[0]])
    wait_until(lambda: "sent" in flood.output, "its queries")

    assert launched.wait() == 0, launched.story()

    flood.close()
    config = config_of(place, shared_memory=shared_memory, stop_time=8.0)
    assert config.with_suffix(".csv").read_bytes() == local_result(place, config)


@WAYS
def test_many_subscribers_and_tokens_of_a_stranger_do_no_harm(place: Place, *, shared_memory: bool) -> None:
    config = config_of(place, shared_memory=shared_memory)
    with paused(place, config) as (launched, stranger):
        many_declarations(stranger)
    assert_unharmed(place, config, launched)


@pytest.mark.parametrize("listen", [[], ["tcp/127.0.0.1:0"]], ids=["sockets", "network"])
def test_no_session_of_a_mesh_tells_strangers_about_itself(place: Place, listen: list[str]) -> None:
    # Zenoh answers with its own tables, and stands for ever when another program subscribes meanwhile.
    config = config_of(place, shared_memory=True)
    data = yaml.safe_load(config.read_text())
    data["zenoh"]["listen"] = listen
    config.write_text(yaml.safe_dump(data))
    with paused(place, config) as (launched, stranger):
        replies = [*stranger.session.get("@/**", timeout=DEADLINE_S)]
        assert len(place.note().endpoints) == 1 + len(listen)
        own = f"@/{stranger.session.zid()}/"
    assert not [
        key for reply in replies if reply.ok is not None and not (key := str(reply.ok.key_expr)).startswith(own)
    ]
    assert_unharmed(place, config, launched)


# ---- what a registered peer may not send


def assert_ends_with_names(place: Place, config: Path, launched: Launched, *names: str) -> None:
    """The run ends with an error that names both ends, and what was recorded is right."""
    assert launched.wait() == 4, launched.story()
    assert_no_row_is_wrong(place, config, launched, *names)


def assert_no_row_is_wrong(place: Place, config: Path, launched: Launched, *names: str) -> None:
    """What was recorded is right; and if the run has ended with an error, it names both ends."""
    assert launched.wait() in {0, 4}, launched.story()
    if launched.wait() == 4:
        for name in names:
            assert name in launched.message
    rows = rows_of(config.with_suffix(".csv"))
    local_result(place, config)
    local = rows_of(place.folder / "local.csv")
    assert rows == local[: len(rows)]
    assert launched.wait() == 4 or rows == local
    place.assert_nothing_left()


@pytest.mark.parametrize(
    ("forge", "names"),
    [
        (grant, ("the master grants point 4611686018427387904 to node '", "which may be granted ")),
        (finish, ("says that it has ended at point 0, and the master has granted point ",)),
        (abort, (" was lost",)),
        (progress, ("says that it is at point 2000, and the master has granted point ",)),
        (few_wrong_rows, ("the values of 'left' came twice and differ",)),
        (too_many_rows, ("'left' sends its values up to point 1048575 to node 'right', more than was granted",)),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_registered_peer_that_breaks_the_protocol_ends_run_with_both_names(
    place: Place, forge: Attack, names: tuple[str, ...]
) -> None:
    """A forgery that is sent exactly as a peer sends its messages cannot be told from a peer; it must do no harm."""
    config = config_of(place, shared_memory=False)
    with paused(place, config) as (launched, stranger):
        forge(stranger)
        place.run("resume", "pair")
    assert_ends_with_names(place, config, launched, *names)


# ---- what a process of the same user can write into the shared memory


class Intruder:
    """A process of the same user that has opened the memory of a run, and knows what lies where."""

    def __init__(self, launched: Launched, config: Path) -> None:
        plan = prepare(config, PlanOptions())
        node = plan.nodes["left"]
        self.map = node.memory
        self.places = {place.instance: place for own in plan.nodes.values() for place in own.rings}
        master = launched.child("master")
        descriptors = Path(f"/proc/{master.pid}/fd").iterdir()
        self.path = next(path for path in descriptors if "memfd:fmu_mesh" in str(path.readlink()))
        with self.path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), self.map.size)

    def write(self, offset: int, *values: int) -> None:
        """Write numbers of 64 bits."""
        np.frombuffer(self._memory, np.int64, len(values), offset)[:] = values

    def ring(self, instance: str) -> Ring:
        """The ring of an instance."""
        place = self.places[instance]
        return Ring(place.layout, place.rows, memoryview(self._memory)[place.offset :])


def memory_grant(intruder: Intruder) -> None:
    intruder.write(intruder.map.grant, FAR)


def memory_progress(intruder: Intruder) -> None:
    intruder.write(intruder.map.progress_of("left"), FAR)


def memory_progress_of_the_recorder(intruder: Intruder) -> None:
    intruder.write(intruder.map.progress_of("@record"), FAR)


def memory_rows(intruder: Intruder) -> None:
    intruder.write(intruder.places["left"].counter, 1500)


def memory_all_rows(intruder: Intruder) -> None:
    for place in intruder.places.values():
        intruder.write(place.counter, FAR)


def memory_stamps(intruder: Intruder) -> None:
    for name in intruder.places:
        intruder.ring(name).stamps[:] = 7


@needs_memory
@pytest.mark.parametrize(
    ("forge", "names"),
    [
        (memory_grant, ("says that it is at point ", "and the master has granted point ")),
        (memory_progress, ("node 'left' says that it is at point 4611686018427387903, and the master has granted",)),
        (memory_progress_of_the_recorder, ("the recorder says that it is at point 4611686018427387903",)),
        (memory_rows, ("a row of 'left' for ", " is not the one that was written")),
        (memory_all_rows, ("a row of '", " is not the one that was written")),
        (memory_stamps, ("a row of '", " is not the one that was written")),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_number_that_is_forged_in_shared_memory_makes_no_wrong_row(
    place: Place, forge: Callable[[Intruder], None], names: tuple[str, ...]
) -> None:
    """The run ends with names, or goes on where the owner of the number writes its own before anybody looks."""
    config = config_of(place, shared_memory=True)
    with paused(place, config) as (launched, _):
        forge(Intruder(launched, config))
        place.run("resume", "pair")
    assert_no_row_is_wrong(place, config, launched, *names)


@needs_memory
def test_nobody_can_take_the_shared_memory_away(place: Place) -> None:
    """Who reads beyond the end of a mapping is killed by SIGBUS; so nobody can shrink it, and a copy is none of it."""
    config = config_of(place, shared_memory=True)
    with paused(place, config) as (launched, _):
        intruder = Intruder(launched, config)
        with intruder.path.open("r+b") as file:
            for size in (0, 4096, intruder.map.size - 1):
                with pytest.raises(PermissionError):
                    os.ftruncate(file.fileno(), size)
            with pytest.raises(OSError, match=r"Operation not permitted|busy"):
                fcntl.fcntl(file.fileno(), fcntl.F_ADD_SEALS, fcntl.F_SEAL_WRITE)
    assert_unharmed(place, config, launched)


@needs_memory
def test_whoever_rings_bells_and_writes_needs_delays_run_and_changes_no_number(place: Place) -> None:
    config = config_of(place, shared_memory=True)
    with paused(place, config) as (launched, _):
        intruder = Intruder(launched, config)
        for counter in (intruder.map.grant, *intruder.map.progress, *intruder.map.rings):
            for wake_at, need in ((-1, -5), (0, 1), (FAR, FAR), (NEVER, 3)):
                intruder.write(counter + 8, wake_at)
                intruder.write(counter + 64, *[need] * len(intruder.map.processes))
        for number in range(len(intruder.map.processes)):
            intruder.write(intruder.map.bells + 64 * number, number + 1)
    assert_unharmed(place, config, launched)
