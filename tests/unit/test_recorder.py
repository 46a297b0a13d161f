"""The recorder's end: it waits for nobody who does not listen any more."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zenoh

from fmu_mesh.errors import MeshLost
from fmu_mesh.recorder import recorder as module
from fmu_mesh.recorder.recorder import Recorder
from fmu_mesh.results.csv_file import CsvFile
from fmu_mesh.rings.host_memory import HostMemory
from fmu_mesh.rings.ring import Ring
from fmu_mesh.system.plan import MASTER, RECORDER, NodePlan
from fmu_mesh.system.records import union_of
from fmu_mesh.wire.frames import encode_rows
from fmu_mesh.wire.keys import Keys, RunKeys
from fmu_mesh.wire.membership import Admission, Hello, Welcome
from fmu_mesh.wire.messages import ABORT, FINISH, FRAME, HEADER, LAST, encode_json
from fmu_mesh.wire.session import Wiring, close_session, open_session
from fmu_mesh.wire.ways import Ways
from tests.helpers import DEADLINE_S, wait_until
from tests.scenarios.scenario import Scenario

POINTS = 1_000_000
ROWS = 1024


class Mesh:
    """A node and a master who listens, but does not answer reports."""

    def __init__(self, session: zenoh.Session, folder: Path) -> None:
        plan = Scenario(("a -> b",), points=POINTS).plan(groups={"a": "n", "b": "n"}, record=True, window=ROWS)
        self.plan: NodePlan = msgspec.structs.replace(
            plan.nodes[RECORDER],
            shared_memory=False,
            timeouts=msgspec.structs.replace(plan.system.config.timeouts, stop=DEADLINE_S),
        )
        self.session = session
        self._folder = folder
        self.reported = threading.Event()
        self._welcomed = threading.Event()
        self.shared: tuple[str, ...] = ()
        public = Keys(self.plan.key_prefix, self.plan.mesh)
        self._keys = RunKeys.new(public)
        self._reports: list[zenoh.Query] = []
        self._entities: list[Any] = [
            session.declare_queryable(
                self._keys.hello("n"), lambda query: query.reply(query.key_expr, msgspec.json.encode(Hello("n")))
            ),
            session.declare_queryable(public.register, self._register),
            session.declare_queryable(self._keys.ready(RECORDER), self._take_ready),
            session.declare_queryable(self._keys.report(RECORDER), self._take_report),
        ]

    def file(self) -> CsvFile:
        """The result file."""
        return CsvFile(self._folder / "result.csv", [(f"{i}.{v}", "Float64") for i, v in union_of(self.plan.records)])

    def put(self, message: bytes) -> None:
        """What the master sends."""
        self._put(self._keys.grants([RECORDER])[RECORDER], message)

    def put_rows(self, *, last: bool = False) -> None:
        """What the node sends, as soon as the recorder is in the mesh; ``last``: and that no more rows come."""
        assert self._welcomed.wait(DEADLINE_S)
        for link in self.plan.links_in:
            rows = encode_rows(FRAME, link.index, 0, Ring(link.layout, ROWS).parts)
            key = self._keys.frames(link.source, RECORDER)
            self._put(key, rows)
            if last:
                self._put(key, HEADER.pack(LAST, link.index, 0, ROWS))

    def _put(self, key: str, message: bytes) -> None:
        self.session.put(key, message, congestion_control=zenoh.CongestionControl.BLOCK)

    def close(self) -> None:
        for entity in self._entities:
            entity.undeclare()

    def _register(self, query: zenoh.Query) -> None:
        query.reply(
            query.key_expr, msgspec.json.encode(Admission(self._keys.run, self._keys.grants([RECORDER])[RECORDER]))
        )

    def _take_ready(self, query: zenoh.Query) -> None:
        query.reply(query.key_expr, msgspec.json.encode(Welcome(ways=Ways(self.shared))))
        self._welcomed.set()

    def _take_report(self, query: zenoh.Query) -> None:
        self._reports.append(query)
        self.reported.set()


@pytest.fixture
def mesh(tmp_path: Path) -> Iterator[Mesh]:
    with ExitStack() as stack:
        session = open_session(Wiring())
        stack.callback(close_session, session)
        mesh = Mesh(session, tmp_path)
        stack.callback(mesh.close)
        yield mesh


def assert_has_ended(recorder: Recorder) -> None:
    assert "recorder" not in {thread.name for thread in threading.enumerate()}
    assert len(Path(recorder.files[0][0]).read_text().splitlines()) == 1 + ROWS


def test_a_waiting_recorder_ends_with_a_failed_run_and_writes_its_rows(
    mesh: Mesh, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_REST_S", DEADLINE_S)

    with suppress(MeshLost), Recorder(mesh.plan, mesh.session, [mesh.file()]) as recorder:
        mesh.put_rows()
        wait_until(lambda: recorder.files[0][1] == ROWS, "its rows are written, and it rests")
        error = MeshLost("node 'n' was lost", instance="a, b")
        mesh.put(encode_json(ABORT, error.report()))
        raise error

    assert_has_ended(recorder)
    assert not mesh.reported.is_set()


def test_recorder_that_reports_ends_with_master_that_takes_no_reports_any_more(mesh: Mesh) -> None:
    with suppress(MeshLost), Recorder(mesh.plan, mesh.session, [mesh.file()]) as recorder:
        mesh.put_rows()
        mesh.put(HEADER.pack(FINISH, 0, 0, 0))
        assert mesh.reported.wait(DEADLINE_S)
        raise MeshLost("node 'n' was lost")

    assert_has_ended(recorder)


@pytest.mark.parametrize(("lost", "sends_last"), [("a, b", False), (None, True)])
def test_a_recorder_waits_for_no_rows_of_a_lost_or_finished_node(
    mesh: Mesh, monkeypatch: pytest.MonkeyPatch, *, lost: str | None, sends_last: bool
) -> None:
    monkeypatch.setattr(module, "_LAST_S", DEADLINE_S)
    started = time.monotonic()

    with suppress(MeshLost), Recorder(mesh.plan, mesh.session, [mesh.file()]) as recorder:
        mesh.put_rows(last=sends_last)
        wait_until(lambda: recorder.files[0][1] == ROWS, "its rows are written")
        raise MeshLost("node 'n' was lost", instance=lost)

    assert time.monotonic() - started < DEADLINE_S
    assert_has_ended(recorder)
    assert not mesh.reported.is_set()


def test_a_recorder_takes_rows_that_come_after_the_end_of_the_run(mesh: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_LAST_S", DEADLINE_S)

    rows = threading.Timer(0.1, mesh.put_rows, kwargs={"last": True})
    with suppress(MeshLost), Recorder(mesh.plan, mesh.session, [mesh.file()]) as recorder:
        wait_until(lambda: recorder._sources, "it is in the mesh")
        rows.start()
        raise MeshLost("node 'm' was lost", instance="c")

    rows.join(DEADLINE_S)
    assert_has_ended(recorder)


def test_a_recorder_writes_before_its_window_is_full(mesh: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise the nodes, which may not be further ahead, wait until it looks."""
    monkeypatch.setattr(module, "_LONGEST_SLEEP_S", 2 * DEADLINE_S)
    memory, mesh.shared = HostMemory.create(mesh.plan.memory, MASTER), ("n",)
    plan = msgspec.structs.replace(mesh.plan, window=64)

    def put(rows: int) -> None:
        for place in plan.rings:
            for step in range(rows):
                memory.ring(place).stamp(step)
            memory.counter(place.counter).raise_to(rows)

    with (
        suppress(MeshLost),
        Recorder(plan, mesh.session, [mesh.file()], memory=memory.participant(RECORDER)) as recorder,
    ):
        put(1)
        wait_until(lambda: recorder.files[0][1] == 1, "the first row")
        put(64)
        wait_until(lambda: recorder.files[0][1] == 64, "the rows of its window")
        raise MeshLost("node 'n' was lost", instance="a, b")
