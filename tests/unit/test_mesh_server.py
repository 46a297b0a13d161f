"""What the master takes of its nodes stays in the order in which they have sent it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
import zenoh

from fmu_mesh.master.mesh_server import MasterServer
from fmu_mesh.rings.host_memory import HostMemory
from fmu_mesh.system.memory_map import map_memory
from fmu_mesh.wire.inbox import Inbox
from fmu_mesh.wire.keys import Keys, RunKeys
from fmu_mesh.wire.session import Wiring, matches, open_session
from fmu_mesh.wire.views import LogLine, MeshStatus
from tests.helpers import DEADLINE_S, wait_until

KEYS = Keys("fmu_mesh", "order")
RUN = RunKeys("fmu_mesh/order", "0123456789abcdef")
_ROUNDS, _BUSY = 40, 2


class Heard:
    """What the master takes, in its order."""

    def __init__(self) -> None:
        self.words: list[str] = []

    def status(self, status: MeshStatus) -> None:
        """Not asked for here."""

    def log(self, line: LogLine) -> None:
        """One line of a node."""
        self.words.append(line.message)


@pytest.fixture
def busy_interpreter() -> Iterator[None]:
    """Threads of Python that all want to run, as on a machine with more to do than it has processors."""
    ended = threading.Event()

    def work() -> None:
        while not ended.is_set():
            sum(range(2000))

    threads = [threading.Thread(target=work) for _ in range(_BUSY)]
    for thread in threads:
        thread.start()
    yield
    ended.set()
    for thread in threads:
        thread.join()


@pytest.mark.usefixtures("busy_interpreter")
def test_a_log_line_is_taken_before_the_report_after_it(tmp_path: Path) -> None:
    endpoint = f"unixsock-stream/{tmp_path}/s"
    session, memory = open_session(Wiring(listen=(endpoint,))), HostMemory.private(map_memory(["a"], {})[0], "a")
    inbox, heard = Inbox(memory), Heard()
    inbox.open(session, RUN, "a", {})
    server = MasterServer(session, KEYS, inbox, heard, lambda: pytest.fail("not asked for"), ["pump"])
    server.hand_on_logs()

    def take_report(query: zenoh.Query) -> None:
        heard.words.append(f"report {query.payload}")
        query.reply(query.key_expr, b"")
        query.drop()

    server.serve(RUN.report("a"), take_report)
    node = open_session(Wiring(connect=(endpoint,)))
    publisher = node.declare_publisher(f"{KEYS.instance('pump')}/log")
    wait_until(lambda: matches(publisher), "the subscription of the master")

    def say() -> None:
        for number in range(_ROUNDS):
            publisher.put(msgspec.json.encode(LogLine("pump", "warning", "end", f"farewell {number}", number)))
            for _ in node.get(RUN.report("a"), payload=f"{number}", timeout=DEADLINE_S):
                pass

    saying = threading.Thread(target=say)
    saying.start()
    inbox.wait_until(lambda: len(heard.words) >= 2 * _ROUNDS, DEADLINE_S)
    saying.join()
    server.close()
    inbox.close()
    node.close()
    session.close()
    memory.close()
    wrong = [
        number
        for number in range(_ROUNDS)
        if heard.words.index(f"farewell {number}") > heard.words.index(f"report {number}")
    ]
    assert wrong == []
